//! Motion on the floor.

use std::f32::consts::TAU;

use glam::{Quat, Vec3};
use point_fit::ground;
use proptest::prelude::*;
use smpl::{BodyModel, BoneNames, Joint, MotionClip, joint_transforms};
use testkit::body::Random;
use testkit::files::shared;
use testkit::strategy::vec3;

fn skeleton() -> (Vec<Joint>, f32) {
    let body = BodyModel::embedded();
    let shaped = body.shaped(&[]);
    let sole = shaped.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
    (smpl::skeleton(BoneNames::Smpl, &body.parents, &shaped.joints), sole)
}

/// The recorded walk with errors of joint rotations, smooth in time: three waves an axis with
/// periods of 0.7 to 2 s, `degrees` root mean square.
fn walk(degrees: f32) -> Option<MotionClip> {
    let mut walk = MotionClip::load(&shared("mocap/walk.npz")?).unwrap();
    let mut random = Random(5);
    let mut wave = || (TAU / (0.7 + 1.3 * random.unit()), TAU * random.unit());
    for joint in 0..24 {
        let waves = [(); 3].map(|()| [(); 3].map(|()| wave()));
        for t in 0..walk.num_frames() {
            let seconds = t as f32 / walk.fps;
            let sum = waves.map(|axis| axis.iter().map(|(rate, phase)| (rate * seconds + phase).sin()).sum::<f32>());
            let by = Vec3::from(sum) * degrees.to_radians() * (2.0f32 / 9.0).sqrt();
            let pose = &mut walk.poses[24 * t + joint];
            *pose = (Quat::from_scaled_axis(*pose) * Quat::from_scaled_axis(by)).to_scaled_axis();
        }
    }
    Some(walk)
}

/// Places of the ankles and of the soles below ankles and toes, by frame.
fn feet(motion: &MotionClip, skeleton: &[Joint], sole: f32) -> Vec<[Vec3; 6]> {
    let frame = |t: usize| {
        let bones = joint_transforms(skeleton, &motion.poses[24 * t..][..24], motion.trans[t]);
        let low = |bone: usize, at: usize| bones[bone].transform_point3(skeleton[at].rest.with_y(sole));
        let knee = |j: usize| bones[j].transform_point3(skeleton[j].rest);
        [low(7, 7), low(7, 10), low(8, 8), low(8, 11), knee(4), knee(5)]
    };
    (0..motion.num_frames()).map(frame).collect()
}

#[test]
fn a_recorded_walk_stops_sliding_and_stays_where_it_was_elsewhere() {
    let (skeleton, sole) = skeleton();
    for degrees in [0.0, 1.0, 4.0] {
        let Some(walk) = walk(degrees) else { return };
        let found = ground(&skeleton, &walk, sole).unwrap();
        let after = feet(&found.motion, &skeleton, sole);
        let lowest = after.iter().flat_map(|feet| &feet[..4]).map(|at| at.y).fold(0.0, f32::min);
        println!("{degrees}°: {:?} m/s, moved {:?} m, lowest {lowest:.3}", found.sliding, found.moved);
        assert!(found.sliding[1] < 5e-3, "{:?}", found.sliding);
        assert!(found.moved[0] < 0.02 && found.moved[1] < 0.01, "{:?}", found.moved);
        assert!(found.standing.iter().all(|share| *share > 0.3), "{:?}", found.standing);
        assert!(lowest > -0.02, "{lowest}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn a_tilted_and_raised_world_is_levelled(x in -0.2f32..0.2, z in -0.2f32..0.2, height in -2f32..2.0) {
        let (skeleton, sole) = skeleton();
        let Some(walk) = walk(0.0) else { return Ok(()) };
        let turn = Quat::from_rotation_x(x) * Quat::from_rotation_z(z);
        let (mut tilted, root) = (walk.clone(), skeleton[0].rest);
        for (pose, at) in tilted.poses.iter_mut().step_by(24).zip(&mut tilted.trans) {
            *pose = (turn * Quat::from_scaled_axis(*pose)).to_scaled_axis();
            *at = turn * (root + *at) - root + height * Vec3::Y;
        }
        let [level, tilted] = [&walk, &tilted].map(|walk| ground(&skeleton, walk, sole).unwrap());
        prop_assert!(tilted.sliding[1] < 5e-3);
        let mean = |found: &smpl::MotionClip, i: usize| {
            let feet = feet(found, &skeleton, sole);
            feet.iter().map(|feet| feet[i].y).sum::<f32>() / feet.len() as f32
        };
        for i in 0..6 {
            let [a, b] = [&level, &tilted].map(|found| mean(&found.motion, i));
            prop_assert!((a - b).abs() < 0.02, "{i}: {a} {b}");
        }
    }

    #[test]
    fn any_motion_stays_finite(
        turns in prop::collection::vec(vec3(3.0), 24 * 4),
        places in prop::collection::vec(vec3(1e3), 4),
    ) {
        let (skeleton, sole) = skeleton();
        let motion = MotionClip { poses: turns, num_joints: 24, trans: places, fps: 30.0 };
        let found = ground(&skeleton, &motion, sole).unwrap();
        prop_assert!(found.motion.poses.iter().chain(&found.motion.trans).all(|v| v.is_finite()));
        prop_assert!(found.sliding.iter().chain(&found.moved).all(|s| s.is_finite()));
        // What is not of the legs keeps its rotations.
        for (a, b) in motion.poses.chunks(24).zip(found.motion.poses.chunks(24)) {
            for j in [3, 6, 9, 10, 12, 16, 18, 20, 23] {
                prop_assert!(Quat::from_scaled_axis(a[j]).dot(Quat::from_scaled_axis(b[j])).abs() > 1.0 - 1e-5);
            }
        }
    }
}

#[test]
fn skeletons_without_feet_are_refused() {
    let (skeleton, sole) = skeleton();
    let still = MotionClip { poses: vec![Vec3::ZERO; 24], num_joints: 24, trans: vec![Vec3::ZERO], fps: 30.0 };
    assert!(ground(&skeleton, &still, sole).is_ok());
    let none = MotionClip { poses: Vec::new(), trans: Vec::new(), ..still.clone() };
    assert_eq!(ground(&skeleton, &none, sole).unwrap().motion, none);
    let long = MotionClip { poses: vec![Vec3::ZERO; 24 * 100_001], trans: vec![Vec3::ZERO; 100_001], ..still.clone() };
    let fault = ground(&skeleton, &long, sole).unwrap_err().to_string();
    assert_eq!(fault, "expected at most 100000 frames, found 100001");
    let refused = |edit: fn(&mut Vec<Joint>)| {
        let mut edited = skeleton.clone();
        edit(&mut edited);
        ground(&edited, &still, sole).unwrap_err().to_string()
    };
    assert_eq!(refused(|joints| joints[10].name = "claw".to_owned()), "no joint by name for left foot");
    assert!(refused(|joints| joints[5].rest = joints[2].rest).contains("from right_hip to right_knee, 0 m long"));
    assert!(refused(|joints| joints[7].parent = Some(0)).contains("from left_knee to left_ankle"));
    assert!(refused(|joints| joints[4].rest.x = f32::NAN).contains("NaN m long"));
}
