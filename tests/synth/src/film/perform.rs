//! Motion capture for the embedded person and for characters whose joints have known names.

use std::f32::consts::{FRAC_PI_2, TAU};

use glam::{Affine3A, Quat, Vec3};
use rayon::prelude::*;
use smpl::{BodyModel, MotionClip, Placement, Shaped};

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
    let read: Vec<(Option<usize>, String)> = names.iter().map(|name| side_and_base(name)).collect();
    let has_collars = read.iter().any(|(_, base)| matches!(base.as_str(), "collar" | "clavicle"));
    let mut taken = [false; joint::COUNT];
    let mut spine = joint::SPINE.into_iter();
    let mut assigned = Vec::with_capacity(names.len());
    for (side, base) in &read {
        let found = match (side, base.trim_end_matches(|c: char| c.is_ascii_digit())) {
            // Left is the first of each of SMPL's pairs.
            (Some(side), "upleg" | "hip" | "thigh" | "upperleg") => Some(joint::LEFT_HIP + side),
            (Some(side), "leg" | "knee" | "calf" | "lowerleg" | "shin") => Some(joint::LEFT_KNEE + side),
            (Some(side), "foot" | "ankle") => Some(joint::LEFT_ANKLE + side),
            (Some(side), "shoulder") if has_collars => Some(joint::LEFT_SHOULDER + side),
            (Some(side), "shoulder" | "collar" | "clavicle") => Some(13 + side),
            (Some(side), "arm" | "upperarm") => Some(joint::LEFT_SHOULDER + side),
            (Some(side), "forearm" | "lowerarm" | "elbow") => Some(joint::LEFT_ELBOW + side),
            (Some(side), "hand" | "wrist") => Some(joint::LEFT_ELBOW + 2 + side),
            (None, "hips" | "pelvis") => Some(joint::PELVIS),
            (None, "spine" | "lowerback" | "chest" | "abdomen") => spine.next(),
            (None, "neck") => Some(joint::NECK),
            (None, "head") => Some(joint::HEAD),
            _ => None,
        };
        assigned.push(found.filter(|&s| !std::mem::replace(&mut taken[s], true)));
    }
    assigned
}

/// Left is 0 and right is 1, of the names of MakeHuman, Mixamo, Unreal and SMPL; and the rest in
/// small letters.
fn side_and_base(name: &str) -> (Option<usize>, String) {
    let name = name.rsplit(':').next().unwrap_or(name).to_ascii_lowercase();
    let name = name.strip_prefix("mixamorig").unwrap_or(&name);
    let clean = |text: &str| text.chars().filter(char::is_ascii_alphanumeric).collect::<String>();
    for (side, word, letter) in [(0, "left", 'l'), (1, "right", 'r')] {
        if let Some(rest) = name.strip_prefix(word) {
            return (Some(side), clean(rest));
        }
        for separator in ['.', '_', ' '] {
            if let Some(rest) = name.strip_suffix(letter).and_then(|n| n.strip_suffix(separator)) {
                return (Some(side), clean(rest));
            }
            if let Some(rest) = name.strip_prefix(letter).and_then(|n| n.strip_prefix(separator)) {
                return (Some(side), clean(rest));
            }
        }
    }
    (None, clean(name))
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
    fn names_of_common_rigs_are_read() {
        for (name, side, base) in [
            ("mixamorig:LeftUpLeg", Some(0), "upleg"),
            ("mixamorig:RightForeArm", Some(1), "forearm"),
            ("Hips", None, "hips"),
            ("thigh_l", Some(0), "thigh"),
            ("UpperArm.R", Some(1), "upperarm"),
            ("L_Elbow", Some(0), "elbow"),
            ("Armature_mesh", None, "armaturemesh"),
        ] {
            assert_eq!(side_and_base(name), (side, base.to_owned()), "{name}");
        }
        let makehuman =
            ["Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "LHipJoint", "LeftUpLeg", "LeftShoulder"];
        let expected = [Some(0), Some(3), Some(6), Some(9), Some(12), None, None, Some(1), Some(13)];
        assert_eq!(assign(&makehuman), expected);
        assert_eq!(assign(&["left_collar", "left_shoulder", "left_elbow"]), [Some(13), Some(16), Some(18)]);
    }

    #[test]
    fn the_skeleton_that_a_clip_was_made_for_follows_it() {
        let body = BodyModel::embedded();
        let human = body.shaped(&[]);
        let names = [
            "pelvis",
            "left_hip",
            "right_hip",
            "spine1",
            "left_knee",
            "right_knee",
            "spine2",
            "left_ankle",
            "right_ankle",
            "spine3",
            "left_foot",
            "right_foot",
            "neck",
            "left_collar",
            "right_collar",
            "head",
            "left_shoulder",
            "right_shoulder",
            "left_elbow",
            "right_elbow",
            "left_wrist",
            "right_wrist",
            "left_hand",
            "right_hand",
        ];
        let mut poses = vec![Vec3::ZERO; 2 * joint::COUNT];
        for (j, pose) in poses.iter_mut().enumerate() {
            let j = j as f32;
            *pose = Vec3::new((1.7 * j).sin(), (2.3 * j).cos(), (3.1 * j).sin()) * 0.3;
        }
        // Feet and hands' ends have no counterpart by name.
        for j in [10, 11, 22, 23] {
            poses[j] = Vec3::ZERO;
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
