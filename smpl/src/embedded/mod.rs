//! The embedded body: an implicit surface around SMPL's skeleton, meshed and rigged when asked for.

mod blend;
mod decimate;
mod extract;
mod half;
mod rig;
mod shape;
mod tube;

use glam::Vec3;

use crate::model::BodyModel;

/// Height of the model's origin above the floor, metres; about where SMPL has it.
const ORIGIN: f32 = 1.15;

/// Vertices of half a body, those in the plane of symmetry included.
const HALF_VERTICES: usize = 2450;

impl BodyModel {
    /// A body that needs no file: SMPL's 24 joints in SMPL's order, T-pose, about 1.7 m tall, some
    /// 4,800 vertices of one closed surface without handles, mirror-symmetric in x.
    ///
    /// It is made by a program, not measured: proportions are those of an average adult, hands are
    /// mittens. Betas (plausible within ±2): 0 height, 1 weight, 2 feminine to masculine, 3 muscle,
    /// 4 head size, 5 belly, 6 chest, 7 torso width, 8 leg length, 9 arm length. Pose blend shapes
    /// restore the volume that linear blending loses at bent joints, to second order in the angle.
    ///
    /// The result is the same at every call. Each call builds it anew, a fraction of a second: keep
    /// it.
    #[must_use]
    pub fn embedded() -> Self {
        let half = extract::half_surface();
        let half = decimate::decimate(half, HALF_VERTICES);
        let half = extract::relax(half);
        let (vertices, faces) = half::mirror(&half);
        let weights = rig::skinning_weights(&vertices, &faces);
        let shapedirs = blend::shape_directions(&vertices, &faces);
        let j_regressor = rig::joint_regressor(&vertices);
        let origin = Vec3::Y * ORIGIN;
        let mut model = Self {
            v_template: vertices.iter().map(|&v| v - origin).collect(),
            faces,
            shapedirs,
            posedirs: crate::SparseRows::from_rows(vertices.iter().map(|_| None::<(u32, Vec3)>)),
            weights,
            j_regressor,
            parents: rig::parents(),
        };
        model.posedirs = blend::pose_directions(&model);
        model
    }
}
