//! Motion capture: clips in SMPL parameters, BVH files, and retargeting between skeletons.

mod bvh;
mod skeleton;

use std::path::Path;

use array_files::npz::Npz;
use glam::{Quat, Vec3};

use crate::Error;
use crate::model::check_vectors;
use crate::pose::Placement;

pub use bvh::Bvh;
pub use skeleton::{BoneNames, Joint, joint_transforms, skeleton};

/// Joints that SMPL, SMPL-H and SMPL-X share: the body without hands and face.
const SHARED: usize = 22;
/// Finger joints of both hands in SMPL-H and SMPL-X.
const FINGERS: usize = 30;
/// Largest rotation accepted, in radians.
const MAX_ANGLE: f32 = 1e3;

/// A motion of T frames and J joints, for bodies in SMPL's form.
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, MotionClip, Placement};
///
/// // Two frames: the left knee (joint 4) bends by 1 rad while the body moves 1 m forward.
/// let mut poses = vec![Vec3::ZERO; 48];
/// poses[24 + 4].x = 1.0;
/// let clip = MotionClip { poses, num_joints: 24, trans: vec![Vec3::ZERO, Vec3::Z], fps: 30.0 };
/// let body = BodyModel::embedded();
/// let (pose, placement) = clip.at(0.5 / 30.0, body.num_joints());
/// assert!((pose[4].x - 0.5).abs() < 1e-6);
/// assert_eq!(placement, Placement::Pelvis { translation: 0.5 * Vec3::Z });
/// let posed = body.pose(&body.shaped(&[]), &pose, placement);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct MotionClip {
    /// Axis-angle rotations relative to the parent, (T·J): those of the first frame first.
    pub poses: Vec<Vec3>,
    /// Joints per frame, J.
    pub num_joints: usize,
    /// Translation of the body, (T), in metres.
    pub trans: Vec<Vec3>,
    /// Frames per second.
    pub fps: f32,
}

impl MotionClip {
    /// Reads an `.npz` as in AMASS (156 columns for SMPL-H, 165 for SMPL-X), which is z up:
    /// rotations `poses` (T, 3J) or (T, J, 3), or, of the body, `root_orient` and `pose_body`, or
    /// `global_orient` and `body_pose`; translations `trans` or `transl` (T, 3); one of `fps`,
    /// `mocap_framerate` and `mocap_frame_rate`, without which [`MotionClip::ASSUMED_FPS`] is
    /// taken. Other arrays are ignored.
    ///
    /// # Errors
    /// Any [`Error`] of arrays; [`Error::Invalid`] without frames, for a rate that is not positive,
    /// and for rotations beyond 1000 rad or translations beyond 10⁶.
    pub fn load(path: &Path) -> Result<Self, Error> {
        Self::load_with_rate(path).map(|(clip, _)| clip)
    }

    /// The same, and the frames per second as the file says them; `None` where it does not.
    ///
    /// # Errors
    /// As [`MotionClip::load`].
    pub fn load_with_rate(path: &Path) -> Result<(Self, Option<f32>), Error> {
        let mut npz = Npz::open(path)?;
        let file = npz.file().to_owned();
        let rate = rate(&mut npz)?;
        let fps = rate.unwrap_or(Self::ASSUMED_FPS);
        let has = |npz: &Npz, key: &str| npz.keys().iter().any(|k| k == key);
        let parts = [["root_orient", "pose_body"], ["global_orient", "body_pose"]];
        let keys = match parts.iter().find(|parts| parts.iter().all(|key| has(&npz, key))) {
            Some(parts) if !has(&npz, "poses") => parts.to_vec(),
            _ => vec!["poses"],
        };
        let mut parts = Vec::new();
        for key in keys {
            let array = npz.array(key)?;
            let width = array.shape.iter().skip(1).product::<usize>();
            if array.shape.len() < 2 || array.shape[0] == 0 || width == 0 || !width.is_multiple_of(3) {
                let message = format!("shape {:?}, expected (T, 3J) or (T, J, 3)", array.shape);
                return Err(Error::invalid(&file, key, message));
            }
            let values = array.to_f32(&file, key, &vec![None; array.shape.len()])?;
            parts.push((key, array.shape[0], width, values));
        }
        let frames = parts[0].1;
        if let Some((key, found, ..)) = parts.iter().find(|part| part.1 != frames) {
            return Err(Error::invalid(&file, key, format!("{found} frames, expected {frames}")));
        }
        let key = if has(&npz, "transl") && !has(&npz, "trans") { "transl" } else { "trans" };
        let (_, trans) = npz.f32(key, &[Some(frames), Some(3)])?;
        let vectors = |values: &[f32]| values.chunks_exact(3).map(Vec3::from_slice).collect::<Vec<_>>();
        let row = |frame: usize| parts.iter().map(move |(_, _, width, values)| &values[frame * width..][..*width]);
        let poses: Vec<Vec3> = (0..frames).flat_map(row).flat_map(vectors).collect();
        let clip = Self { num_joints: poses.len() / frames, poses, trans: vectors(&trans), fps };
        check_vectors(&file, key, &clip.trans)?;
        match clip.poses.iter().position(|r| r.length() > MAX_ANGLE) {
            Some(i) => Err(Error::invalid(&file, "poses", format!("a rotation of {} rad", clip.poses[i].length()))),
            None => Ok((clip, rate)),
        }
    }

    /// Frames per second of a clip that does not say.
    pub const ASSUMED_FPS: f32 = 30.0;

    /// Number of frames, T.
    pub fn num_frames(&self) -> usize {
        self.trans.len()
    }

    /// Time from the first frame to the last, in seconds.
    pub fn duration(&self) -> f32 {
        self.num_frames().saturating_sub(1) as f32 / self.fps
    }

    /// The pose and placement at `seconds`, for a body of `joints` joints.
    ///
    /// Between frames, rotations are interpolated along the shorter great arc and translations
    /// linearly; time is clamped to the clip. A body with as many joints as the clip gets all of
    /// them. Otherwise the first 22, which SMPL, SMPL-H and SMPL-X share, are copied, fingers are
    /// mapped between SMPL-H (52 joints) and SMPL-X (55), and every other joint (SMPL's two hands,
    /// jaw and eyes) stays at rest.
    ///
    /// # Panics
    /// If the clip has no frames, or `poses` does not have T·J entries.
    pub fn at(&self, seconds: f32, joints: usize) -> (Vec<Vec3>, Placement) {
        let frames = self.num_frames();
        assert!(frames > 0, "at: a clip without frames");
        assert_eq!(self.poses.len(), frames * self.num_joints, "at: rotations of the clip");
        // NaN counts as the start.
        let position = (f64::from(seconds) * f64::from(self.fps)).max(0.0).min((frames - 1) as f64);
        let first = position.floor() as usize;
        let second = (first + 1).min(frames - 1);
        let s = (position - first as f64) as f32;
        let turn = |joint: usize| {
            let at = |frame: usize| self.poses[frame * self.num_joints + joint];
            if s == 0.0 {
                return at(first);
            }
            let [a, b] = [at(first), at(second)].map(Quat::from_scaled_axis);
            a.slerp(b, s).to_scaled_axis()
        };
        let pose = (0..joints).map(|j| source(self.num_joints, joints, j).map_or(Vec3::ZERO, turn)).collect();
        (pose, Placement::Pelvis { translation: self.trans[first].lerp(self.trans[second], s) })
    }
}

/// Frames per second, if the archive says.
fn rate(npz: &mut Npz) -> Result<Option<f32>, Error> {
    let rates = ["fps", "mocap_framerate", "mocap_frame_rate"];
    let Some(key) = rates.into_iter().find(|rate| npz.keys().iter().any(|key| key == rate)) else { return Ok(None) };
    match npz.array(key)?.to_f64().as_slice() {
        [rate] if (1e-3..=1e6).contains(rate) => Ok(Some(*rate as f32)),
        rate => Err(Error::invalid(npz.file(), key, format!("{rate:?} frames per second"))),
    }
}

/// The joint of a clip of `clip` joints that drives joint `joint` of a body of `body` joints.
fn source(clip: usize, body: usize, joint: usize) -> Option<usize> {
    if clip == body || joint < SHARED {
        return Some(joint).filter(|&j| j < clip);
    }
    let fingers = |joints: usize| match joints {
        52 => Some(SHARED),
        55 => Some(SHARED + 3),
        _ => None,
    };
    let finger = joint.checked_sub(fingers(body)?).filter(|&f| f < FINGERS)?;
    Some(fingers(clip)? + finger)
}
