//! Motions of a skeleton.

use glam::{Affine3A, Mat3, Quat, Vec3};
use smpl::{Joint, MotionClip};

/// Rotation from the direction `up` of a capture's world to +y; the identity for a zero `up`.
#[must_use]
pub fn turn_upright(up: Vec3) -> Mat3 {
    up.try_normalize().map_or(Mat3::IDENTITY, |up| Mat3::from_quat(Quat::from_rotation_arc(up, Vec3::Y)))
}

/// The motion whose joint j of `skeleton` (J) has the canonical to world transform `frames[t][j]`
/// (T, J).
///
/// Bones that do not meet at their joints, as of a body that changes its size, keep their rotations
/// and the root's position.
///
/// # Panics
/// Unless every frame has J transforms.
#[must_use]
pub fn motion_of_bones(skeleton: &[Joint], frames: &[Vec<Affine3A>], fps: f32) -> MotionClip {
    let mut poses = Vec::with_capacity(frames.len() * skeleton.len());
    let mut trans = Vec::with_capacity(frames.len());
    for bones in frames {
        assert_eq!(bones.len(), skeleton.len(), "motion_of_bones: transforms of joints");
        let turns: Vec<Quat> = bones.iter().map(|bone| Quat::from_mat3a(&bone.matrix3).normalize()).collect();
        for (joint, &turn) in skeleton.iter().zip(&turns) {
            let parent = joint.parent.map_or(Quat::IDENTITY, |parent| turns[usize::from(parent)]);
            let local = parent.inverse() * turn;
            // Quaternion of the smaller angle.
            let shorter = if local.w < 0.0 { -local } else { local };
            poses.push(shorter.to_scaled_axis());
        }
        let moved = |(bone, joint): (&Affine3A, &Joint)| bone.transform_point3(joint.rest) - joint.rest;
        trans.push(bones.iter().zip(skeleton).next().map_or(Vec3::ZERO, moved));
    }
    MotionClip { poses, num_joints: skeleton.len(), trans, fps }
}
