//! Motion on the floor.

use std::f32::consts::TAU;

use glam::{Quat, Vec3};
use proptest::prelude::*;
use smpl::{BodyModel, BoneNames, Joint, MotionClip, joint_transforms};
use testkit::files::shared;

fn skeleton() -> (Vec<Joint>, f32) {
    let body = BodyModel::embedded();
    let shaped = body.shaped(&[]);
    let sole = shaped.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
    let parts = BoneNames::Smpl.of_body(24).into_iter().zip(&body.parents).zip(shaped.joints);
    let joint = |((name, parent), rest): ((String, &Option<usize>), Vec3)| Joint {
        name,
        parent: parent.map(|p| p as u16),
        rest,
    };
    (parts.map(joint).collect(), sole)
}

/// The recorded walk, with an error of so many degrees, root mean square, of each joint's rotation,
/// smooth in time.
fn walk(degrees: f32) -> Option<MotionClip> {
    let mut walk = MotionClip::load(&shared("mocap/walk.npz")?).unwrap();
    let mut seed = 5u32;
    let mut next = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 8) as f32 / (1 << 24) as f32
    };
    for joint in 0..24 {
        // Three waves an axis with periods of 0.7 to 2 s.
        let waves: Vec<[(f32, f32); 3]> =
            (0..3).map(|_| [(); 3].map(|()| (TAU / (0.7 + 1.3 * next()), TAU * next()))).collect();
        for t in 0..walk.num_frames() {
            let seconds = t as f32 / walk.fps;
            let wave =
                |axis: usize| waves[axis].iter().map(|(rate, phase)| (rate * seconds + phase).sin()).sum::<f32>();
            let by = Vec3::new(wave(0), wave(1), wave(2)) * degrees.to_radians() * (2.0f32 / 9.0).sqrt();
            let pose = &mut walk.poses[24 * t + joint];
            *pose = (Quat::from_scaled_axis(*pose) * Quat::from_scaled_axis(by)).to_scaled_axis();
        }
    }
    Some(walk)
}

#[test]
fn a_recorded_walk_stops_sliding_with_noise_and_without() {
    let (skeleton, sole) = skeleton();
    for degrees in [0.0, 1.0, 4.0] {
        let Some(walk) = walk(degrees) else { return };
        let found = walk.grounded(&skeleton, sole).unwrap();
        println!("{degrees}°: {:?} m/s, standing {:?}, moved {}", found.sliding, found.standing, found.moved);
        assert!(found.sliding[1] < 5e-3, "{:?}", found.sliding);
        assert!(found.moved < 0.1, "{}", found.moved);
        assert!(found.standing.iter().all(|share| *share > 0.3), "{:?}", found.standing);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]

    #[test]
    fn a_tilted_and_raised_world_is_levelled(x in -0.2f32..0.2, z in -0.2f32..0.2, height in -2f32..2.0) {
        let (skeleton, sole) = skeleton();
        let Some(walk) = walk(0.0) else { return Ok(()) };
        let expected = walk.grounded(&skeleton, sole).unwrap();
        let turn = Quat::from_rotation_x(x) * Quat::from_rotation_z(z);
        let mut tilted = walk.clone();
        let root = skeleton[0].rest;
        for (pose, at) in tilted.poses.iter_mut().step_by(24).zip(&mut tilted.trans) {
            *pose = (turn * Quat::from_scaled_axis(*pose)).to_scaled_axis();
            *at = turn * (root + *at) - root + height * Vec3::Y;
        }
        let found = tilted.grounded(&skeleton, sole).unwrap();
        prop_assert!(found.sliding[1] < 5e-3);
        let lowest = |motion: &MotionClip| {
            let frame = |t: usize| {
                let bones = joint_transforms(&skeleton, &motion.poses[24 * t..][..24], motion.trans[t]);
                [7, 8, 10, 11].map(|j: usize| bones[j].transform_point3(skeleton[j].rest.with_y(sole)).y).into_iter().fold(9.0, f32::min)
            };
            let all: Vec<f32> = (0..motion.num_frames()).map(frame).collect();
            all.iter().sum::<f32>() / all.len() as f32
        };
        prop_assert!(lowest(&found.motion).abs() < 0.02, "{}", lowest(&found.motion));
        prop_assert!(lowest(&expected.motion).abs() < 0.02);
    }

    #[test]
    fn any_motion_keeps_its_bones_and_stays_finite(
        turns in prop::collection::vec(prop::array::uniform3(-3f32..3.0), 24 * 4),
        places in prop::collection::vec(prop::array::uniform3(-1e3f32..1e3), 4),
    ) {
        let (skeleton, sole) = skeleton();
        let poses = turns.into_iter().map(Vec3::from).collect();
        let motion = MotionClip { poses, num_joints: 24, trans: places.into_iter().map(Vec3::from).collect(), fps: 30.0 };
        let found = motion.grounded(&skeleton, sole).unwrap();
        prop_assert!(found.motion.poses.iter().chain(&found.motion.trans).all(|v| v.is_finite()));
        prop_assert!(found.sliding.iter().all(|s| s.is_finite()));
    }
}

#[test]
fn skeletons_without_feet_are_refused() {
    let (mut skeleton, sole) = skeleton();
    let still = MotionClip { poses: vec![Vec3::ZERO; 24], num_joints: 24, trans: vec![Vec3::ZERO], fps: 30.0 };
    assert!(still.grounded(&skeleton, sole).is_ok());
    skeleton[10].name = "claw".to_owned();
    assert!(still.grounded(&skeleton, sole).unwrap_err().contains("toes"));
    skeleton[1].name = "tail".to_owned();
    assert!(still.grounded(&skeleton, sole).unwrap_err().contains("left upper leg"));
}
