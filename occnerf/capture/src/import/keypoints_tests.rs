use glam::{DMat3, DVec3};
use serde_json::json;

use super::fit::FitFrame;
use super::write::Placed;
use super::*;
use crate::testing::{Directory, npy};

const COUNT: usize = 3;

/// Frames of a body in its rest pose 4 m away, and its joints' pixels.
pub(super) fn frames(model: &BodyModel) -> (Video, Vec<Placed>, Vec<[f64; 2]>) {
    let video = tests::video((1..=COUNT).map(|i| format!("{i:06}")), (640, 480));
    let turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let translation = DVec3::new(0.1, 0.2, 4.0);
    let placed = |index| {
        let (focal, centre) = ([500.0; 2], [320.0, 240.0]);
        let frame = FitFrame { index, world_to_camera: turn, focal, centre, ..FitFrame::default() };
        Placed { pose: vec![DVec3::ZERO; model.num_joints()], translation, frame, keypoints: Vec::new() }
    };
    let pixel = |joint: &glam::Vec3| {
        let at = turn * joint.as_dvec3() + translation;
        [500.0 * at.x / at.z + 320.0, 500.0 * at.y / at.z + 240.0]
    };
    let pixels = model.shaped(&[]).joints.iter().map(pixel).collect();
    (video, (0..COUNT).map(placed).collect(), pixels)
}

/// The 25 points of OpenPose, moved to the right.
pub(super) fn body25(pixels: &[[f64; 2]], by: f64) -> Vec<f64> {
    let mut points = vec![0.0; 75];
    for (point, joint) in [(2, 17), (3, 19), (4, 21), (5, 16), (9, 2), (10, 5), (13, 4), (14, 7)] {
        points[3 * point..3 * point + 3].copy_from_slice(&[pixels[joint][0] + by, pixels[joint][1], 0.9]);
    }
    points
}

#[test]
fn points_of_the_nearest_person_become_joints_of_the_body() {
    let model = BodyModel::embedded();
    let (video, mut placed, pixels) = frames(&model);
    let out = Directory::new("import-keypoints");
    for i in 1..=COUNT {
        let [near, far] = [3.0, 200.0].map(|by| json!({"pose_keypoints_2d": body25(&pixels, by), "face": []}));
        out.write(
            &format!("openpose/{i:06}_keypoints.json"),
            json!({"version": 1.3, "people": [far, near]}).to_string(),
        );
    }
    let said = keypoints::add(&out.path().join("openpose"), &mut placed, &[], &model, &video).unwrap();
    assert!(said.contains("openpose25 in 3 frames, 3.0 px"), "{said}");
    for frame in &placed {
        assert_eq!(frame.keypoints.len(), 8);
        let knee = frame.keypoints.iter().find(|point| point.joint == 4).unwrap();
        assert!((f64::from(knee.place.x) - pixels[4][0] - 3.0).abs() < 1e-3 && knee.confidence == 0.9);
    }

    // COCO's array; of the second frame nothing is known.
    let mut values = Vec::new();
    for frame in 0..COUNT {
        for joint in [15, 15, 15, 15, 15, 16, 17, 18, 19, 20, 21, 1, 2, 4, 5, 7, 8] {
            let confidence = if frame == 1 { 0.1 } else { 1.2 };
            values.extend([pixels[joint][0] as f32, pixels[joint][1] as f32 + 2.0, confidence]);
        }
    }
    out.write("coco.npy", npy(&[3, 17, 3], &values));
    let said = keypoints::add(&out.path().join("coco.npy"), &mut placed, &[], &model, &video).unwrap();
    assert!(said.contains("coco17 in 2 frames, 2.0 px"), "{said}");
    assert_eq!(placed.iter().map(|frame| frame.keypoints.len()).collect::<Vec<_>>(), [12, 0, 12]);
    assert!(placed[0].keypoints.iter().all(|point| point.confidence == 1.0));

    values[7] = f32::NAN;
    let fault = |name: &str, bytes: Vec<u8>, words: [&str; 2]| {
        out.write(name, bytes);
        let error = keypoints::add(&out.path().join(name), &mut frames(&model).1, &[], &model, &video);
        let message = error.unwrap_err().to_string();
        assert!(!message.contains('\n') && words.iter().all(|word| message.contains(word)), "{message}");
    };
    fault("nan.npy", npy(&[3, 17, 3], &values), ["NaN", "nan.npy"]);
    fault("far.npy", npy(&[3, 17, 3], &[1e9; 153]), ["pixels", "1000000000"]);
    fault("four.npy", npy(&[3, 4, 3], &[1.0; 36]), ["17 (COCO) or 25 (OpenPose)", "4"]);
    fault("flat.npy", npy(&[153], &[1.0; 153]), ["shape [3, points, 3]", "[153]"]);
    fault("none.npy", npy(&[3, 17, 3], &[0.0; 153]), ["a person", "none"]);
    fault("long.npy", npy(&[9, 17, 3], &[1.0; 459]), ["shape [3, points, 3]", "9 frames"]);
    out.write("one/000001_keypoints.json", r#"{"people": [{"pose_keypoints_2d": [1]}]}"#);
    let error = keypoints::add(&out.path().join("one"), &mut frames(&model).1, &[], &model, &video).unwrap_err();
    assert!(error.to_string().contains("1 numbers"), "{error}");
}
