//! VRM 1.0: a humanoid in glTF, with its licence.

use glam::{Quat, Vec3};
use serde_json::{Map, Value, json};
use smpl::{BoneNames, SparseRows};

use crate::Error;
use crate::bake::{Avatar, Joint, motion_of_bones};

/// Licence document of VRM 1.0, the one that the format admits.
pub const VRM_LICENCE: &str = "https://vrm.dev/licenses/1.0/";
/// Human bones that a VRM must have.
const REQUIRED: [&str; 15] = [
    "hips",
    "spine",
    "head",
    "leftUpperLeg",
    "rightUpperLeg",
    "leftLowerLeg",
    "rightLowerLeg",
    "leftFoot",
    "rightFoot",
    "leftUpperArm",
    "rightUpperArm",
    "leftLowerArm",
    "rightLowerArm",
    "leftHand",
    "rightHand",
];

/// Authorship and licence of a VRM.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Vrm<'a> {
    /// Name of the author.
    pub author: &'a str,
    /// Address of the licence: [`VRM_LICENCE`], or one that is added to it as `otherLicenseUrl`.
    pub licence: &'a str,
}

impl Vrm<'_> {
    /// The extension `VRMC_vrm`; node j of the glTF is joint j.
    pub(super) fn extension(&self, avatar: &Avatar) -> Result<Value, Error> {
        let bones: Map<String, Value> = (human_bones(&avatar.skeleton).into_iter().enumerate())
            // The ends of SMPL's hands are no human bones.
            .filter_map(|(j, name)| Some((name.filter(|name| !name.ends_with("End"))?, json!({ "node": j }))))
            .collect();
        let missing: Vec<&str> = REQUIRED.into_iter().filter(|bone| !bones.contains_key(*bone)).collect();
        if !missing.is_empty() {
            return Err(Error::Bake(format!("VRM: no joint by name for {}", missing.join(", "))));
        }
        let name = if avatar.name.is_empty() { "person" } else { &avatar.name };
        let mut meta = json!({ "name": name, "authors": [self.author], "licenseUrl": VRM_LICENCE });
        if self.licence != VRM_LICENCE {
            meta["otherLicenseUrl"] = json!(self.licence);
        }
        Ok(json!({ "specVersion": "1.0", "meta": meta, "humanoid": { "humanBones": bones } }))
    }
}

/// VRM's name of each joint that has one.
fn human_bones(skeleton: &[Joint]) -> Vec<Option<String>> {
    let names: Vec<&str> = skeleton.iter().map(|joint| joint.name.as_str()).collect();
    BoneNames::Vrm.translate(&names)
}

impl Avatar {
    /// The avatar at rest with arms level along x, as a T-pose has them; motions stay what they are.
    /// Pose blend shapes are left out.
    ///
    /// # Errors
    /// [`Error::Bake`] for a skeleton whose arms are not known by name.
    pub fn with_level_arms(&self) -> Result<Self, Error> {
        let bones = human_bones(&self.skeleton);
        let joint = |name: &str| {
            let found = bones.iter().position(|bone| bone.as_deref() == Some(name));
            found.ok_or_else(|| Error::Bake(format!("no joint by name for {name}")))
        };
        // Rotations relative to the rest pose, of the joint alone and with those above it.
        let (mut pose, mut globals) = (vec![Vec3::ZERO; self.num_joints()], vec![Quat::IDENTITY; self.num_joints()]);
        let mut levelled = vec![None; self.num_joints()];
        for (side, along) in [("left", Vec3::X), ("right", Vec3::NEG_X)] {
            let [upper, lower, hand] = ["UpperArm", "LowerArm", "Hand"].map(|bone| joint(&format!("{side}{bone}")));
            let [upper, lower, hand] = [upper?, lower?, hand?];
            for (from, to) in [(upper, lower), (lower, hand)] {
                let arm = self.skeleton[to].rest - self.skeleton[from].rest;
                levelled[from] = arm.try_normalize().map(|arm| Quat::from_rotation_arc(arm, along));
            }
        }
        for (j, joint) in self.skeleton.iter().enumerate() {
            let above = joint.parent.map_or(Quat::IDENTITY, |parent| globals[usize::from(parent)]);
            globals[j] = levelled[j].unwrap_or(above);
            pose[j] = (above.inverse() * globals[j]).to_scaled_axis();
        }
        let to_level = self.bones(&pose, Vec3::ZERO);
        let mut avatar = self.clone();
        (avatar.vertices, avatar.normals) = self.skin(&to_level, &pose);
        avatar.posedirs = SparseRows::from_rows(vec![Vec::<(u32, Vec3)>::new(); self.num_vertices()]);
        for (joint, bone) in avatar.skeleton.iter_mut().zip(&to_level) {
            joint.rest = bone.transform_point3(joint.rest);
        }
        let from_level: Vec<_> = to_level.iter().map(glam::Affine3A::inverse).collect();
        for clip in &mut avatar.clips {
            let motion = &clip.motion;
            let frames = motion.poses.chunks_exact(motion.num_joints).zip(&motion.trans).map(|(pose, &trans)| {
                self.bones(pose, trans).into_iter().zip(&from_level).map(|(bone, level)| bone * *level).collect()
            });
            clip.motion = motion_of_bones(&avatar.skeleton, &frames.collect::<Vec<_>>(), motion.fps);
        }
        Ok(avatar)
    }
}
