//! The skeleton of a body model with SMPL's joint names.

use glam::Vec3;

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
