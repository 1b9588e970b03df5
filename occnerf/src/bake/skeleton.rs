//! The skeleton of a body model with SMPL's joint names, and its motions.

use glam::{Affine3A, Mat3, Quat, Vec3};
use smpl::MotionClip;

use super::avatar::Joint;

/// SMPL's 24 joints, and their parents.
const SMPL: &str = "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 \
    left_foot right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow \
    left_wrist right_wrist left_hand right_hand";
const SMPL_PARENTS: [usize; 24] = [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21];
/// Joints that SMPL shares with SMPL-H and SMPL-X.
const SHARED: usize = 22;

/// Joints of a body model's `parents` at canonical positions `rest`, (J). Joints of SMPL's tree have
/// SMPL's names, all others `joint_07`.
#[must_use]
pub fn skeleton(parents: &[Option<usize>], rest: &[Vec3]) -> Vec<Joint> {
    let alike = |joint: usize| parents.get(joint).is_some_and(|p| p.unwrap_or(0) == SMPL_PARENTS[joint]);
    let known = match parents.len() {
        24 => 24,
        52 | 55 => SHARED,
        _ => 0,
    };
    let known = if (0..known).all(alike) { known } else { 0 };
    let joint = |(j, (parent, &rest)): (usize, (&Option<usize>, &Vec3))| Joint {
        name: SMPL.split(' ').take(known).nth(j).map_or_else(|| format!("joint_{j:02}"), str::to_owned),
        parent: parent.and_then(|p| u16::try_from(p).ok()),
        rest,
    };
    parents.iter().zip(rest).enumerate().map(joint).collect()
}

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
