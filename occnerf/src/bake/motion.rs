//! Motions of the skeleton from transforms of the bones.

use glam::{Affine3A, Mat3, Quat, Vec3};
use smpl::MotionClip;

use super::avatar::Joint;

/// The rotation that takes the direction `up` of a capture's world to +y; none where `up` has no
/// direction.
#[must_use]
pub fn turn_upright(up: Vec3) -> Mat3 {
    up.try_normalize().map_or(Mat3::IDENTITY, |up| Mat3::from_quat(Quat::from_rotation_arc(up, Vec3::Y)))
}

/// The motion in which joint j of `skeleton` (J) carries canonical points to the world by
/// `frames[t][j]` (T, J).
///
/// Bones that do not hang together, as those of a body that changes its size from frame to frame,
/// keep their rotations and the root's place.
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
            // Of the two quaternions of a rotation, the one of at most half a turn.
            let shorter = if local.w < 0.0 { -local } else { local };
            poses.push(shorter.to_scaled_axis());
        }
        let moved = |(bone, joint): (&Affine3A, &Joint)| bone.transform_point3(joint.rest) - joint.rest;
        trans.push(bones.iter().zip(skeleton).next().map_or(Vec3::ZERO, moved));
    }
    MotionClip { poses, num_joints: skeleton.len(), trans, fps }
}
