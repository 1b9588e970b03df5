//! Motion capture: AMASS's forms, and the shared clips.

use std::path::{Path, PathBuf};

use glam::Vec3;
use smpl::{MotionClip, Placement};
use testkit::files::{npy, zip};

fn floats(shape: &[usize], values: &[f32]) -> Vec<u8> {
    npy("<f4", shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
}

fn archive(name: &str, arrays: &[(&str, Vec<u8>)]) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, zip(arrays.iter().map(|(key, bytes)| (format!("{key}.npy"), bytes)))).unwrap();
    path
}

/// Two frames in which joint j has the rotation (j, 0, 0) / 100, then twice that. Tests run at
/// once: each has files of its own.
fn clip(test: &str, joints: usize, rate: &str) -> PathBuf {
    let mut poses = vec![0.0; 6 * joints];
    for j in 0..joints {
        poses[3 * j] = j as f32 / 100.0;
        poses[3 * (joints + j)] = j as f32 / 50.0;
    }
    archive(
        &format!("clip-{test}-{joints}.npz"),
        &[
            ("poses", floats(&[2, 3 * joints], &poses)),
            ("trans", floats(&[2, 3], &[0.0, 1.0, 0.0, 0.0, 1.0, 4.0])),
            (rate, floats(&[], &[120.0])),
            ("dmpls", floats(&[2, 8], &[0.0; 16])),
        ],
    )
}

#[test]
fn clips_of_every_form_drive_bodies_of_every_form() {
    let x = |pose: &[Vec3]| pose.iter().map(|r| (100.0 * r.x).round() as i32).collect::<Vec<_>>();
    let all = |n: i32| (0..n).collect::<Vec<_>>();
    let on = |rate, clip_joints, body| {
        let clip = MotionClip::load(&clip("rates", clip_joints, rate)).unwrap();
        assert_eq!((clip.num_frames(), clip.num_joints, clip.fps), (2, clip_joints, 120.0));
        x(&clip.at(0.0, body).0)
    };
    let body_then = |n: usize| [all(22), vec![0; n - 22]].concat();
    assert_eq!(on("fps", 24, 24), all(24));
    assert_eq!(on("mocap_framerate", 52, 52), all(52));
    assert_eq!(on("mocap_framerate", 52, 24), body_then(24));
    assert_eq!(on("mocap_frame_rate", 55, 24), body_then(24));
    assert_eq!(on("fps", 24, 55), body_then(55));
    assert_eq!(on("fps", 24, 10), all(10));
    // Fingers keep their place behind jaw and eyes.
    assert_eq!(on("mocap_framerate", 52, 55), [all(22), vec![0; 3], (22..52).collect()].concat());
    assert_eq!(on("mocap_frame_rate", 55, 52), [all(22), (25..55).collect()].concat());
}

#[test]
fn frames_are_interpolated_and_held_at_the_ends() {
    let clip = MotionClip::load(&clip("ends", 24, "fps")).unwrap();
    assert!((clip.duration() - 1.0 / 120.0).abs() < 1e-9);
    let (pose, placement) = clip.at(0.5 / 120.0, 24);
    assert!((pose[20].x - 0.3).abs() < 1e-6 && pose[20].y == 0.0);
    assert_eq!(placement, Placement::Pelvis { translation: Vec3::new(0.0, 1.0, 2.0) });
    assert_eq!(clip.at(-3.0, 24), clip.at(0.0, 24));
    assert_eq!(clip.at(f32::NAN, 24), clip.at(0.0, 24));
    assert_eq!(clip.at(99.0, 24), clip.at(f32::INFINITY, 24));
    assert_eq!(clip.at(99.0, 24).0[5].x, 0.1);
}

#[test]
fn clips_without_a_rate_and_under_other_names_are_read() {
    let (rotations, places) = ((0..144).map(|i| i as f32 * 0.01).collect::<Vec<_>>(), [0.5f32; 6]);
    let columns = |range: std::ops::Range<usize>| -> Vec<f32> {
        (0..2).flat_map(|frame| rotations[72 * frame..][range.clone()].to_vec()).collect()
    };
    let path = archive(
        "flat.npz",
        &[
            ("poses", floats(&[2, 72], &rotations)),
            ("trans", floats(&[2, 3], &places)),
            ("fps", floats(&[], &[MotionClip::ASSUMED_FPS])),
        ],
    );
    let expected = MotionClip::load(&path).unwrap();
    assert_eq!(MotionClip::load_with_rate(&path).unwrap().1, Some(30.0));
    for arrays in [
        vec![("poses", floats(&[2, 24, 3], &rotations)), ("transl", floats(&[2, 3], &places))],
        vec![
            ("root_orient", floats(&[2, 3], &columns(0..3))),
            ("pose_body", floats(&[2, 69], &columns(3..72))),
            ("trans", floats(&[2, 3], &places)),
        ],
        vec![
            ("global_orient", floats(&[2, 1, 3], &columns(0..3))),
            ("body_pose", floats(&[2, 23, 3], &columns(3..72))),
            ("transl", floats(&[2, 3], &places)),
        ],
    ] {
        let path = archive("other-names.npz", &arrays);
        assert_eq!(MotionClip::load_with_rate(&path).unwrap(), (expected.clone(), None));
    }
}

#[test]
fn invalid_clips_are_refused() {
    let good = |key: &str| match key {
        "poses" => floats(&[2, 72], &[0.0; 144]),
        "trans" => floats(&[2, 3], &[0.0; 6]),
        _ => floats(&[], &[30.0]),
    };
    let with = |key: &str, bytes: Vec<u8>| {
        let mut arrays: Vec<_> = ["poses", "trans", "fps"].map(|k| (k, good(k))).into();
        arrays.retain(|(k, _)| *k != key);
        if !bytes.is_empty() {
            arrays.push((key, bytes));
        }
        MotionClip::load(&archive("wrong-clip.npz", &arrays)).map(|_| ()).unwrap_err().to_string()
    };
    for (key, bytes) in [
        ("poses", Vec::new()),
        ("trans", Vec::new()),
        ("poses", floats(&[2, 71], &[0.0; 142])),
        ("poses", floats(&[0, 72], &[])),
        ("poses", floats(&[3, 72], &[0.0; 216])),
        ("poses", floats(&[2, 72], &[f32::NAN; 144])),
        ("poses", floats(&[2, 72], &[1e30; 144])),
        ("trans", floats(&[2, 2], &[0.0; 4])),
        ("trans", floats(&[2, 3], &[-1e38; 6])),
        ("fps", floats(&[], &[0.0])),
        ("fps", floats(&[], &[-30.0])),
        ("fps", floats(&[], &[1e-40])),
        ("fps", floats(&[], &[f32::NAN])),
        ("fps", floats(&[2], &[30.0, 30.0])),
    ] {
        // Another number of frames shows first where the translations are held against it.
        let named = if bytes == floats(&[3, 72], &[0.0; 216]) { "trans" } else { key };
        let error = with(key, bytes);
        assert!(error.contains(named) && error.contains("wrong-clip.npz"), "{key}: {error}");
    }
}
