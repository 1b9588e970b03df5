//! BVH: round trips, other rigs, and whatever is wrong with a file.

use std::path::{Path, PathBuf};

use glam::{Quat, Vec3};
use proptest::prelude::*;
use smpl::{BodyModel, BoneNames, Bvh, Joint, MotionClip, joint_transforms};

fn skeleton(scheme: BoneNames) -> Vec<Joint> {
    let body = BodyModel::embedded();
    smpl::skeleton(scheme, &body.parents, &body.shaped(&[]).joints)
}

fn file(name: &str, text: &[u8]) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, text).unwrap();
    path
}

fn places(skeleton: &[Joint], motion: &MotionClip) -> Vec<Vec3> {
    let frame = |t: usize| {
        let bones = joint_transforms(skeleton, &motion.poses[t * skeleton.len()..][..skeleton.len()], motion.trans[t]);
        bones.into_iter().zip(skeleton).map(|(bone, joint)| bone.transform_point3(joint.rest)).collect::<Vec<_>>()
    };
    (0..motion.num_frames()).flat_map(frame).collect()
}

fn worst(a: &[Vec3], b: &[Vec3]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

fn motion() -> impl Strategy<Value = MotionClip> {
    let vector = |most: f32| prop::array::uniform3(-most..most).prop_map(Vec3::from);
    let frames = 1..4usize;
    frames.prop_flat_map(move |t| {
        (prop::collection::vec(vector(1.7), 24 * t), prop::collection::vec(vector(3.0), t))
            .prop_map(|(poses, trans)| MotionClip { poses, num_joints: 24, trans, fps: 30.0 })
    })
}

/// A small rig in centimetres.
const LEG: &str = "HIERARCHY
ROOT Hips
{
  OFFSET 0 90 0
  CHANNELS 6 Zposition Yposition Xposition Yrotation Zrotation Xrotation
  JOINT Left Knee {
    OFFSET 9 -80 0 CHANNELS 1 Xrotation
    End Site
    {
      OFFSET 0 -90 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
1 95 2 0 0 0 0
1 95 2 90 90 0 -30
";

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn what_is_written_is_read_back_to_a_tenth_of_a_millimetre(motion in motion(), other in 0..3usize) {
        let own = skeleton(BoneNames::Smpl);
        let named = skeleton([BoneNames::Smpl, BoneNames::Mixamo, BoneNames::Vrm][other]);
        let path = file("round.bvh", b"");
        Bvh { skeleton: named.clone(), motion: motion.clone(), unit: "" }.save(&path).unwrap();
        let read = Bvh::load(&path).unwrap();
        prop_assert_eq!(read.unit, "centimetres");
        prop_assert!((read.motion.fps - 30.0).abs() < 1e-4);
        let same = read.onto(&named).unwrap();
        prop_assert!(worst(&places(&own, &motion), &places(&own, &same)) < 1e-4);
        // By roles; SMPL's hands have no counterpart elsewhere and follow the wrists.
        let mut still = motion.clone();
        (0..motion.num_frames()).for_each(|t| still.poses[24 * t + 22..24 * t + 24].fill(Vec3::ZERO));
        let mut by_role = read.onto(&own).unwrap();
        (0..motion.num_frames()).for_each(|t| by_role.poses[24 * t + 22..24 * t + 24].fill(Vec3::ZERO));
        prop_assert!(worst(&places(&own, &still), &places(&own, &by_role)) < 2e-4);
    }

    #[test]
    fn mutated_files_are_read_or_refused_with_one_line(cuts in prop::collection::vec((any::<prop::sample::Index>(), 0..6u8), 1..4)) {
        let mut text = LEG.as_bytes().to_vec();
        for (at, kind) in cuts {
            let at = at.index(text.len());
            match kind {
                0 => text.truncate(at.max(1)),
                1 => text[at] = b'{',
                2 => text[at] = b'}',
                3 => drop(text.splice(at..at, *b" nan ")),
                4 => drop(text.splice(at..at, *b"99999999999")),
                _ => drop(text.remove(at)),
            }
            if text.is_empty() {
                text.push(b' ');
            }
        }
        match Bvh::load(&file("mutated.bvh", &text)) {
            Ok(bvh) => {
                prop_assert_eq!(bvh.motion.poses.len(), bvh.skeleton.len() * bvh.motion.num_frames());
                prop_assert!(bvh.motion.poses.iter().chain(&bvh.motion.trans).all(|v| v.is_finite()));
                prop_assert!(bvh.onto(&skeleton(BoneNames::Smpl)).is_err());
            }
            Err(error) => prop_assert!(!error.to_string().contains('\n')),
        }
    }
}

#[test]
fn channels_of_any_order_are_multiplied_in_it() {
    let bvh = Bvh::load(&file("leg.bvh", LEG.as_bytes())).unwrap();
    assert_eq!((bvh.unit, bvh.motion.fps, bvh.skeleton[1].name.as_str()), ("centimetres", 25.0, "Left Knee"));
    assert!(bvh.motion.trans[1].distance(Vec3::new(0.02, 0.95, 0.01)) < 1e-6);
    let expected = Quat::from_rotation_y(1.0_f32.atan2(0.0)) * Quat::from_rotation_z(1.0_f32.atan2(0.0));
    let found = Quat::from_scaled_axis(bvh.motion.poses[2]);
    assert!(found.dot(expected).abs() > 1.0 - 1e-6, "{found}");
    assert!(bvh.motion.poses[3].distance(Vec3::new(-30f32.to_radians(), 0.0, 0.0)) < 1e-6);
}

#[test]
fn wrong_files_are_named_by_line() {
    let nested = "ROOT a { OFFSET 0 0 0 CHANNELS 0 ".to_owned() + &"JOINT b { OFFSET 0 1 0 ".repeat(1100);
    for (name, from, to, words) in [
        ("two-roots", "JOINT Left", "ROOT Left", "line 6`: expected one ROOT, and each JOINT"),
        ("braces", "MOTION", "}\nMOTION", "line 14`: expected JOINT, End Site"),
        ("open", "  }\n}\nMOTION", "MOTION", "line 12`: expected JOINT"),
        ("offset", "OFFSET 9 -80 0", "", "expected OFFSET, found \"CHANNELS\""),
        ("channel", "CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "found \"Wrotation\""),
        ("count", "CHANNELS 6", "CHANNELS 6000000000", "expected 0 to 6 channels"),
        ("number", "1 95 2 0 0", "1 95 2 O 0", "line 17`: expected a number of at most 1000000, found \"O\""),
        ("nan", "1 95 2 0 0", "1 95 2 NaN 0", "found \"NaN\""),
        ("large", "1 95 2 0 0", "1 95 2 1e30 0", "found \"1e30\""),
        ("frames", "Frames: 2", "Frames: 99999999999", "99999999999 frames of 2 joints"),
        ("none", "Frames: 2", "Frames: 0", "0 frames"),
        ("fewer", "Frames: 2", "Frames: 3", "ends in frame 2 of 3"),
        ("more", "Frames: 2", "Frames: 1", "expected the end after 1 frames"),
        ("rate", "0.04", "0", "0 s a frame"),
        ("deep", LEG, &format!("HIERARCHY {nested}"), "more than 1024 joints"),
        ("empty", LEG, "", "the file ends here"),
        ("other", LEG, "solid cube", "expected HIERARCHY"),
    ] {
        let text = LEG.replacen(from, to, 1);
        let message = Bvh::load(&file(&format!("wrong-{name}.bvh"), text.as_bytes())).unwrap_err().to_string();
        assert!(message.contains(words) && message.contains(name) && !message.contains('\n'), "{name}: {message}");
    }
    let zero = LEG.replace("9 -80 0", "0 0 0").replace("0 -90 0", "0 0 0");
    let message = Bvh::load(&file("zero.bvh", zero.as_bytes())).unwrap_err().to_string();
    assert!(message.contains("zero length"), "{message}");
}

#[test]
fn rigs_that_do_not_fit_are_told_what_they_lack() {
    let smpl = skeleton(BoneNames::Smpl);
    let leg = Bvh::load(&file("lacks.bvh", LEG.as_bytes())).unwrap();
    let message = leg.onto(&smpl).unwrap_err();
    assert!(message.contains("left upper leg") && !message.contains("hips"), "{message}");
    let motion = MotionClip { poses: vec![Vec3::ZERO; 24], num_joints: 24, trans: vec![Vec3::ZERO], fps: 30.0 };
    let rig = |joint: usize, rest: Vec3| {
        let mut skeleton = skeleton(BoneNames::Mixamo);
        skeleton[joint].rest = rest;
        Bvh { skeleton, motion: motion.clone(), unit: "metres" }
    };
    let message = rig(4, smpl[1].rest).onto(&smpl).unwrap_err();
    assert!(message.contains("left upper leg has zero length"), "{message}");
    let mut flat = rig(0, Vec3::ZERO);
    flat.skeleton.iter_mut().for_each(|joint| joint.rest *= Vec3::X);
    assert!(flat.onto(&smpl).unwrap_err().contains("no height"));
}

/// Another rig: twice as large, z up, facing −y, arms hanging, other names.
#[test]
fn a_rig_that_rests_otherwise_moves_the_same_limbs_the_same_way() {
    let smpl = skeleton(BoneNames::Smpl);
    let mut other = skeleton(BoneNames::Mixamo);
    // y up, +z ahead to z up, −y ahead.
    let turn = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
    for (from, to) in [(16, 18), (18, 20), (20, 22), (17, 19), (19, 21), (21, 23)] {
        other[to].rest = other[from].rest - smpl[from].rest.distance(smpl[to].rest) * Vec3::Y;
    }
    other.iter_mut().for_each(|joint| joint.rest = 2.0 * (turn * joint.rest));
    let mut poses = vec![Vec3::ZERO; 24];
    poses[4] = Vec3::new(0.9, 0.0, 0.0);
    poses[16] = Vec3::new(0.0, 0.4, 0.0);
    let local = |v: &Vec3| turn * *v;
    let turned: Vec<Vec3> = poses.iter().map(local).collect();
    let motion = MotionClip { poses: turned, num_joints: 24, trans: vec![Vec3::new(0.0, 0.0, 2.0)], fps: 30.0 };
    let found = Bvh { skeleton: other.clone(), motion: motion.clone(), unit: "metres" }.onto(&smpl).unwrap();
    let (source, target) = (places(&other, &motion), places(&smpl, &found));
    for (from, to) in [(1, 4), (4, 7), (2, 5), (16, 18), (18, 20), (17, 19), (19, 21)] {
        let direction = |places: &[Vec3]| (places[to] - places[from]).normalize_or_zero();
        assert!(direction(&source).distance(direction(&target)) < 1e-3, "{from} {to}");
    }
    assert!(target[0].distance(0.5 * source[0]) < 2e-3, "{} {}", target[0], source[0]);
}
