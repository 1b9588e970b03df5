//! The skeleton of a body model with SMPL's joint names, and its motions.

use glam::{Affine3A, Mat3, Quat, Vec3};
use smpl::{BoneNames, Joint, MotionClip};

/// Parents of SMPL's 24 joints; its successors share the first 22.
const SMPL_PARENTS: [usize; 24] = [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21];

/// Joints of a body model's `parents` at canonical positions `rest`, (J). Joints of the trees of
/// SMPL, SMPL-H and SMPL-X have SMPL's names, all others `joint_07`.
#[must_use]
pub fn skeleton(parents: &[Option<usize>], rest: &[Vec3]) -> Vec<Joint> {
    let names = BoneNames::Smpl.of_body(parents.len());
    let shared = if parents.len() == 24 { 24 } else { 22 };
    let alike = (SMPL_PARENTS[..shared].iter().zip(parents)).all(|(smpl, parent)| parent.unwrap_or(0) == *smpl);
    let joint = |(j, (parent, &rest)): (usize, (&Option<usize>, &Vec3))| Joint {
        name: names.get(j).filter(|_| alike).map_or_else(|| format!("joint_{j:02}"), Clone::clone),
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
