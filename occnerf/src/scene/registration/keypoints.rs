//! Residuals of 2-D key points: a detector's points against projected joints. A detector places a
//! joint elsewhere than the body model does, by a constant offset in the axes of the joint's bone,
//! which is estimated from all frames.

use glam::{Mat3, Vec2, Vec3};
use smpl::Posed;
use volrender::Camera;

use crate::capture::Keypoint;
use crate::scene::registration::colors::robust;

/// Least standard deviation of a coordinate, pixels.
const NOISE: f32 = 1.0;
/// Standard deviation of an offset, metres of a body 1.7 high.
const OFFSET: f32 = 0.04;

/// Key points of one frame, in pixels of `camera`, and the body there.
pub(super) struct FramePoints<'a> {
    pub camera: &'a Camera,
    pub points: &'a [Keypoint],
    pub posed: &'a Posed,
}

/// Offsets of a detector's points, and their noise.
#[derive(Clone, Debug)]
pub(super) struct DetectorModel {
    /// Offset from each joint in the axes of its bone, (J).
    offsets: Vec<Vec3>,
    /// Robust standard deviation of a coordinate, pixels.
    noise: f32,
    /// Width of the robust loss, in multiples of the usual one: wide while poses are far off.
    pub width: f32,
}

/// A residual, x and y, of a point that is fixed to a bone.
pub(super) struct PointResidual {
    pub joint: usize,
    /// The body's point in the world.
    pub place: Vec3,
    /// Projection minus detection, pixels, and its gradients by `place`.
    pub residual: Vec2,
    pub gradients: [Vec3; 2],
    pub weight: f32,
}

impl DetectorModel {
    /// Estimates offsets by regularised least squares, then the noise. `unit` is the length of a metre of
    /// a body 1.7 high.
    pub fn measure(frames: &[FramePoints<'_>], joints: usize, unit: f32) -> Self {
        let mut model = Self { offsets: vec![Vec3::ZERO; joints], noise: 1.0, width: 1.0 };
        model.noise = model.deviation(frames);
        let ridge = (model.noise / (OFFSET * unit)).powi(2);
        let mut sums = vec![(Mat3::from_diagonal(Vec3::splat(ridge)), Vec3::ZERO); joints];
        for frame in frames {
            for seen in model.residuals(frame) {
                let bone = Mat3::from(frame.posed.bones[seen.joint].matrix3).transpose();
                let weight = seen.weight * model.noise * model.noise;
                for (gradient, residual) in seen.gradients.iter().zip(seen.residual.to_array()) {
                    let row = bone * *gradient;
                    let sum = &mut sums[seen.joint];
                    sum.0 += Mat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
                    sum.1 -= weight * residual * row;
                }
            }
        }
        model.offsets = sums.iter().map(|(matrix, side)| matrix.inverse() * *side).collect();
        model.noise = model.deviation(frames);
        model
    }

    /// Scaled median absolute deviation of the coordinates.
    fn deviation(&self, frames: &[FramePoints<'_>]) -> f32 {
        let mut errors: Vec<f32> = frames
            .iter()
            .flat_map(|frame| self.residuals(frame))
            .flat_map(|seen| seen.residual.abs().to_array())
            .collect();
        let middle = errors.len() / 2;
        let median = if errors.is_empty() { 0.0 } else { *errors.select_nth_unstable_by(middle, f32::total_cmp).1 };
        (1.48 * median).max(NOISE)
    }

    /// Residuals of a frame's points in front of the camera.
    pub fn residuals<'a>(&'a self, frame: &'a FramePoints<'a>) -> impl Iterator<Item = PointResidual> + 'a {
        frame.points.iter().filter_map(move |point| {
            let (joint, posed) = (point.joint, frame.posed);
            let place = *posed.joints.get(joint)? + posed.bones[joint].matrix3 * self.offsets[joint];
            let (at, gradients) = projected(frame.camera, place)?;
            let residual = at - point.place;
            let trust = point.confidence * robust(residual.length_squared(), self.width * self.noise);
            Some(PointResidual { joint, place, residual, gradients, weight: trust / (self.noise * self.noise) })
        })
    }
}

/// Projection of a point and its gradients in the world; `None` behind the camera.
fn projected(camera: &Camera, point: Vec3) -> Option<(Vec2, [Vec3; 2])> {
    let at = camera.project(point)?.truncate();
    let p = camera.world_to_camera.transform_point3(point);
    let to_world = camera.world_to_camera.matrix3.transpose();
    let x = to_world * (Vec3::new(1.0, 0.0, -p.x / p.z) * (camera.focal.x / p.z));
    let y = to_world * (Vec3::new(0.0, 1.0, -p.y / p.z) * (camera.focal.y / p.z));
    Some((at, [x, y]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Affine3A, Mat3};
    use proptest::prelude::*;
    use smpl::{BodyModel, Placement};
    use volrender::RandomStream;

    fn camera() -> Camera {
        let rotation = Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0));
        let intrinsics = Mat3::from_cols(Vec3::X * 300.0, Vec3::Y * 280.0, Vec3::new(100.0, 90.0, 1.0));
        let extrinsics = Affine3A::from_mat3_translation(rotation, Vec3::new(0.1, 0.2, 4.0));
        Camera::new(intrinsics, extrinsics, 200, 180).unwrap()
    }

    proptest! {
        #[test]
        fn gradients_of_projections_are_finite_differences(place in prop::array::uniform3(-1.0f32..1.0)) {
            let (camera, place) = (camera(), Vec3::from(place));
            let (_, gradients) = projected(&camera, place).unwrap();
            for axis in Vec3::AXES {
                let at = |by: f32| projected(&camera, place + by * axis).unwrap().0;
                let numeric = (at(1e-2) - at(-1e-2)) / 2e-2;
                let exact = Vec2::from_array(gradients.map(|gradient| gradient.dot(axis)));
                prop_assert!(exact.distance(numeric) < 0.02 * (1.0 + exact.length()), "{exact} {numeric}");
            }
        }
    }

    #[test]
    fn offsets_in_the_axes_of_bones_and_the_noise_are_found_beside_outliers() {
        let (model, camera) = (BodyModel::embedded(), camera());
        let mut random = RandomStream::new(&[4]);
        let mut vector = |size: f32| size * Vec3::new(random.normal(), random.normal(), random.normal());
        let truth: Vec<Vec3> = (0..model.num_joints()).map(|_| vector(0.03)).collect();
        let shape = model.shaped(&[]);
        let mut made = Vec::new();
        for frame in 0..60 {
            let mut pose: Vec<Vec3> = (0..model.num_joints()).map(|_| vector(0.3)).collect();
            pose[0] = Vec3::Y * frame as f32;
            let posed = model.pose(&shape, &pose, Placement::default());
            let point = |joint: usize| {
                let place = posed.joints[joint] + posed.bones[joint].matrix3 * truth[joint];
                let lost = if (frame + joint).is_multiple_of(7) { 40.0 } else { 0.0 };
                let place = camera.project(place).unwrap().truncate() + vector(2.0).truncate() + lost;
                Keypoint { joint, place, confidence: 0.9 }
            };
            let points: Vec<Keypoint> = [1, 4, 7, 16, 18, 20].map(point).to_vec();
            made.push((points, posed));
        }
        let frames: Vec<FramePoints<'_>> =
            made.iter().map(|(points, posed)| FramePoints { camera: &camera, points, posed }).collect();
        let found = DetectorModel::measure(&frames, model.num_joints(), 1.0);
        assert!((1.6..2.6).contains(&found.noise), "{}", found.noise);
        for joint in [1, 4, 7, 16, 18, 20] {
            let off = found.offsets[joint].distance(truth[joint]);
            assert!(off < 0.02 && off < 0.5 * truth[joint].length(), "joint {joint}: {off} of {}", truth[joint]);
        }
        assert_eq!(found.offsets[2], Vec3::ZERO);
        assert_eq!(DetectorModel::measure(&[], 24, 1.0).noise, NOISE);
    }
}
