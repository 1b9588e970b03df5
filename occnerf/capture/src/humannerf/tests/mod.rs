mod errors;
mod fixture;

use glam::Vec3;
use smpl::Placement;

use self::fixture::{Fixture, SIZE};
use crate::testing::body;
use crate::{LoadOptions, find_body, load_capture};

#[test]
fn a_whole_capture_is_read() {
    let fixture = Fixture::new("whole");
    let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    assert_eq!(capture.name, crate::pictures::file_name(fixture.dir.path()));
    let names: Vec<&str> = capture.train.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(names, ["frame_000000", "frame_000001", "frame_000002"]);
    assert_eq!(capture.mean_betas, [0.5]);
    let frame = &capture.train[1];
    assert_eq!(
        (frame.pixels().unwrap().image.width, frame.pixels().unwrap().image.height, frame.pixels().unwrap().mask.len()),
        (6, 4, 24)
    );
    assert_eq!(frame.pose, [Vec3::ZERO, Vec3::new(0.0, 0.25, 0.0)]);
    assert_eq!(
        frame.placement,
        Placement::Origin { rotation: Vec3::new(0.0, 0.5, 0.0), translation: Vec3::new(0.125, 0.0, 0.0) }
    );
    assert_eq!(frame.betas, [0.5]);
    assert_eq!(frame.camera.centre.x, 3.0);
    assert!(frame.pixels().unwrap().occluder.is_none());

    assert_eq!(capture.eval.len(), 2);
    assert_eq!(capture.eval[1].camera_name, "Camera_B2");
    assert_eq!(capture.eval[1].train_index, 2);
    assert_eq!(capture.eval[1].frame.name, "frame_000002");
}

#[test]
fn the_pixel_centre_moves_the_principal_point() {
    let fixture = Fixture::new("centre");
    let options = LoadOptions { pixel_centre: 0.0, ..LoadOptions::default() };
    let capture = load_capture(fixture.dir.path(), &body(), &options).unwrap();
    assert_eq!(capture.train[0].camera.centre, glam::Vec2::new(3.5, 2.5));
}

#[test]
fn stride_and_limits_keep_frames_and_their_views_together() {
    let fixture = Fixture::new("stride");
    // Frames 0 to 2; the camera kept back has 0 and 2.
    for (options, names, kept) in [
        (LoadOptions { stride: 2, ..LoadOptions::default() }, &["frame_000000", "frame_000002"][..], &[0, 1][..]),
        (LoadOptions { max_frames: Some(2), ..LoadOptions::default() }, &["frame_000000", "frame_000001"], &[0]),
        (LoadOptions { eval_stride: 3, max_frames: Some(1), ..LoadOptions::default() }, &["frame_000000"], &[0]),
    ] {
        let capture = load_capture(fixture.dir.path(), &body(), &options).unwrap();
        assert_eq!(capture.train.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), names);
        assert_eq!(capture.eval.iter().map(|e| e.train_index).collect::<Vec<_>>(), kept);
        assert!(capture.eval.iter().all(|e| e.frame.name == names[e.train_index]));
    }
}

#[test]
fn a_frame_in_which_the_subject_is_wholly_hidden_is_kept() {
    let fixture = Fixture::new("one-hidden");
    fixture.dir.stripe("masks/frame_000001.png", SIZE, 0);
    let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    assert_eq!(capture.train.len(), 3);
}

#[test]
fn jpeg_frames_and_a_capture_without_eval_are_read() {
    let fixture = Fixture::new("jpeg");
    let path = fixture.dir.file("images/frame_000001.png");
    let decoded = image::open(&path).unwrap();
    decoded.save(path.with_extension("jpg")).unwrap();
    std::fs::remove_file(path).unwrap();
    std::fs::remove_dir_all(fixture.dir.file("eval")).unwrap();
    let capture = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).unwrap();
    assert_eq!((capture.train.len(), capture.eval.len()), (3, 0));
}

#[test]
fn the_nearest_body_is_found() {
    let fixture = Fixture::new("find");
    let scene = fixture.dir.file("captures/scene");
    std::fs::create_dir_all(&scene).unwrap();
    // Not an archive: passed over.
    fixture.dir.write("body/a.npz", "no");
    let message = find_body(&scene).unwrap_err().to_string();
    assert!(message.contains("annots.npy") && message.contains("metadata.json"), "no capture: {message}");
    for layout in ["annots.npy", "metadata.json", "mesh_infos.pkl"] {
        std::fs::write(scene.join(layout), b"").unwrap();
        let found = find_body(&scene);
        assert!(found.is_ok_and(|path| !path.starts_with(fixture.dir.path())) || find_body(&scene).is_err());
        std::fs::write(scene.join("body.npz"), b"own").unwrap();
        assert_eq!(find_body(&scene).unwrap(), scene.join("body.npz"));
        std::fs::remove_file(scene.join("body.npz")).unwrap();
        std::fs::remove_file(scene.join(layout)).unwrap();
    }
}
