//! Skeletons whose joints have names.

use glam::{Affine3A, Vec3};

use crate::rotation::rodrigues;

/// Joints by role, in the names of SMPL, Mixamo and VRM: the 22 of the body that
/// SMPL's successors share, jaw and eyes, and SMPL's own hands.
const NAMES: [&str; 3] = [
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot \
     neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist \
     jaw left_eye right_eye left_hand right_hand",
    "Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase RightToeBase \
     Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand \
     Jaw LeftEye RightEye LeftHandEnd RightHandEnd",
    "hips leftUpperLeg rightUpperLeg spine leftLowerLeg rightLowerLeg chest leftFoot rightFoot upperChest leftToes \
     rightToes neck leftShoulder rightShoulder head leftUpperArm rightUpperArm leftLowerArm rightLowerArm leftHand \
     rightHand jaw leftEye rightEye leftHandEnd rightHandEnd",
];
/// Fingers in SMPL-H's order, three joints each, left before right.
const FINGERS: [&str; 5] = ["index", "middle", "pinky", "ring", "thumb"];
/// Body joints before the fingers, and all joints before jaw, eyes and SMPL's hands.
pub(crate) const BODY: usize = 22;
pub(crate) const FACE: usize = BODY + 30;
/// SMPL's hands.
pub(crate) const HANDS: usize = FACE + 3;
/// Number of roles.
pub(crate) const ROLES: usize = HANDS + 2;

/// A joint of a skeleton.
///
/// ```
/// use glam::Vec3;
/// use smpl::{Joint, joint_transforms};
///
/// let joint = |name: &str, parent, rest| Joint { name: name.to_owned(), parent, rest };
/// let arm = [joint("elbow", None, Vec3::ZERO), joint("wrist", Some(0), Vec3::X)];
/// let bones = joint_transforms(&arm, &[Vec3::Z * std::f32::consts::FRAC_PI_2, Vec3::ZERO], Vec3::ZERO);
/// assert!(bones[0].transform_point3(arm[1].rest).distance(Vec3::Y) < 1e-6);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Such as `left_knee`.
    pub name: String,
    /// Parent joint, which comes before; `None` for the root, which is the first joint, alone.
    pub parent: Option<u16>,
    /// Position at rest.
    pub rest: Vec3,
}

/// Parents of SMPL's 24 joints; its successors share the first 22.
const SMPL_PARENTS: [usize; 24] = [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21];

/// Joints of a body model's `parents` at positions `rest`, (J). Joints of the trees of SMPL, SMPL-H
/// and SMPL-X have names of the scheme, all others `joint_07`.
///
/// ```
/// use smpl::{BodyModel, BoneNames, skeleton};
///
/// let body = BodyModel::embedded();
/// let joints = skeleton(BoneNames::Mixamo, &body.parents, &body.shaped(&[]).joints);
/// assert_eq!((joints[4].name.as_str(), joints[4].parent), ("mixamorig:LeftLeg", Some(1)));
/// ```
pub fn skeleton(scheme: BoneNames, parents: &[Option<usize>], rest: &[Vec3]) -> Vec<Joint> {
    let names = scheme.of_body(parents.len());
    let shared = if parents.len() == 24 { 24 } else { 22 };
    let alike = (SMPL_PARENTS[..shared].iter().zip(parents)).all(|(smpl, parent)| parent.unwrap_or(0) == *smpl);
    let joint = |(j, (parent, &rest)): (usize, (&Option<usize>, &Vec3))| Joint {
        name: names.get(j).filter(|_| alike).map_or_else(|| format!("joint_{j:02}"), Clone::clone),
        parent: parent.and_then(|p| u16::try_from(p).ok()),
        rest,
    };
    parents.iter().zip(rest).enumerate().map(joint).collect()
}

/// Naming schemes of humanoid skeletons.
///
/// ```
/// use smpl::BoneNames;
///
/// let schemes = [BoneNames::Smpl, BoneNames::Mixamo, BoneNames::Vrm];
/// let knees = schemes.map(|scheme| scheme.of_body(24)[4].clone());
/// assert_eq!(knees, ["left_knee", "mixamorig:LeftLeg", "leftLowerLeg"]);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BoneNames {
    /// `pelvis`, `left_knee`.
    Smpl,
    /// `mixamorig:Hips`, `mixamorig:LeftLeg`, as game engines and Blender's add-ons expect.
    Mixamo,
    /// `hips`, `leftLowerLeg`: VRM 1.0's human bones.
    Vrm,
}

/// Role of each joint of a body of J joints in SMPL's form (24: SMPL, 52: SMPL-H, 55: SMPL-X).
pub(crate) fn smpl_roles(joints: usize) -> Vec<usize> {
    match joints {
        24 => (0..BODY).chain([HANDS, HANDS + 1]).collect(),
        52 => (0..FACE).collect(),
        55 => (0..BODY).chain(FACE..HANDS).chain(BODY..FACE).collect(),
        _ => Vec::new(),
    }
}

impl BoneNames {
    fn of(self, role: usize) -> String {
        let prefix = if self == Self::Mixamo { "mixamorig:" } else { "" };
        let Some(finger) = role.checked_sub(BODY).filter(|f| *f < FACE - BODY) else {
            let at = if role < BODY { role } else { role - (FACE - BODY) };
            return format!("{prefix}{}", NAMES[self as usize].split_whitespace().nth(at).unwrap_or_default());
        };
        let (side, finger, segment) = (["left", "right"][finger / 15], FINGERS[finger / 3 % 5], finger % 3);
        let capital = |word: &str| word[..1].to_uppercase() + &word[1..];
        match (self, finger) {
            (Self::Smpl, _) => format!("{side}_{finger}{}", segment + 1),
            (Self::Mixamo, _) => format!("{prefix}{}Hand{}{}", capital(side), capital(finger), segment + 1),
            (Self::Vrm, "thumb") => format!("{side}Thumb{}", ["Metacarpal", "Proximal", "Distal"][segment]),
            (Self::Vrm, _) => {
                let finger = if finger == "pinky" { "little" } else { finger };
                format!("{side}{}{}", capital(finger), ["Proximal", "Intermediate", "Distal"][segment])
            }
        }
    }

    /// The names of a body of `joints` joints in SMPL's form (24: SMPL, 52: SMPL-H, 55: SMPL-X), in
    /// its order; none for other counts.
    ///
    /// ```
    /// use smpl::BoneNames;
    /// assert_eq!(BoneNames::Vrm.of_body(24)[4], "leftLowerLeg");
    /// assert_eq!(BoneNames::Smpl.of_body(55)[22], "jaw");
    /// ```
    pub fn of_body(self, joints: usize) -> Vec<String> {
        smpl_roles(joints).into_iter().map(|role| self.of(role)).collect()
    }

    /// The name of each of `names` in this scheme, which may be of SMPL, Mixamo, CMU, VRM, Unreal,
    /// MakeHuman or Biped; `None` for joints without a counterpart in SMPL-X.
    ///
    /// ```
    /// use smpl::BoneNames;
    /// let names = ["Hips", "LeftUpLeg", "LeftLeg", "Tail"];
    /// let expected = [Some("pelvis"), Some("left_hip"), Some("left_knee"), None];
    /// assert_eq!(BoneNames::Smpl.translate(&names), expected.map(|name| name.map(str::to_owned)));
    /// ```
    pub fn translate(self, names: &[&str]) -> Vec<Option<String>> {
        roles(names).into_iter().map(|role| role.map(|role| self.of(role))).collect()
    }
}

/// Rest to world transform of each joint, (J), for rotations `pose` (J) relative to the parents;
/// the root is moved by `translation` and rotates about itself.
///
/// # Panics
/// If `pose` is not J long.
pub fn joint_transforms(skeleton: &[Joint], pose: &[Vec3], translation: Vec3) -> Vec<Affine3A> {
    assert_eq!(pose.len(), skeleton.len(), "joint_transforms: rotations of joints");
    let mut frames: Vec<Affine3A> = Vec::with_capacity(pose.len());
    for (joint, &turn) in skeleton.iter().zip(pose) {
        let parent = joint.parent.map(usize::from);
        let origin = parent.map_or(-translation, |parent| skeleton[parent].rest);
        let local = Affine3A::from_mat3_translation(rodrigues(turn), joint.rest - origin);
        frames.push(parent.map_or(local, |parent| frames[parent] * local));
    }
    let about = |(frame, joint): (Affine3A, &Joint)| frame * Affine3A::from_translation(-joint.rest);
    frames.into_iter().zip(skeleton).map(about).collect()
}

/// The role of each joint, told by its name, the first of those that claim the same; `None` for
/// those that follow their parents.
pub(crate) fn roles(names: &[&str]) -> Vec<Option<usize>> {
    let read: Vec<(Option<usize>, String)> = names.iter().map(|name| side_and_base(name)).collect();
    let has = |bases: &[&str]| read.iter().any(|(side, base)| side.is_some() && bases.contains(&base.as_str()));
    // Names that mean different joints in different schemes.
    let (arms, ankles, wrists) = (has(&["arm", "upperarm", "uparm"]), has(&["ankle"]), has(&["wrist"]));
    let is_spine = |base: &str| matches!(base, "spine" | "lowerback" | "chest" | "upperchest" | "abdomen" | "torso");
    let without_digits = |base: &str| base.trim_end_matches(|c: char| c.is_ascii_digit()).to_owned();
    let spines = read.iter().filter(|(side, base)| side.is_none() && is_spine(&without_digits(base))).count();
    let (mut taken, mut spine) = ([false; ROLES], 0);
    let role = |(side, base): &(Option<usize>, String)| {
        let left = match (side, without_digits(base).as_str()) {
            (Some(_), "upleg" | "hip" | "thigh" | "upperleg") => 1,
            (Some(_), "leg" | "knee" | "calf" | "lowerleg" | "lowleg" | "shin") => 4,
            (Some(_), "foot") if ankles => 10,
            (Some(_), "foot" | "ankle") => 7,
            (Some(_), "toebase" | "toes" | "toe" | "ball") => 10,
            (Some(_), "shoulder") if arms => 13,
            (Some(_), "collar" | "clavicle") => 13,
            (Some(_), "arm" | "upperarm" | "uparm" | "shoulder") => 16,
            (Some(_), "forearm" | "lowerarm" | "lowarm" | "elbow") => 18,
            (Some(_), "hand") if wrists => HANDS,
            (Some(_), "hand" | "wrist") => 20,
            (Some(_), "eye") => FACE + 1,
            (Some(side), _) => return finger(base).map(|finger| BODY + 15 * side + finger),
            (None, "hips" | "hip" | "pelvis") => 0,
            (None, "neck") => 12,
            (None, "head") => 15,
            (None, "jaw") => FACE,
            (None, base) if is_spine(base) => {
                spine += 1;
                // The last is the chest, which bears the arms.
                match spine {
                    _ if spine == spines && spines > 1 => 9,
                    1 => 3,
                    2 => 6,
                    _ => return None,
                }
            }
            _ => return None,
        };
        Some(left + side.unwrap_or(0))
    };
    let found: Vec<Option<usize>> = read.iter().map(role).collect();
    found.into_iter().map(|role| role.filter(|&role| !std::mem::replace(&mut taken[role], true))).collect()
}

/// Position among a hand's fifteen joints.
fn finger(base: &str) -> Option<usize> {
    let base = base.strip_prefix("hand").unwrap_or(base).replace("little", "pinky");
    let (at, name) = FINGERS.iter().enumerate().find(|(_, name)| base.starts_with(**name))?;
    let thumb = *name == "thumb";
    let segment = match base[name.len()..].trim_start_matches('0') {
        "1" | "metacarpal" => 0,
        "proximal" => usize::from(thumb),
        "2" | "intermediate" => 1,
        "3" | "distal" => 2,
        _ => return None,
    };
    Some(3 * at + segment)
}

/// Left is 0 and right is 1; and the rest of the name in small letters, without prefixes of
/// schemes.
fn side_and_base(name: &str) -> (Option<usize>, String) {
    let name = name.rsplit(':').next().unwrap_or(name).to_ascii_lowercase();
    let prefixes = ["mixamorig", "bip001", "bip01", "j_bip_c_", "j_bip_"];
    let name = prefixes.iter().find_map(|prefix| name.strip_prefix(prefix)).unwrap_or(&name).trim_start();
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
            ("Bip01 R Calf", Some(1), "calf"),
            ("J_Bip_L_UpperLeg", Some(0), "upperleg"),
            ("J_Bip_C_Hips", None, "hips"),
            ("Armature_mesh", None, "armaturemesh"),
        ] {
            assert_eq!(side_and_base(name), (side, base.to_owned()), "{name}");
        }
        let makehuman = [
            "Hips",
            "LowerBack",
            "Spine",
            "Spine1",
            "Neck",
            "Neck1",
            "LHipJoint",
            "LeftUpLeg",
            "LeftShoulder",
            "LeftArm",
        ];
        let expected = [Some(0), Some(3), Some(6), Some(9), Some(12), None, None, Some(1), Some(13), Some(16)];
        assert_eq!(roles(&makehuman), expected);
        assert_eq!(roles(&["left_collar", "left_shoulder", "left_elbow"]), [Some(13), Some(16), Some(18)]);
        assert_eq!(roles(&["Spine", "Chest", "LeftShoulder"]), [Some(3), Some(9), Some(16)]);
        assert_eq!(roles(&["Spine", "Spine1", "Spine2", "Spine3"]), [Some(3), Some(6), None, Some(9)]);
    }

    #[test]
    fn every_scheme_is_read_as_it_is_written() {
        for joints in [24, 52, 55] {
            for scheme in [BoneNames::Smpl, BoneNames::Mixamo, BoneNames::Vrm] {
                let names = scheme.of_body(joints);
                assert_eq!(names.len(), joints);
                let names: Vec<&str> = names.iter().map(String::as_str).collect();
                // SMPL's hands have no counterpart elsewhere.
                let bones = if joints == 24 && scheme != BoneNames::Smpl { 22 } else { joints };
                let expected: Vec<Option<usize>> = smpl_roles(joints).into_iter().map(Some).collect();
                assert_eq!(roles(&names)[..bones], expected[..bones], "{scheme:?}");
                let mut sorted = names.clone();
                sorted.sort_unstable();
                sorted.dedup();
                assert_eq!(sorted.len(), joints);
            }
        }
    }
}
