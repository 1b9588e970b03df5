//! Motion from one skeleton to another.

use glam::{Mat3, Quat, Vec3};

use super::bvh::{Bvh, shorter};
use super::motion_clip::MotionClip;
use super::skeleton::{BODY, FACE, HANDS, ROLES, roles};
use super::skeleton::{Joint, joint_transforms};

/// Joints that both skeletons must have.
const NEEDED: [(usize, &str); 9] = [
    (0, "hips"),
    (1, "left upper leg"),
    (2, "right upper leg"),
    (4, "left lower leg"),
    (5, "right lower leg"),
    (16, "left upper arm"),
    (17, "right upper arm"),
    (18, "left forearm"),
    (19, "right forearm"),
];
/// Limbs whose directions at rest are aligned, with the joint at their end; of feet, only
/// the heading is aligned.
const LIMBS: [(usize, usize); 10] =
    [(1, 4), (2, 5), (4, 7), (5, 8), (16, 18), (17, 19), (18, 20), (19, 21), (7, 10), (8, 11)];
/// Shortest bone of a limb, relative to a leg.
const SHORTEST: f32 = 1e-3;

/// A skeleton by roles.
struct Roles<'a> {
    skeleton: &'a [Joint],
    /// Joint of each role.
    joints: [Option<usize>; ROLES],
}

impl<'a> Roles<'a> {
    fn new(skeleton: &'a [Joint]) -> Result<Self, String> {
        let names: Vec<&str> = skeleton.iter().map(|joint| joint.name.as_str()).collect();
        let mut joints = [None; ROLES];
        for (joint, role) in roles(&names).into_iter().enumerate() {
            if let Some(role) = role {
                joints[role] = Some(joint);
            }
        }
        let missing: Vec<&str> = NEEDED.iter().filter(|(s, _)| joints[*s].is_none()).map(|(_, name)| *name).collect();
        if !missing.is_empty() {
            return Err(format!("no joint by name for {}", missing.join(", ")));
        }
        Ok(Self { skeleton, joints })
    }

    fn at(&self, role: usize) -> Option<Vec3> {
        self.joints[role].map(|joint| self.skeleton[joint].rest)
    }

    /// From the joint of role `from` to that of `to`.
    fn bone(&self, from: usize, to: usize) -> Option<Vec3> {
        Some(self.at(to)? - self.at(from)?)
    }

    /// Mean length of the legs: to the ankles, or to the knees.
    fn leg(&self, to_ankles: bool) -> f32 {
        let length = |(from, to)| self.bone(from, to).map_or(0.0, Vec3::length);
        0.5 * LIMBS[..if to_ankles { 4 } else { 2 }].iter().copied().map(length).sum::<f32>()
    }

    /// Rotation from the axes of the rest pose, upright along an axis of the file, to +y up and +z
    /// ahead.
    fn to_front(&self) -> Option<Quat> {
        let across = self.bone(2, 1)? + self.bone(17, 16)?;
        let up = self.bone(1, 16)? + self.bone(2, 17)?;
        let nearest = |v: Vec3| {
            let axes = Vec3::AXES.into_iter().filter(|axis| v.dot(*axis).abs() > 0.0);
            axes.max_by(|a, b| v.dot(*a).abs().total_cmp(&v.dot(*b).abs())).map(|axis| axis * v.dot(axis).signum())
        };
        let up = nearest(up)?;
        let left = nearest(across.reject_from(up))?;
        Some(Quat::from_mat3(&Mat3::from_cols(left, up, left.cross(up)).transpose()))
    }
}

impl Bvh {
    /// The motion for the skeleton `to`, which rests y up facing +z. Joints correspond by the names of
    /// SMPL, Mixamo, CMU, VRM, Unreal, MakeHuman and Biped rigs; they take the orientation of their
    /// counterparts, corrected by the directions of the limbs at rest; all others follow their
    /// parents. Translations are scaled by the lengths of the legs. A skeleton of the same names
    /// takes the rotations and translations as they are. The world's axes stay.
    ///
    /// # Errors
    /// What one of the skeletons lacks: hips, upper or lower arms or legs, or their lengths.
    pub fn onto(&self, to: &[Joint]) -> Result<MotionClip, String> {
        let (from, j, motion) = (&self.skeleton, self.skeleton.len(), &self.motion);
        let root = to.first().map_or(Vec3::ZERO, |joint| joint.rest);
        if from.iter().map(|joint| &joint.name).eq(to.iter().map(|joint| &joint.name)) {
            let trans = motion.trans.iter().map(|t| from[0].rest + *t - root).collect();
            return Ok(MotionClip { trans, ..motion.clone() });
        }
        let (from, to) = (Roles::new(from)?, Roles::new(to).map_err(|fault| format!("the target has {fault}"))?);
        let turn = from.to_front().ok_or("the rest pose has no height or no width")?;
        let to_ankles = [7, 8].iter().all(|&ankle| from.joints[ankle].is_some() && to.joints[ankle].is_some());
        let (source_leg, leg) = (from.leg(to_ankles), to.leg(to_ankles));
        // From the target's rest to the source's.
        let mut aligned = [turn.inverse(); ROLES];
        for (role, end) in LIMBS {
            let (Some(source), Some(own)) = (from.bone(role, end), to.bone(role, end)) else { continue };
            let is_foot = matches!(role, 7 | 8);
            if !is_foot && (source.length() <= SHORTEST * source_leg || own.length() <= SHORTEST * leg) {
                let name = NEEDED.iter().find(|needed| needed.0 == role).map_or("limb", |needed| needed.1);
                return Err(format!("the {name} has zero length"));
            }
            let direction = |v: Vec3| if is_foot { v.with_y(0.0) } else { v }.try_normalize();
            if let (Some(source), Some(own)) = (direction(turn * source), direction(own)) {
                aligned[role] = turn.inverse() * Quat::from_rotation_arc(own, source);
            }
        }
        // Hands and fingers go with the forearms.
        for role in (20..FACE).chain(HANDS..ROLES) {
            let is_right = match role {
                ..BODY => role == 21,
                BODY..FACE => role >= BODY + 15,
                _ => role > HANDS,
            };
            aligned[role] = aligned[18 + usize::from(is_right)];
        }
        let mut source_of = vec![None; to.skeleton.len()];
        for (role, joint) in to.joints.iter().enumerate() {
            // Of fewer spinal joints the one before.
            let lower = [role, role.wrapping_sub(3), role.wrapping_sub(6)];
            let tried = if matches!(role, 6 | 9) { &lower[..role / 3] } else { &lower[..1] };
            let found = tried.iter().find_map(|&r| from.joints[r].map(|source| (source, aligned[role])));
            if let Some(joint) = joint {
                source_of[*joint] = found;
            }
        }
        let (Some(source_hips), Some(hips)) = (from.joints[0], to.joints[0]) else { return Err("no hips".to_owned()) };
        let scale = leg / source_leg;
        let (mut poses, mut trans) = (Vec::new(), Vec::with_capacity(motion.num_frames()));
        for (pose, &translation) in motion.poses.chunks_exact(j).zip(&motion.trans) {
            let bones = joint_transforms(from.skeleton, pose, translation);
            let turned = |joint: usize| Quat::from_mat3a(&bones[joint].matrix3);
            let start = turned(source_hips) * aligned[0];
            let mut turns: Vec<Quat> = Vec::with_capacity(to.skeleton.len());
            for (joint, source) in to.skeleton.iter().zip(&source_of) {
                let above = joint.parent.map(|parent| turns[usize::from(parent)]);
                let own = source.map_or(above.unwrap_or(start), |(source, aligned)| turned(source) * aligned);
                poses.push(shorter((above.unwrap_or_default().inverse() * own).normalize()).to_scaled_axis());
                turns.push(own.normalize());
            }
            let place = scale * bones[source_hips].transform_point3(from.skeleton[source_hips].rest);
            // What the joints above the hips leave of the way to them.
            let (mut below, mut arm) = (hips, Vec3::ZERO);
            while let Some(parent) = to.skeleton[below].parent.map(usize::from) {
                arm += turns[parent] * (to.skeleton[below].rest - to.skeleton[parent].rest);
                below = parent;
            }
            trans.push(place - arm - root);
        }
        Ok(MotionClip { poses, num_joints: to.skeleton.len(), trans, fps: motion.fps })
    }
}
