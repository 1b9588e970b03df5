//! Motion capture for the embedded person and for characters whose joints have known names.

use std::f32::consts::{FRAC_PI_2, TAU};

use glam::{Affine3A, Quat, Vec3};
use rayon::prelude::*;
use smpl::{BodyModel, BoneNames, MotionClip, Placement, Shaped};

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

/// SMPL's joint for each of a character's, told by their names; `None` for those that follow their
/// parents.
fn assign(names: &[&str]) -> Vec<Option<usize>> {
    let smpl = BoneNames::Smpl.of_body(joint::COUNT);
    let found = BoneNames::Smpl.translate(names).into_iter();
    found.map(|name| name.and_then(|name| smpl.iter().position(|own| *own == name))).collect()
}

/// A skeleton to be driven: joints at rest, y up, facing +z, and their parents, each before its
/// children.
pub(super) struct Skeleton<'a> {
    pub names: &'a [&'a str],
    pub joints: &'a [Vec3],
    pub parents: &'a [Option<usize>],
    /// Length of a metre of a person 1.7 m tall.
    pub unit: f32,
}

impl Skeleton<'_> {
    /// Rest to world, (J), at each frame of `clip`.
    ///
    /// A bone takes the orientation in the world of its counterpart, with the limbs' directions at
    /// rest made up for.
    pub fn driven(&self, clip: &MotionClip, frames: usize) -> Result<Vec<Vec<Affine3A>>, CaptureError> {
        let assigned = assign(self.names);
        let place_of = |s: usize| assigned.iter().position(|a| *a == Some(s));
        let needed = [
            (joint::PELVIS, "hips"),
            (joint::LEFT_HIP, "left upper leg"),
            (joint::RIGHT_HIP, "right upper leg"),
            (joint::LEFT_KNEE, "left lower leg"),
            (joint::RIGHT_KNEE, "right lower leg"),
            (joint::LEFT_SHOULDER, "left upper arm"),
            (joint::RIGHT_SHOULDER, "right upper arm"),
            (joint::LEFT_ELBOW, "left forearm"),
            (joint::RIGHT_ELBOW, "right forearm"),
        ];
        let missing: Vec<&str> = needed.iter().filter(|(s, _)| place_of(*s).is_none()).map(|(_, name)| *name).collect();
        if !missing.is_empty() {
            let expected = "a character whose joints have the names of MakeHuman, Mixamo, Unreal or SMPL";
            return Err(CaptureError::setting("motion", expected, format!("none for {}", missing.join(", "))));
        }
        let body = BodyModel::embedded();
        let human = body.shaped(&[]);
        // What turns the limb at rest into the counterpart's.
        let mut aligned = vec![Quat::IDENTITY; joint::COUNT];
        for (s, child) in [(1, 4), (2, 5), (4, 7), (5, 8), (16, 18), (17, 19), (18, 20), (19, 21)] {
            if let (Some(from), Some(to)) = (place_of(s), place_of(child)) {
                let direction = |a: Vec3, b: Vec3| (b - a).normalize_or(Vec3::NEG_Y);
                let own = direction(self.joints[from], self.joints[to]);
                aligned[s] = Quat::from_rotation_arc(own, direction(human.joints[s], human.joints[child]));
            }
        }
        (aligned[20], aligned[21]) = (aligned[18], aligned[19]);

        let up = upright(clip);
        let frame = |i: usize| {
            let (pose, translation) = sample(clip, seconds(clip.duration(), i, frames), joint::COUNT);
            let mut global: Vec<Quat> = Vec::with_capacity(pose.len());
            for (turn, parent) in pose.iter().zip(&body.parents) {
                let above = parent.map_or(up, |p| global[p]);
                global.push((above * Quat::from_scaled_axis(*turn)).normalize());
            }
            let root = up * (human.joints[joint::PELVIS] + translation) * self.unit;
            let mut turns: Vec<Quat> = Vec::with_capacity(self.joints.len());
            let mut places: Vec<Vec3> = Vec::with_capacity(self.joints.len());
            for (j, parent) in self.parents.iter().enumerate() {
                let above = parent.map_or(up, |p| turns[p]);
                turns.push(assigned[j].map_or(above, |s| global[s] * aligned[s]));
                places.push(parent.map_or(root, |p| places[p] + above * (self.joints[j] - self.joints[p])));
            }
            (0..self.joints.len())
                .map(|j| {
                    Affine3A::from_rotation_translation(turns[j], places[j])
                        * Affine3A::from_translation(-self.joints[j])
                })
                .collect()
        };
        Ok((0..frames).map(frame).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_skeleton_that_a_clip_was_made_for_follows_it() {
        let body = BodyModel::embedded();
        let human = body.shaped(&[]);
        let names = BoneNames::Smpl.of_body(joint::COUNT);
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let mut poses = vec![Vec3::ZERO; 2 * joint::COUNT];
        for (j, pose) in poses.iter_mut().enumerate() {
            let j = j as f32;
            *pose = Vec3::new((1.7 * j).sin(), (2.3 * j).cos(), (3.1 * j).sin()) * 0.3;
        }
        let clip = MotionClip { poses, num_joints: 24, trans: vec![Vec3::new(0.2, 0.1, 0.3); 2], fps: 30.0 };
        let skeleton = Skeleton { names: &names, joints: &human.joints, parents: &body.parents, unit: 1.0 };
        let bones = &skeleton.driven(&clip, 1).unwrap()[0];
        let (pose, placement) = clip.at(0.0, 24);
        let posed = body.pose(&human, &pose, placement);
        for (j, (bone, expected)) in bones.iter().zip(&posed.bones).enumerate() {
            let at = human.joints[j] + Vec3::new(0.1, 0.2, -0.1);
            let off = bone.transform_point3(at).distance(expected.transform_point3(at));
            assert!(off < 1e-4, "{}: {off}", names[j]);
        }
        let message = Skeleton { names: &[""; 24], ..skeleton }.driven(&clip, 1).unwrap_err().to_string();
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
