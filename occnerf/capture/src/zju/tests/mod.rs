mod errors;
mod fixture;
mod shared;

use glam::{Vec2, Vec3};
use smpl::Placement;
use volrender::Distortion;

use self::fixture::{Fixture, SIZE};
use crate::testing::{Py, array, body};
use crate::{LoadOptions, load_capture};

#[test]
fn a_whole_capture_is_read() {
    let fixture = Fixture::new("zju-whole");
    let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    let names: Vec<&str> = capture.train.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["frame_000000", "frame_000001", "frame_000002"]);
    assert_eq!(capture.mean_betas, [0.5]);
    let frame = &capture.train[1];
    assert_eq!(frame.pose, [Vec3::ZERO, Vec3::new(0.0, 0.25, 0.0)]);
    let (rotation, translation) = (Vec3::new(0.0, 0.5, 0.0), Vec3::new(0.125, 0.0, 0.0));
    assert_eq!(frame.placement, Placement::Origin { rotation, translation });
    assert_eq!(frame.camera.world_to_camera.translation, Vec3::new(0.0, 0.0, 4.0).into(), "millimetres");
    assert_eq!((frame.camera.width, frame.camera.height), SIZE);
    // Labels 1 and 2 of one mask and the other mask are all the subject.
    let subject: Vec<usize> = (0..SIZE.0 as usize).filter(|&x| frame.pixels().unwrap().mask[x] > 0.5).collect();
    assert_eq!(subject, [4, 5, 6, 7]);
    assert!(frame.pixels().unwrap().mask.iter().all(|m| [0.0, 1.0].contains(m)));
    assert!(
        (frame.pixels().unwrap().image.rgb(5, 0)[0] - 200.0 / 255.0).abs() < 0.02
            && frame.pixels().unwrap().image.rgb(0, 0) == [0.0; 3]
    );

    // The second camera lacks frame 1; the last picture that the file lists is not on disk.
    let eval: Vec<(&str, usize)> = capture.eval.iter().map(|e| (e.camera_name.as_str(), e.train_index)).collect();
    assert_eq!(eval, [("Camera_B2", 0)]);
    assert_eq!(capture.eval[0].frame.camera.focal.x, 16.0);
}

#[test]
fn the_training_camera_is_chosen_by_name_or_number() {
    let fixture = Fixture::new("zju-camera");
    fixture.dir.stripe("Camera_B2/000002.png", SIZE, 200);
    for camera in ["2", "Camera_B2"] {
        let options = LoadOptions { camera: Some(camera.to_owned()), ..LoadOptions::default() };
        let capture = load_capture(fixture.dir.path(), &body(), &options).unwrap();
        let names: Vec<&str> = capture.train.iter().map(|f| f.name.as_str()).collect();
        assert_eq!(names, ["frame_000000", "frame_000002"]);
        let eval: Vec<(&str, usize)> = capture.eval.iter().map(|e| (e.camera_name.as_str(), e.train_index)).collect();
        assert_eq!(eval, [("Camera_B1", 0), ("Camera_B1", 1)]);
    }
    let options = LoadOptions { camera: Some("3".to_owned()), ..LoadOptions::default() };
    let message = load_capture(fixture.dir.path(), &body(), &options).unwrap_err().to_string();
    assert!(message.contains("camera") && message.contains("Camera_B1, Camera_B2"), "{message}");
}

#[test]
fn parameters_counted_from_one_are_read() {
    let fixture = Fixture::new("zju-offset");
    for i in (0..3).rev() {
        let path = |i: usize| fixture.dir.path().join(format!("new_params/{i}.npy"));
        std::fs::rename(path(i), path(i + 1)).unwrap();
    }
    let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    assert_eq!(capture.train.len(), 3);
}

#[test]
fn cameras_may_be_nested_lists_or_whole_arrays() {
    let mut fixture = Fixture::new("zju-lists");
    let row = |values: [f64; 3]| array(&[3], &values);
    *fixture.annots.at(&["cams", "K", "1"]) =
        Py::List(vec![row([16.0, 0.0, 6.0]), row([0.0, 16.0, 4.0]), row([0.0, 0.0, 1.0])]);
    *fixture.annots.at(&["cams", "T"]) = array(&[2, 3], &[0.0, 0.0, 4000.0, 0.0, 0.0, 4000.0]);
    *fixture.annots.at(&["cams", "D"]) = array(&[2, 1, 5], &[0.0; 10]);
    fixture.write();
    let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    assert_eq!(capture.eval[0].frame.camera, capture.train[0].camera);
}

#[test]
fn hidden_pixels_never_reach_training_and_kept_back_views_are_whole() {
    let fixture = Fixture::new("zju-occluded");
    let hidden = |options: &LoadOptions| {
        let capture = load_capture(fixture.dir.path(), &body(), options).unwrap();
        for frame in &capture.train {
            for (pixel, mask) in frame.pixels().unwrap().image.pixels.chunks(3).zip(&frame.pixels().unwrap().mask) {
                assert!(*mask > 0.0 || pixel == [0.0; 3], "a hidden colour");
            }
        }
        assert_eq!(
            capture.eval[0].frame.pixels().unwrap().mask.iter().filter(|m| **m > 0.5).count(),
            4 * SIZE.1 as usize
        );
        let columns =
            |f: &crate::Frame| (0..SIZE.0 as usize).filter(|&x| f.pixels().unwrap().mask[x] > 0.5).collect::<Vec<_>>();
        capture.train.iter().map(columns).collect::<Vec<_>>()
    };
    let whole = vec![4, 5, 6, 7];
    assert_eq!(hidden(&LoadOptions::default()), [whole.clone(), whole.clone(), whole.clone()]);
    fixture.occlusion("Camera_B1", [12, 8], [4, 0, 5, 8], &[1]);
    assert_eq!(hidden(&LoadOptions::default()), [whole.clone(), vec![5, 6, 7], whole.clone()]);
    // Rows as well as columns: the upper half of a column.
    fixture.occlusion("Camera_B1", [12, 8], [4, 0, 5, 4], &[0]);
    let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    let column: Vec<f32> = (0..8).map(|y| capture.train[0].pixels().unwrap().mask[y * 12 + 4]).collect();
    assert_eq!(column, [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
    fixture.occlusion("Camera_B2", [12, 8], [4, 0, 5, 8], &[1]);
    assert_eq!(hidden(&LoadOptions::default())[1], whole, "about another camera");
}

#[test]
fn lens_distortion_is_undone() {
    let size = (96, 64);
    let mut fixture = Fixture::new("zju-lens");
    let coefficients = [-0.25f64, 0.08, 0.002, -0.003, 0.01];
    let lens = Distortion::from_opencv(coefficients.map(|c| c as f32));
    let (focal, centre) = (Vec2::splat(80.0), Vec2::new(50.0, 30.0));
    // A smooth pattern on the image plane of a perfect lens.
    let pattern = |p: Vec2| 0.5 + 0.4 * (p.x * 9.0).sin() * (p.y * 7.0).cos();
    let level = |value: f32| (value * 255.0).round() as u8;
    for i in 0..3 {
        fixture.dir.picture(&format!("Camera_B1/{i:06}.png"), size, |x, y| {
            let seen = (Vec2::new(x as f32, y as f32) + 0.5 - centre) / focal;
            level(pattern(lens.undistort(seen).unwrap()))
        });
        for kind in ["mask_cihp", "mask"] {
            fixture.dir.picture(&format!("{kind}/Camera_B1/{i:06}.png"), size, |_, _| 1);
        }
    }
    let k = [80.0, 0.0, 50.0, 0.0, 80.0, 30.0, 0.0, 0.0, 1.0];
    *fixture.annots.at(&["cams", "K", "0"]) = array(&[3, 3], &k);
    let error = |fixture: &Fixture| {
        let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
        let frame = &capture.train[0];
        let (mut worst, mut seen) = (0.0f32, 0);
        let shown = frame.pixels().unwrap();
        for (i, pixel) in shown.image.pixels.chunks(3).enumerate().filter(|(i, _)| shown.mask[*i] > 0.999) {
            let at = Vec2::new((i % 96) as f32 + 0.5, (i / 96) as f32 + 0.5);
            worst = worst.max((pixel[0] - pattern((at - frame.camera.centre) / frame.camera.focal)).abs());
            seen += 1;
        }
        assert!(seen > 96 * 64 / 2, "{seen}");
        worst
    };
    fixture.write();
    let ignored = error(&fixture);
    *fixture.annots.at(&["cams", "D", "0"]) = array(&[5, 1], &coefficients);
    fixture.write();
    let undone = error(&fixture);
    // Rounding to levels, and bilinear: (1/80)² / 8 · 0.4 · (81 + 49 + 2 · 63).
    assert!(undone < 0.5 / 255.0 + 0.0025, "{undone}");
    assert!(ignored > 0.05, "the distortion must matter for the test to say anything: {ignored}");
}

#[test]
fn resizing_scales_projections_exactly() {
    let fixture = Fixture::new("zju-resize");
    let large = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    let options = LoadOptions { resize: Some(6), ..LoadOptions::default() };
    let small = load_capture(fixture.dir.path(), &body(), &options).unwrap();
    for (a, b) in large.train.iter().zip(&small.train) {
        assert_eq!(
            (b.pixels().unwrap().image.width, b.pixels().unwrap().image.height, b.pixels().unwrap().mask.len()),
            (6, 4, 24)
        );
        let posed = body().pose(&body().shaped(&a.betas), &a.pose, a.placement);
        for v in posed.vertices {
            let (p, q) = (a.camera.project(v).unwrap(), b.camera.project(v).unwrap());
            assert!((p.truncate() * 0.5).distance(q.truncate()) < 1e-5 && p.z == q.z, "{p} {q}");
        }
        // Coverage and premultiplied colour shrink alike.
        let sum = |values: &[f32]| values.iter().sum::<f32>();
        assert!((sum(&b.pixels().unwrap().mask) - 0.25 * sum(&a.pixels().unwrap().mask)).abs() < 1e-4);
        for (pixel, mask) in b.pixels().unwrap().image.pixels.chunks(3).zip(&b.pixels().unwrap().mask) {
            assert!((pixel[0] - mask * 200.0 / 255.0).abs() < 0.02);
        }
    }
    let options = LoadOptions { resize: Some(100), ..LoadOptions::default() };
    let same = load_capture(fixture.dir.path(), &body(), &options).unwrap();
    assert_eq!(same.train[0].pixels().unwrap().image, large.train[0].pixels().unwrap().image, "nothing is enlarged");
}
