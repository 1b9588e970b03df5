//! The unknowns of a frame: corrections of its pose, and the Jacobian of the posed surface by them.

use glam::{Quat, Vec3, Vec3A};
use smpl::{BodyModel, Placement, Posed, Shaped};

use volrender::Camera;

use crate::capture::Frame;

/// Correction of a frame's pose: a translation of the body in camera axes, then a rotation vector
/// of each bone about its joint in world axes. A bone's rotation translates its children and does
/// not rotate them.
pub(super) type Correction = Vec<Vec3>;

/// The corrected pose and placement of a frame.
pub(super) fn corrected(
    frame: &Frame,
    model: &BodyModel,
    shape: &Shaped,
    correction: &[Vec3],
) -> (Vec<Vec3>, Placement) {
    let root = shape.joints.first().copied().unwrap_or(Vec3::ZERO);
    let about = match frame.placement {
        Placement::Origin { rotation, .. } => Quat::from_scaled_axis(rotation),
        Placement::Pelvis { .. } => Quat::IDENTITY,
    };
    let shift = frame.camera.world_to_camera.matrix3.transpose() * correction[0];
    let mut pose = frame.pose.clone();
    // World orientation of each bone, given and corrected.
    let mut bones: Vec<(Quat, Quat)> = Vec::with_capacity(pose.len());
    let turns = correction[1..].iter().map(|turn| Quat::from_scaled_axis(*turn));
    for ((local, turn), parent) in pose.iter_mut().zip(turns).zip(&model.parents) {
        // A rotation that is not finite stays as it is.
        let given = if local.is_finite() { Quat::from_scaled_axis(*local) } else { Quat::IDENTITY };
        let (original, corrected) = match parent {
            Some(parent) => {
                let (original, corrected) = (bones[*parent].0 * given, turn * bones[*parent].0 * given);
                if local.is_finite() {
                    *local = (bones[*parent].1.inverse() * corrected).normalize().to_scaled_axis();
                }
                (original, corrected)
            }
            None => {
                if let (Placement::Pelvis { .. }, true) = (frame.placement, local.is_finite()) {
                    *local = (turn * given).normalize().to_scaled_axis();
                }
                (about * given, turn * about * given)
            }
        };
        bones.push((original, corrected));
    }
    let placement = match frame.placement {
        Placement::Pelvis { translation } => Placement::Pelvis { translation: translation + shift },
        Placement::Origin { translation, .. } => {
            let after = Quat::from_scaled_axis(correction[1]) * about;
            let translation = translation + about * root + shift - after * root;
            Placement::Origin { rotation: after.normalize().to_scaled_axis(), translation }
        }
    };
    (pose, placement)
}

/// Sparse Jacobian of one surface point.
#[derive(Clone, Debug, Default)]
pub(super) struct PointJacobian {
    /// Index of each unknown of the frame's [`Correction`], flattened.
    pub columns: Vec<u32>,
    /// Derivatives of the point in world axes.
    pub directions: Vec<Vec3>,
    /// Position in `columns` of each bone's rotation that the point is skinned to, and its weight.
    pub bones: Vec<(usize, f32)>,
}

impl PointJacobian {
    /// Positions in `columns` of the unknowns that rotate the surface at the point, with its
    /// angular velocity by them.
    pub fn rotations(&self) -> impl Iterator<Item = (usize, Vec3)> {
        self.bones.iter().flat_map(|&(first, weight)| (0..3).map(move |i| (first + i, weight * Vec3::AXES[i])))
    }
}

/// Jacobian of the points of a posed body, without pose blend shapes.
pub(super) struct SurfaceJacobian<'a> {
    model: &'a BodyModel,
    rest: &'a [Vec3],
    posed: &'a Posed,
    /// Camera axes in the world.
    axes: [Vec3A; 3],
    moved: Vec<Vec3A>,
    weights: Vec<f32>,
}

impl<'a> SurfaceJacobian<'a> {
    /// `rest` (V) are the shaped vertices.
    pub fn new(model: &'a BodyModel, rest: &'a [Vec3], posed: &'a Posed, camera: &Camera) -> Self {
        let joints = model.num_joints();
        let rows = camera.world_to_camera.matrix3.transpose();
        let axes = [rows.x_axis, rows.y_axis, rows.z_axis];
        Self { model, rest, posed, axes, moved: vec![Vec3A::ZERO; joints], weights: vec![0.0; joints] }
    }

    /// Jacobian of a vertex.
    pub fn at(&mut self, vertex: usize, out: &mut PointJacobian) {
        out.columns.clear();
        out.directions.clear();
        out.bones.clear();
        let at = Vec3A::from(self.rest[vertex] + self.posed.pose_offsets[vertex]);
        let mut highest = 0;
        for (joint, weight) in self.model.weights.row(vertex) {
            self.moved[joint] += weight * self.posed.bones[joint].transform_point3a(at);
            self.weights[joint] += weight;
            highest = highest.max(joint);
        }
        self.propagate(highest, out);
        let column = |joint: usize| out.columns.iter().position(|&c| c as usize == 3 + 3 * joint);
        let bones = self.model.weights.row(vertex);
        out.bones.extend(bones.filter_map(|(joint, weight)| Some((column(joint)?, weight))));
    }

    /// Jacobian of a point in the world that is fixed to the bone of `joint`.
    pub fn fixed(&mut self, joint: usize, point: Vec3, out: &mut PointJacobian) {
        out.columns.clear();
        out.directions.clear();
        out.bones.clear();
        (self.moved[joint], self.weights[joint]) = (point.into(), 1.0);
        self.propagate(joint, out);
    }

    /// Derivatives of the sum of `moved` by the rotations of the joints up to `highest` and by the
    /// translation; clears `moved` and `weights`.
    fn propagate(&mut self, highest: usize, out: &mut PointJacobian) {
        let mut push = |first: usize, axes: [Vec3A; 3], column: &dyn Fn(Vec3A) -> Vec3A| {
            for (i, axis) in axes.into_iter().enumerate() {
                out.columns.push((first + i) as u32);
                out.directions.push(column(axis).into());
            }
        };
        // Children come after their parents.
        for joint in (0..=highest).rev() {
            let (moved, weight) = (self.moved[joint], self.weights[joint]);
            if weight == 0.0 {
                continue;
            }
            (self.moved[joint], self.weights[joint]) = (Vec3A::ZERO, 0.0);
            let place = weight * Vec3A::from(self.posed.joints[joint]);
            push(3 + 3 * joint, Vec3A::AXES, &|axis| axis.cross(moved - place));
            match self.model.parents[joint] {
                // The parent's rotation moves the joint alone.
                Some(parent) => {
                    self.moved[parent] += place;
                    self.weights[parent] += weight;
                }
                None => push(0, self.axes, &|axis| axis),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use volrender::RandomStream;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]

        /// Pose blend shapes move with the turns a little, which the derivatives leave out. Normals
        /// turn with the bone that their surface hangs on, and with no other.
        #[test]
        fn vertices_and_normals_move_as_by_finite_differences(seed in any::<u64>(), about_origin in any::<bool>()) {
            let mut model = BodyModel::embedded();
            model.posedirs = smpl::SparseRows::from_rows(vec![Vec::new(); model.num_vertices()]);
            let mut stream = RandomStream::new(&[seed]);
            let mut random = |size: f32| size * Vec3::new(stream.normal(), stream.normal(), stream.normal());
            let mut pose: Vec<Vec3> = (0..model.num_joints()).map(|_| random(0.3)).collect();
            let placement = if about_origin {
                pose[0] = Vec3::ZERO;
                Placement::Origin { rotation: random(1.0), translation: random(1.0) }
            } else {
                Placement::Pelvis { translation: random(1.0) }
            };
            let shape = model.shaped(&[0.4, -0.7]);
            let frame = crate::scene::registration::tests::frame(pose, placement);
            let at = |correction: &[Vec3]| {
                let (pose, placement) = corrected(&frame, &model, &shape, correction);
                let posed = model.pose(&shape, &pose, placement);
                let mut normals = surface_query::vertex_normals(&posed.vertices, &model.faces);
                normals.iter_mut().for_each(|n| *n = n.normalize_or_zero());
                (posed, normals)
            };
            let bone = |v: u32| {
                model.weights.row(v as usize).find(|(_, weight)| *weight > 0.9999).map(|(joint, _)| joint)
            };
            let mut is_rigid = vec![true; model.num_vertices()];
            // Rounding of f32 places at metres turns normals of 5 mm edges by 1e-4, a hundredth of
            // the difference's step.
            let short = |[a, b]: [u32; 2]| {
                shape.vertices[a as usize].distance(shape.vertices[b as usize]) < 5e-3
            };
            for corners in &model.faces {
                let [a, b, c] = corners.map(bone);
                let [u, v, w] = *corners;
                if a.is_none() || a != b || b != c || [[u, v], [v, w], [w, u]].into_iter().any(short) {
                    corners.iter().for_each(|v| is_rigid[*v as usize] = false);
                }
            }
            let rigid: Vec<usize> = (0..is_rigid.len()).filter(|&v| is_rigid[v]).collect();
            prop_assert!(rigid.len() > 100, "{}", rigid.len());
            let still = vec![Vec3::ZERO; model.num_joints() + 1];
            let (posed, normals) = at(&still);
            let mut surface = SurfaceJacobian::new(&model, &shape.vertices, &posed, &frame.camera);
            let mut jacobian = PointJacobian::default();
            for unknown in 0..3 * still.len() {
                let h = 1e-2;
                let moved = |h: f32| {
                    let mut correction = still.clone();
                    correction[unknown / 3][unknown % 3] = h;
                    at(&correction)
                };
                let ((more, more_normals), (less, less_normals)) = (moved(h), moved(-h));
                for v in (0..model.num_vertices()).step_by(701) {
                    surface.at(v, &mut jacobian);
                    let numeric = (more.vertices[v] - less.vertices[v]) / (2.0 * h);
                    let column = jacobian.columns.iter().position(|&c| c as usize == unknown);
                    let exact = column.map_or(Vec3::ZERO, |c| jacobian.directions[c]);
                    prop_assert!(exact.distance(numeric) < 1e-3, "vertex {v}, unknown {unknown}: {exact} {numeric}");
                }
                for joint in [0, 4, 20] {
                    let fixed = |posed: &Posed| posed.joints[joint] + posed.bones[joint].matrix3 * Vec3::new(0.1, 0.05, -0.1);
                    surface.fixed(joint, fixed(&posed), &mut jacobian);
                    let numeric = (fixed(&more) - fixed(&less)) / (2.0 * h);
                    let column = jacobian.columns.iter().position(|&c| c as usize == unknown);
                    let exact = column.map_or(Vec3::ZERO, |c| jacobian.directions[c]);
                    prop_assert!(exact.distance(numeric) < 1e-3, "joint {joint}, unknown {unknown}: {exact} {numeric}");
                }
                for &v in rigid.iter().step_by(rigid.len() / 9) {
                    surface.at(v, &mut jacobian);
                    let numeric = (more_normals[v] - less_normals[v]) / (2.0 * h);
                    let mine = jacobian.rotations().filter(|(column, _)| jacobian.columns[*column] as usize == unknown);
                    let exact: Vec3 = mine.map(|(_, turn)| turn.cross(normals[v])).sum();
                    prop_assert!(exact.distance(numeric) < 1e-2, "normal {v}, unknown {unknown}: {exact} {numeric}");
                }
            }
        }
    }
}
