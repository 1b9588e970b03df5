//! Motion capture for the embedded person and for characters whose joints have known names.

use std::f32::consts::{FRAC_PI_2, TAU};

use glam::{Affine3A, Quat, Vec3};
use rayon::prelude::*;
use smpl::{BodyModel, BoneNames, Bvh, Joint, MotionClip, Placement, Shaped, joint_transforms};

use crate::demo::landmarks::joint;
use crate::demo::motion::Pose;
use capture::CaptureError;

/// Radius of what a person needs around the axis, in the heights that cameras stand for.
const REACH: f32 = 0.6;

/// Time of frame `i` of `frames` that show all of `duration` seconds.
pub(super) fn seconds(duration: f32, i: usize, frames: usize) -> f32 {
    duration * i as f32 / frames.saturating_sub(1).max(1) as f32
}

/// To the origin from `at`, its height kept, then `turns` turns over the video.
pub(super) fn brought(at: Vec3, turns: f32, i: usize, frames: usize) -> Affine3A {
    let angle = TAU * turns * i as f32 / frames as f32;
    Affine3A::from_rotation_y(angle) * Affine3A::from_translation(-Vec3::new(at.x, 0.0, at.z))
}

/// What all frames reach: lowest and highest point, and distance from the axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extent {
    pub low: f32,
    high: f32,
    radius: f32,
}

impl Extent {
    pub fn of(vertices: &[Vec3]) -> Self {
        let start = Self { low: f32::INFINITY, high: f32::NEG_INFINITY, radius: 0.0 };
        vertices.iter().fold(start, |e, v| Self {
            low: e.low.min(v.y),
            high: e.high.max(v.y),
            radius: e.radius.max(v.x.hypot(v.z)),
        })
    }

    /// That of all frames together.
    pub fn all(frames: Vec<Self>) -> Self {
        frames.into_iter().fold(Self::of(&[]), |sum, e| Self {
            low: sum.low.min(e.low),
            high: sum.high.max(e.high),
            radius: sum.radius.max(e.radius),
        })
    }

    /// From the lowest to the highest point.
    pub fn height_alone(self) -> f32 {
        self.high - self.low
    }

    /// The height that cameras must stand for to see everything.
    pub fn height(self) -> f32 {
        self.height_alone().max(self.radius / REACH)
    }
}

/// The turn that sets a clip upright: captures have y up, or z.
fn upright(clip: &MotionClip) -> Quat {
    let roots = clip.poses.iter().step_by(clip.num_joints.max(1));
    let up: Vec3 = roots.map(|&root| Quat::from_scaled_axis(root) * Vec3::Y).sum();
    if up.z.abs() > up.y.abs() { Quat::from_rotation_x(-FRAC_PI_2 * up.z.signum()) } else { Quat::IDENTITY }
}

/// The embedded person moving as in `clip`, and the height that cameras must stand for.
pub(super) fn embedded(
    clip: &MotionClip,
    frames: usize,
    turns: f32,
    body: &BodyModel,
    shaped: &Shaped,
) -> (Vec<Pose>, f32) {
    let (up, pelvis) = (upright(clip), shaped.joints[joint::PELVIS]);
    let mut poses: Vec<Pose> = (0..frames)
        .map(|i| {
            let (mut joints, translation) = sample(clip, seconds(clip.duration(), i, frames), body.num_joints());
            let root = Quat::from_scaled_axis(std::mem::take(&mut joints[joint::PELVIS]));
            let at = up * (pelvis + translation);
            let place = brought(at, turns, i, frames);
            let rotation = (Quat::from_mat3a(&place.matrix3) * up * root).normalize();
            Pose { joints, rotation, translation: place.transform_point3(at) - rotation * pelvis }
        })
        .collect();
    let extents: Vec<Extent> =
        poses.par_iter().map(|pose| Extent::of(&body.pose(shaped, &pose.joints, pose.placement()).vertices)).collect();
    let extent = Extent::all(extents);
    poses.iter_mut().for_each(|pose| pose.translation.y -= extent.low);
    (poses, extent.height())
}

fn sample(clip: &MotionClip, seconds: f32, joints: usize) -> (Vec<Vec3>, Vec3) {
    let (pose, placement) = clip.at(seconds, joints);
    match placement {
        Placement::Pelvis { translation } | Placement::Origin { translation, .. } => (pose, translation),
    }
}

/// Rest to world, (J), of a skeleton that rests y up and faces +z, at each of `frames` that show
/// all of `clip`, which is of SMPL's joints.
///
/// # Errors
/// What the skeleton lacks by name.
pub(super) fn driven(clip: &MotionClip, frames: usize, skeleton: &[Joint]) -> Result<Vec<Vec<Affine3A>>, CaptureError> {
    let body = BodyModel::embedded();
    let (mut poses, mut trans) = (Vec::new(), Vec::new());
    for i in 0..frames {
        let (pose, translation) = sample(clip, seconds(clip.duration(), i, frames), joint::COUNT);
        poses.extend(pose);
        trans.push(translation);
    }
    let source = Bvh {
        skeleton: smpl::skeleton(BoneNames::Smpl, &body.parents, &body.shaped(&[]).joints),
        motion: MotionClip { poses, num_joints: joint::COUNT, trans, fps: clip.fps },
        unit: "m",
    };
    let motion = source.onto(skeleton).map_err(|fault| {
        let expected = "a character whose joints have the names of MakeHuman, Mixamo, Unreal or SMPL";
        CaptureError::setting("motion", expected, fault)
    })?;
    let up = Affine3A::from_quat(upright(clip));
    let frame = |(pose, &translation): (&[Vec3], &Vec3)| {
        joint_transforms(skeleton, pose, translation).into_iter().map(|bone| up * bone).collect()
    };
    Ok(motion.poses.chunks_exact(motion.num_joints).zip(&motion.trans).map(frame).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_skeleton_that_a_clip_was_made_for_follows_it() {
        let body = BodyModel::embedded();
        let human = body.shaped(&[]);
        let mut skeleton = smpl::skeleton(BoneNames::Smpl, &body.parents, &human.joints);
        let mut poses = vec![Vec3::ZERO; 2 * joint::COUNT];
        for (j, pose) in poses.iter_mut().enumerate() {
            let j = j as f32;
            *pose = Vec3::new((1.7 * j).sin(), (2.3 * j).cos(), (3.1 * j).sin()) * 0.3;
        }
        let clip = MotionClip { poses, num_joints: 24, trans: vec![Vec3::new(0.2, 0.1, 0.3); 2], fps: 30.0 };
        let bones = &driven(&clip, 1, &skeleton).unwrap()[0];
        let (pose, placement) = clip.at(0.0, 24);
        let posed = body.pose(&human, &pose, placement);
        for (j, (bone, expected)) in bones.iter().zip(&posed.bones).enumerate() {
            let at = human.joints[j] + Vec3::new(0.1, 0.2, -0.1);
            let off = bone.transform_point3(at).distance(expected.transform_point3(at));
            assert!(off < 1e-4, "{}: {off}", skeleton[j].name);
        }
        skeleton.iter_mut().for_each(|joint| joint.name.clear());
        let message = driven(&clip, 1, &skeleton).unwrap_err().to_string();
        assert!(message.contains("motion") && message.contains("left forearm"), "{message}");
    }

    #[test]
    fn captures_with_z_up_are_set_upright() {
        let clip = |root: Vec3| MotionClip { poses: vec![root], num_joints: 1, trans: vec![Vec3::ZERO], fps: 30.0 };
        for root in [Vec3::ZERO, Vec3::X * FRAC_PI_2, Vec3::X * 1.2, Vec3::Y * 2.0] {
            let up = upright(&clip(root)) * Quat::from_scaled_axis(root) * Vec3::Y;
            assert!(up.y > 0.9, "{root}: {up}");
        }
    }
}
