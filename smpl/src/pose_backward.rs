//! Backward of shaping and posing.

use glam::{DMat3, DVec3, Mat3A, Vec3, Vec3A};
use rayon::prelude::*;

use crate::model::{BodyModel, Shaped, TERMS_PER_JOINT};
use crate::pose::{CHUNK, Placement, Posed, blend};
use crate::rotation::{rodrigues, rodrigues_backward};

/// Derivatives of a scalar with respect to the inputs of [`BodyModel::pose`], from
/// [`BodyModel::pose_backward`], which has an example.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseGradient {
    /// With respect to the axis-angle rotations, (J). The root's is 0 under [`Placement::Origin`].
    pub pose: Vec<Vec3>,
    /// With respect to the rest vertices, (V), and the rest joints, (J), as independent inputs:
    /// pass it to [`BodyModel::shaped_backward`].
    pub shaped: Shaped,
    /// With respect to the fields of the placement; the variant is that of the forward pass.
    pub placement: Placement,
}

/// Sums over one run of vertices.
struct Partial {
    /// ∂/∂ linear part and translation of every bone.
    bones: Vec<(Mat3A, Vec3A)>,
    /// ∂/∂ R − I of the non-root joints, (P).
    features: Vec<f32>,
}

/// Derivatives with respect to the outputs of the kinematic tree.
struct JointGradients<'a> {
    /// ∂/∂ linear part and translation of every bone, (J).
    bones: Vec<(DMat3, DVec3)>,
    /// ∂/∂ R − I of the non-root joints, (P).
    features: Vec<f64>,
    /// ∂/∂ posed joints, (J) or empty.
    joints: &'a [Vec3],
}

impl BodyModel {
    /// Propagates the gradient of [`BodyModel::pose`] from `d_vertices`, (V), and `d_joints`, (J)
    /// or empty for none, to the rotations, the rest body and the placement. `posed` is the
    /// forward's result for the same inputs.
    ///
    /// Derivatives with respect to `Posed::bones` and `Posed::pose_offsets` are not taken. The
    /// result does not depend on the number of threads. The rotations' part is smooth everywhere,
    /// zero and π included.
    ///
    /// Fitting a pose to vertices by gradient descent:
    ///
    /// ```
    /// use glam::Vec3;
    /// use smpl::{BodyModel, Placement};
    ///
    /// let body = BodyModel::embedded();
    /// let shaped = body.shaped(&[]);
    /// let mut wanted = vec![Vec3::ZERO; body.num_joints()];
    /// wanted[16] = Vec3::new(0.0, 0.0, -0.6); // left shoulder
    /// wanted[18] = Vec3::new(0.0, -0.9, 0.0); // left elbow
    /// let target = body.pose(&shaped, &wanted, Placement::default());
    ///
    /// let mut pose = vec![Vec3::ZERO; body.num_joints()];
    /// let mut errors = Vec::new();
    /// for _ in 0..60 {
    ///     let posed = body.pose(&shaped, &pose, Placement::default());
    ///     // loss ½ Σ |v − target|²
    ///     let d_vertices: Vec<Vec3> = posed.vertices.iter().zip(&target.vertices).map(|(v, t)| *v - *t).collect();
    ///     errors.push(d_vertices.iter().map(|d| d.length()).sum::<f32>() / d_vertices.len() as f32);
    ///     let gradient = body.pose_backward(&shaped, &pose, Placement::default(), &posed, &d_vertices, &[]);
    ///     for (joint, rate) in [(16, 0.005), (18, 0.02)] {
    ///         pose[joint] -= rate * gradient.pose[joint];
    ///     }
    /// }
    /// assert!(errors[59] < 0.05 * errors[0], "{errors:?}");
    /// ```
    ///
    /// # Panics
    /// If a length is not the model's.
    pub fn pose_backward(
        &self,
        shaped: &Shaped,
        pose: &[Vec3],
        placement: Placement,
        posed: &Posed,
        d_vertices: &[Vec3],
        d_joints: &[Vec3],
    ) -> PoseGradient {
        let (vertices, joints) = (self.num_vertices(), self.num_joints());
        assert_eq!(d_vertices.len(), vertices, "pose_backward: d_vertices");
        assert_eq!(shaped.vertices.len(), vertices, "pose_backward: vertices of the shaped body");
        assert_eq!(posed.pose_offsets.len(), vertices, "pose_backward: vertices of the posed body");
        assert!(d_joints.is_empty() || d_joints.len() == joints, "pose_backward: {} of d_joints", d_joints.len());
        assert_eq!(pose.len(), joints, "pose_backward: rotations of joints");
        assert_eq!((shaped.joints.len(), posed.bones.len()), (joints, joints), "pose_backward: joints");

        let mut d_rest = vec![Vec3::ZERO; vertices];
        let partials: Vec<Partial> = (d_rest.par_chunks_mut(CHUNK).enumerate())
            .map(|(chunk, d_rest)| {
                let start = chunk * CHUNK;
                pulp::Arch::new().dispatch(Run { body: self, shaped, posed, d_vertices, start, d_rest })
            })
            .collect();
        // Chunks have a fixed size and are summed in order: independent of the number of threads.
        let mut d_bones = vec![(DMat3::ZERO, DVec3::ZERO); joints];
        let mut d_features = vec![0.0f64; TERMS_PER_JOINT * (joints - 1)];
        for partial in &partials {
            for (sum, (matrix, translation)) in d_bones.iter_mut().zip(&partial.bones) {
                sum.0 += DMat3::from_cols_array(&matrix.to_cols_array().map(f64::from));
                sum.1 += Vec3::from(*translation).as_dvec3();
            }
            for (sum, d) in d_features.iter_mut().zip(&partial.features) {
                *sum += f64::from(*d);
            }
        }
        let d = JointGradients { bones: d_bones, features: d_features, joints: d_joints };
        let (d_pose, d_rest_joints, placement) = self.kinematics_backward(shaped, pose, placement, posed, d);
        PoseGradient { pose: d_pose, shaped: Shaped { vertices: d_rest, joints: d_rest_joints }, placement }
    }

    /// Backward of x = Σ w_i bones_i (rest + offset) and of the pose blend shapes, for a run of
    /// vertices from `start`.
    #[inline(always)]
    fn skin_backward(
        &self,
        shaped: &Shaped,
        posed: &Posed,
        d_vertices: &[Vec3],
        start: usize,
        d_rest: &mut [Vec3],
    ) -> Partial {
        let joints = self.num_joints();
        let mut out = Partial {
            bones: vec![(Mat3A::ZERO, Vec3A::ZERO); joints],
            features: vec![0.0; TERMS_PER_JOINT * (joints - 1)],
        };
        for (i, d_rest) in d_rest.iter_mut().enumerate() {
            let v = start + i;
            let d = Vec3A::from(d_vertices[v]);
            if d == Vec3A::ZERO {
                continue;
            }
            let rest = shaped.vertices[v] + posed.pose_offsets[v];
            let outer = Mat3A::from_cols(d * rest.x, d * rest.y, d * rest.z);
            for (joint, w) in self.weights.row(v) {
                let bone = &mut out.bones[joint];
                bone.0 += outer * w;
                bone.1 += d * w;
            }
            *d_rest = (blend(&posed.bones, self.weights.row(v)).matrix3.transpose() * d).into();
            let range = self.posedirs.offsets[v] as usize..self.posedirs.offsets[v + 1] as usize;
            for (&term, &direction) in self.posedirs.columns[range.clone()].iter().zip(&self.posedirs.values[range]) {
                out.features[term as usize] += direction.x * d_rest.x + direction.y * d_rest.y + direction.z * d_rest.z;
            }
        }
        out
    }

    /// Backward of the kinematic tree, to the rotations, the rest joints and the placement. With
    /// G_i the joint frames (R_i, t_i): bone_i = (R_i, t_i − R_i J_i), and R_i = R_p L_i, t_i = R_p
    /// (J_i − J_p) + t_p.
    fn kinematics_backward(
        &self,
        shaped: &Shaped,
        pose: &[Vec3],
        placement: Placement,
        posed: &Posed,
        d: JointGradients<'_>,
    ) -> (Vec<Vec3>, Vec<Vec3>, Placement) {
        let rest: Vec<DVec3> = shaped.joints.iter().map(|j| j.as_dvec3()).collect();
        let linear: Vec<DMat3> = posed.bones.iter().map(|b| glam::Mat3::from(b.matrix3).as_dmat3()).collect();
        let mut d_pose = vec![Vec3::ZERO; rest.len()];
        let mut d_rest_joints = vec![DVec3::ZERO; rest.len()];
        // ∂/∂R_i and ∂/∂t_i, from the bones first, then from the children.
        let mut d_linear = vec![DMat3::ZERO; rest.len()];
        let mut d_origin = vec![DVec3::ZERO; rest.len()];
        for (i, (d_matrix, d_translation)) in d.bones.into_iter().enumerate() {
            d_linear[i] = d_matrix - outer(d_translation, rest[i]);
            d_origin[i] = d_translation + d.joints.get(i).map_or(DVec3::ZERO, |d| d.as_dvec3());
            d_rest_joints[i] -= linear[i].transpose() * d_translation;
        }
        for i in (1..rest.len()).rev() {
            let Some(parent) = self.parents[i] else { continue };
            let local = rodrigues(pose[i]).as_dmat3();
            let to_parent = linear[parent].transpose();
            let (d_r, d_t) = (d_linear[i], d_origin[i]);
            d_linear[parent] += d_r * local.transpose() + outer(d_t, rest[i] - rest[parent]);
            d_origin[parent] += d_t;
            let d_bone = to_parent * d_t;
            d_rest_joints[i] += d_bone;
            d_rest_joints[parent] -= d_bone;
            let mut row_major = [0.0; TERMS_PER_JOINT];
            row_major.copy_from_slice(&d.features[TERMS_PER_JOINT * (i - 1)..TERMS_PER_JOINT * i]);
            let d_local = to_parent * d_r + DMat3::from_cols_array(&row_major).transpose();
            d_pose[i] = rodrigues_backward(pose[i], d_local);
        }
        let d_translation = d_origin[0].as_vec3();
        let placement = match placement {
            Placement::Pelvis { .. } => {
                d_rest_joints[0] += d_origin[0];
                d_pose[0] = rodrigues_backward(pose[0], d_linear[0]);
                Placement::Pelvis { translation: d_translation }
            }
            Placement::Origin { rotation, .. } => {
                d_rest_joints[0] += linear[0].transpose() * d_origin[0];
                let d_rotation = d_linear[0] + outer(d_origin[0], rest[0]);
                Placement::Origin { rotation: rodrigues_backward(rotation, d_rotation), translation: d_translation }
            }
        };
        (d_pose, d_rest_joints.iter().map(|d| d.as_vec3()).collect(), placement)
    }

    /// Propagates the gradient of [`BodyModel::shaped`] from `d_shaped`, derivatives with respect
    /// to rest vertices and rest joints, to all B betas. The joints' part goes through the
    /// regressor.
    ///
    /// ```
    /// use glam::Vec3;
    /// use smpl::{BodyModel, Shaped};
    ///
    /// let body = BodyModel::embedded();
    /// // d height / d β, for the height of vertex 0:
    /// let mut vertices = vec![Vec3::ZERO; body.num_vertices()];
    /// vertices[0] = Vec3::Y;
    /// let d_betas = body.shaped_backward(&Shaped { vertices, joints: vec![Vec3::ZERO; 24] });
    /// assert!((d_betas[0] - body.shapedirs[0].y).abs() < 1e-6);
    /// ```
    ///
    /// # Panics
    /// If a length is not the model's.
    pub fn shaped_backward(&self, d_shaped: &Shaped) -> Vec<f32> {
        assert_eq!(d_shaped.vertices.len(), self.num_vertices(), "shaped_backward: vertices");
        assert_eq!(d_shaped.joints.len(), self.num_joints(), "shaped_backward: joints");
        let mut d_vertices = d_shaped.vertices.clone();
        for (joint, &d) in d_shaped.joints.iter().enumerate() {
            for (v, w) in self.j_regressor.row(joint) {
                d_vertices[v] += w * d;
            }
        }
        let component = |directions: &[Vec3]| {
            let terms = directions.iter().zip(&d_vertices).map(|(s, d)| f64::from(s.dot(*d)));
            terms.sum::<f64>() as f32
        };
        self.shapedirs.par_chunks_exact(self.num_vertices().max(1)).map(component).collect()
    }
}

/// Consecutive vertices; a struct for the reason given in `pose.rs`.
struct Run<'a> {
    body: &'a BodyModel,
    shaped: &'a Shaped,
    posed: &'a Posed,
    d_vertices: &'a [Vec3],
    start: usize,
    d_rest: &'a mut [Vec3],
}

impl pulp::NullaryFnOnce for Run<'_> {
    type Output = Partial;

    #[inline(always)]
    fn call(self) -> Partial {
        self.body.skin_backward(self.shaped, self.posed, self.d_vertices, self.start, self.d_rest)
    }
}

/// a bᵀ.
fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}
