//! Export and retargeting of motion clips in AMASS's form.

use std::path::Path;

use array_files::{Data, NdArray, npz};
use glam::{Mat3, Quat, Vec3};
use smpl::{MotionClip, Placement};

use crate::Error;
use crate::bake::{Avatar, turn_upright};

/// Joint counts of SMPL and its successors, whose first 22 joints are the same.
const SMPL_FAMILY: [usize; 3] = [24, 52, 55];

/// Writes clip `clip` as an AMASS `.npz`: `poses` (T, 3J) axis-angle, `trans` (T, 3) of the root,
/// `betas`, `mocap_framerate`, `gender` (`neutral`). As in AMASS z is up; lengths are metres.
///
/// # Errors
/// [`Error::Bake`] if there is no such clip; [`Error::Array`] where the file cannot be written.
pub fn write_amass(avatar: &Avatar, clip: usize, path: &Path) -> Result<(), Error> {
    let found = avatar.clips.get(clip);
    let motion =
        &found.ok_or_else(|| Error::Bake(format!("no motion {clip}: there are {}", avatar.clips.len())))?.motion;
    let root = avatar.skeleton.first().map_or(Vec3::ZERO, |joint| joint.rest);
    let motion = turned(motion, Mat3::from_rotation_x(std::f32::consts::FRAC_PI_2), root);
    let (frames, j) = (motion.num_frames(), motion.num_joints);
    let flat = |values: &[Vec3]| Data::F32(values.iter().flat_map(|v| v.to_array()).collect());
    let arrays = [
        ("poses", NdArray { shape: vec![frames, 3 * j], data: flat(&motion.poses) }),
        ("trans", NdArray { shape: vec![frames, 3], data: flat(&motion.trans) }),
        ("betas", NdArray { shape: vec![avatar.betas.len()], data: Data::F32(avatar.betas.clone()) }),
        ("mocap_framerate", NdArray { shape: vec![], data: Data::F64(vec![f64::from(motion.fps)]) }),
    ];
    npz::write_with_text(path, &arrays, &[("gender", "neutral")])?;
    Ok(())
}

/// The motion in a world rotated by `turn`; `root` is the rest position of the root joint.
fn turned(motion: &MotionClip, turn: Mat3, root: Vec3) -> MotionClip {
    let mut out = motion.clone();
    let about = Quat::from_mat3(&turn);
    for pose in out.poses.iter_mut().step_by(motion.num_joints.max(1)) {
        *pose = (about * Quat::from_scaled_axis(*pose)).normalize().to_scaled_axis();
    }
    out.trans.iter_mut().for_each(|t| *t = turn * (root + *t) - root);
    out
}

/// Fits motion capture to a body of `to` joints whose root rests at `root`, in metres: y up, and a
/// rotation for each joint (see [`MotionClip::at`]).
///
/// # Errors
/// [`Error::Bake`] for a motion of another skeleton: neither the same number of joints nor both of
/// SMPL's family.
pub fn fit_motion(motion: &MotionClip, to: usize, root: Vec3) -> Result<MotionClip, Error> {
    let from = motion.num_joints;
    if from != to && !(SMPL_FAMILY.contains(&from) && SMPL_FAMILY.contains(&to)) {
        let expected = format!("{to}, or SMPL's {SMPL_FAMILY:?} for both");
        return Err(Error::Bake(format!("motion of another skeleton: expected joints: {expected}, found {from}")));
    }
    let frames = motion.num_frames();
    let (mut poses, mut trans) = (Vec::with_capacity(frames * to), Vec::with_capacity(frames));
    for frame in 0..frames {
        // One frame at a time, without interpolation.
        let row = motion.poses[frame * from..][..from].to_vec();
        let still = MotionClip { poses: row, num_joints: from, trans: vec![motion.trans[frame]], fps: motion.fps };
        let (pose, placement) = still.at(0.0, to);
        let (Placement::Pelvis { translation } | Placement::Origin { translation, .. }) = placement;
        poses.extend(pose);
        trans.push(translation);
    }
    let fitted = MotionClip { poses, num_joints: to, trans, fps: motion.fps };
    // World axis nearest to the body's mean upward direction.
    let upward: Vec3 =
        (fitted.poses.iter().step_by(to.max(1))).map(|&turn| Quat::from_scaled_axis(turn) * Vec3::Y).sum();
    let axes = [Vec3::Y, Vec3::Z, Vec3::X];
    let nearest = axes.into_iter().max_by(|a, b| upward.dot(*a).abs().total_cmp(&upward.dot(*b).abs()));
    let up = nearest.map_or(Vec3::Y, |axis| axis * upward.dot(axis).signum());
    Ok(turned(&fitted, turn_upright(up), root))
}
