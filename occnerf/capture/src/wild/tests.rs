use glam::Vec3;
use serde_json::{Value, json};
use smpl::{BodyModel, Placement};

use crate::testing::{Directory, fails, load, load_with, names, overlap, shared, views};
use crate::{Frame, LoadOptions, find_body, load_capture};

const SIZE: (u32, u32) = (6, 4);

fn frame() -> Value {
    json!({
        "poses": [0.0, 0.5, 0.0, 0.0, 0.25, 0.0],
        "betas": [0.5],
        "cam_intrinsics": [[8, 0, 3], [0, 8, 2], [0, 0, 1]],
        "cam_extrinsics": [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]],
        "comment": {"anything": ["else", 1]},
    })
}

/// Four frames, one of them with an occluder mask and two of them clean as well.
fn fixture(name: &str) -> (Directory, Value) {
    let dir = Directory::new(name);
    for i in 0..4 {
        dir.stripe(&format!("images/{i:02}.png"), SIZE, 200);
        dir.stripe(&format!("masks/{i:02}.png"), SIZE, 255);
    }
    // The fitter may have lost the person: a picture that metadata.json does not mention.
    dir.stripe("images/99.png", SIZE, 200);
    dir.picture("occluders/01.png", SIZE, |x, _| if x < 1 { 255 } else { 0 });
    for i in [0, 2] {
        dir.stripe(&format!("clean/images/{i:02}.png"), SIZE, 100);
        dir.stripe(&format!("clean/masks/{i:02}.png"), SIZE, 255);
    }
    let metadata = json!({"02": frame(), "00": frame(), "01": frame(), "03": frame()});
    dir.write("metadata.json", metadata.to_string());
    (dir, metadata)
}

#[test]
fn frames_come_in_the_order_of_their_numbers() {
    let (dir, _) = fixture("wild-numbers");
    ["occluders", "clean"].into_iter().for_each(|folder| std::fs::remove_dir_all(dir.path().join(folder)).unwrap());
    let mut entries = serde_json::Map::new();
    for name in ["1", "2", "9", "10"] {
        dir.stripe(&format!("images/{name}.png"), SIZE, 200);
        dir.stripe(&format!("masks/{name}.png"), SIZE, 255);
        entries.insert(name.to_owned(), frame());
    }
    dir.write("metadata.json", Value::Object(entries).to_string());
    assert_eq!(names(&load(&dir).unwrap().train), ["1", "2", "9", "10"]);
}

#[test]
fn a_metadata_of_any_text_encoding_is_read_and_occluders_of_no_frame_are_refused() {
    let (dir, metadata) = fixture("wild-text");
    let expected = load(&dir).unwrap();
    let text = serde_json::to_string_pretty(&metadata).unwrap();
    let utf16: Vec<u8> = "\u{feff}".chars().chain(text.chars()).flat_map(|c| (c as u16).to_le_bytes()).collect();
    for bytes in [
        format!("\u{feff}{text}").into_bytes(),
        text.replace('\n', "\r").into_bytes(),
        text.replace('\n', "\r\n").into_bytes(),
        utf16,
    ] {
        dir.write("metadata.json", bytes);
        let found = load(&dir).unwrap();
        assert!(found.train.iter().zip(&expected.train).all(|(a, b)| a.pose == b.pose && a.name == b.name));
    }
    std::fs::rename(dir.path().join("occluders"), dir.path().join("old")).unwrap();
    dir.stripe("occluders/mask_77.png", SIZE, 255);
    fails(&dir, &["occluders", "names of frames", "mask_77"]);
}

#[test]
fn what_the_lens_never_saw_is_unknown_where_occluders_are_known() {
    let (dir, mut metadata) = fixture("wild-lens");
    metadata["01"]["distortions"] = json!([2.0, 0.0, 0.0, 0.0, 0.0]);
    dir.write("metadata.json", metadata.to_string());
    let capture = load(&dir).unwrap();
    let pixels = capture.train[1].pixels().unwrap();
    let occluder = pixels.occluder.as_ref().unwrap();
    // Corners lie beyond the photograph; the middle right does not, and nothing covers it.
    assert!(occluder[5] && occluder[23] && !occluder[6 + 3], "{occluder:?}");
}

#[test]
fn key_points_are_read_at_the_size_of_the_pictures() {
    let (dir, mut metadata) = fixture("wild-keypoints");
    metadata["01"]["keypoints"] = json!([[1, 3.0, 2.0, 0.5], [0, -1.0, 9.5, 1.0]]);
    metadata["02"]["keypoints"] = json!([]);
    dir.write("metadata.json", metadata.to_string());
    let options = LoadOptions { resize: Some(3), ..LoadOptions::default() };
    for (options, scale) in [(LoadOptions::default(), 1.0), (options, 0.5)] {
        let capture = load_with(&dir, options).unwrap();
        let found = &capture.train[1].keypoints;
        assert_eq!((found.len(), found[0].joint, found[0].confidence), (2, 1, 0.5));
        assert_eq!(found[0].place, scale * glam::Vec2::new(3.0, 2.0));
        assert!(capture.train[0].keypoints.is_empty() && capture.train[2].keypoints.is_empty());
    }
    for (points, words) in [
        (json!([[2, 1.0, 1.0, 1.0]]), ["keypoints", "a joint below 2"]),
        (json!([[0.5, 1.0, 1.0, 1.0]]), ["keypoints", "a joint below 2"]),
        (json!([[0, 1e7, 1.0, 1.0]]), ["keypoints", "pixel"]),
        (json!([[0, 1.0, 1.0, 1.5]]), ["keypoints", "confidence"]),
        (json!([[0, 1.0, 1.0]]), ["keypoints", "shape [N, 4]"]),
    ] {
        metadata["01"]["keypoints"] = points;
        dir.write("metadata.json", metadata.to_string());
        fails(&dir, &words);
    }
}

#[test]
fn a_whole_capture_is_read() {
    let (dir, _) = fixture("wild-whole");
    let capture = load(&dir).unwrap();
    assert_eq!(names(&capture.train), ["00", "01", "02", "03"]);
    assert_eq!(capture.mean_betas, [0.5]);
    let frame = &capture.train[1];
    assert_eq!(frame.placement, Placement::Pelvis { translation: Vec3::ZERO });
    assert_eq!(frame.pose, [Vec3::new(0.0, 0.5, 0.0), Vec3::new(0.0, 0.25, 0.0)]);
    assert_eq!(frame.camera.world_to_camera.translation.z, 4.0);
    let pixels = frame.pixels().unwrap();
    let occluder = pixels.occluder.as_ref().unwrap();
    assert_eq!(occluder.iter().filter(|o| **o).count(), 4, "one column");
    assert!(capture.train[0].pixels().unwrap().occluder.is_none());
    assert_eq!(views(&capture), [("clean", 0), ("clean", 2)]);
    assert_eq!(capture.eval[1].frame.name, "02");
    assert_eq!(capture.eval[0].frame.camera, capture.train[0].camera);
    assert!((capture.eval[0].frame.pixels().unwrap().image.rgb(3, 0)[0] - 100.0 / 255.0).abs() < 1e-6);
}

#[test]
fn poses_may_be_rows_and_a_pixel_that_an_occluder_touches_is_covered() {
    let (dir, mut metadata) = fixture("wild-rows");
    metadata["01"]["poses"] = json!([[0.0, 0.5, 0.0], [0.0, 0.25, 0.0]]);
    dir.write("metadata.json", metadata.to_string());
    let options = LoadOptions { resize: Some(3), ..LoadOptions::default() };
    let capture = load_with(&dir, options).unwrap();
    assert_eq!(capture.train[1].pose, capture.train[0].pose);
    // Half of the first column was covered.
    let occluder = capture.train[1].pixels().unwrap().occluder.unwrap();
    assert_eq!(occluder, [true, false, false, true, false, false]);
}

#[test]
fn stride_and_limit_keep_frames_and_their_views_together() {
    let (dir, _) = fixture("wild-stride");
    let options = LoadOptions { stride: 2, max_frames: Some(2), ..LoadOptions::default() };
    let capture = load_with(&dir, options).unwrap();
    assert_eq!(names(&capture.train), ["00", "02"]);
    assert_eq!(views(&capture), [("clean", 0), ("clean", 1)]);
    let capture = load_with(&dir, LoadOptions { eval_stride: 3, ..LoadOptions::default() }).unwrap();
    assert_eq!(views(&capture), [("clean", 0)]);
    for (word, options) in [
        ("stride", LoadOptions { stride: 0, ..LoadOptions::default() }),
        ("eval_stride", LoadOptions { eval_stride: 0, ..LoadOptions::default() }),
        ("max_frames", LoadOptions { max_frames: Some(0), ..LoadOptions::default() }),
        ("resize", LoadOptions { resize: Some(0), ..LoadOptions::default() }),
        ("camera", LoadOptions { camera: Some("1".to_owned()), ..LoadOptions::default() }),
        ("pixel_centre", LoadOptions { pixel_centre: f32::NAN, ..LoadOptions::default() }),
    ] {
        let message = load_with(&dir, options).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
}

#[test]
fn memory_beyond_the_bound_names_options_that_fit() {
    let (dir, _) = fixture("wild-memory");
    // 4 + 2 frames whose bodies have 8 vertices of 24 bytes, labels of 4 frames, and 24 pixels of
    // 48 bytes to decode.
    let fits = LoadOptions { max_bytes: 6 * 8 * 24 + 4 * 10 + 24 * 48, ..LoadOptions::default() };
    assert!(load_with(&dir, fits.clone()).is_ok());
    let tight = LoadOptions { max_bytes: fits.max_bytes - 1, ..fits };
    let message = load_with(&dir, tight.clone()).unwrap_err().to_string();
    for word in ["max_bytes", "stride 2", "eval_stride 2", "memory 1", "6 bodies of 8 vertices", "1152 bytes to decode"]
    {
        assert!(message.contains(word), "{word}: {message}");
    }
    for options in [
        LoadOptions { resize: Some(5), ..tight.clone() },
        LoadOptions { stride: 2, ..tight.clone() },
        LoadOptions { eval_stride: 4, ..tight },
    ] {
        assert!(load_with(&dir, options.clone()).is_ok(), "{options:?}");
    }
    let nothing = LoadOptions { max_bytes: 0, ..LoadOptions::default() };
    let message = load_with(&dir, nothing).unwrap_err().to_string();
    assert!(message.contains("would fit: memory 1)"), "{message}");
}

/// Pictures that fit stay in memory; the others are read each time.
#[test]
fn what_is_not_in_memory_is_read_when_asked_for() {
    let (dir, _) = fixture("wild-demand");
    let least = 6 * 8 * 24 + 4 * 10 + 24 * 48;
    let paint = |level: u8| (0..4).for_each(|i| dir.stripe(&format!("images/{i:02}.png"), SIZE, level));
    let with = |room: u64| load_with(&dir, LoadOptions { max_bytes: least + room, ..LoadOptions::default() });
    let level = |frame: &Frame| frame.pixels().map(|pixels| (pixels.image.rgb(3, 0)[0] * 255.0).round());
    let reread = |room: u64| {
        paint(200);
        let capture = with(room).unwrap();
        paint(100);
        capture.train.iter().filter(|frame| level(frame).unwrap() == 100.0).count()
    };
    // A packed grey picture has tables of 2 KiB: none, one and all six have room.
    assert_eq!([0, 2304, 10 * 2304].map(reread), [4, 3, 0]);
    let capture = with(0).unwrap();
    // Damage that came later is told when it is met, as that of headers was at once.
    dir.write("images/02.png", "no picture");
    dir.stripe("masks/03.png", (5, 4), 255);
    for (i, words) in [(2, ["images/02.png", "picture"]), (3, ["masks/03.png", "5×4"])] {
        let message = level(&capture.train[i]).unwrap_err().to_string();
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
    }
    let message = with(0).unwrap_err().to_string();
    assert!(message.contains("images/02.png"), "{message}");
    assert!(level(&capture.train[0]).is_ok() && capture.clone().train[1].pixels().is_ok());
}

#[test]
fn faults_of_frames_name_file_and_key() {
    let diagonal = |x: f64, y: f64| json!([[x, 0, 0, 0], [0, y, 0, 0], [0, 0, -1, 4]]);
    let lens = |f: f64, c: f64| json!([[f, 0, c], [0, f, 2], [0, 0, 1]]);
    let cases: [(&str, Value, &[&str]); 19] = [
        ("poses", json!([0.0, 0.0, 0.0, 0.0, 0.0]), &["[6]", "[5]"]),
        ("poses", json!("none"), &["an array", "str"]),
        ("poses", json!([[0.0, 1.0], [0.0]]), &["item 1 of shape [1] after [2]"]),
        ("poses", json!(null), &["an array", "None"]),
        ("poses", json!([0, 0, 0, 0, 1e30, 0]), &["1000"]),
        ("betas", json!([]), &["1 to 1"]),
        ("betas", json!([0, 0, 0, 0, 0]), &["1 to 1", "[5]"]),
        ("betas", json!([1e30]), &["1000"]),
        ("betas", json!([1e39]), &["finite", "flat index 0"]),
        ("cam_intrinsics", json!([[8, 0], [0, 8]]), &["[3, 3]", "[2, 2]"]),
        ("cam_intrinsics", lens(0.0, 3.0), &["pinhole"]),
        ("cam_intrinsics", lens(-8.0, 3.0), &["pinhole"]),
        ("cam_intrinsics", lens(1e-30, 3.0), &["pinhole", "10000000"]),
        ("cam_intrinsics", lens(1e30, 3.0), &["pinhole", "10000000"]),
        ("cam_intrinsics", lens(8.0, -1e30), &["pinhole", "10000000"]),
        ("cam_extrinsics", json!({"R": 1}), &["an array", "dict"]),
        ("cam_extrinsics", diagonal(1.0, 1.0), &["rotation"]),
        ("cam_extrinsics", diagonal(1.1, -1.1), &["rotation"]),
        ("distortions", json!([0.1]), &["5 numbers"]),
    ];
    let (dir, metadata) = fixture("wild-values");
    for (key, value, words) in cases {
        let mut broken = metadata.clone();
        broken["02"][key] = value;
        dir.write("metadata.json", broken.to_string());
        fails(&dir, &[&["metadata.json", &format!("02.{key}")], words].concat());
    }
    for key in ["poses", "betas", "cam_intrinsics", "cam_extrinsics"] {
        let mut broken = metadata.clone();
        broken["02"].as_object_mut().unwrap().remove(key);
        dir.write("metadata.json", broken.to_string());
        fails(&dir, &["metadata.json", &format!("02.{key}"), "no such key"]);
    }
    // Behind the camera in one frame only: not an error.
    let mut away = metadata.clone();
    // The last row as a product of matrices has it.
    away["01"]["cam_extrinsics"][3] = json!([0.0, 1e-50, 0.0, 0.999_999_999_999_999_9]);
    away["02"]["cam_extrinsics"][2][3] = json!(-40.0);
    dir.write("metadata.json", away.to_string());
    assert!(load(&dir).is_ok());
    for name in ["00", "01", "02", "03"] {
        away[name]["cam_extrinsics"][2][3] = json!(-40.0);
    }
    dir.write("metadata.json", away.to_string());
    fails(&dir, &["metadata.json", "sees the posed body", "4 frames"]);
}

#[test]
fn faults_of_the_file_are_told() {
    let (dir, metadata) = fixture("wild-file");
    let text = metadata.to_string();
    for (broken, words) in [
        ("{\"00\":".repeat(100_000), &["00", "recursion limit"][..]),
        (format!("{{\"00\":{{\"poses\":{}", "[".repeat(100_000)), &["00: poses", "recursion limit"]),
        (text.replace("0.25", "NaN"), &["poses"]),
        (text.replace("0.25", "1e999"), &["poses", "out of range"]),
        (format!("{{\"00\":{{\"x\":[{}0]}}}}", "[],".repeat(1 << 21)), &["00: x", "more than 2097152 values"]),
        (format!("{{\"00\":{{\"x\":[{}\"a\"]}}}}", "[1],".repeat(1 << 21)), &["00: x", "more than 2097152 values"]),
        (text[..text.len() / 2].to_owned(), &["EOF"]),
        ("[1, 2]".to_owned(), &["a dictionary"]),
        ("{\"00\": 3}".to_owned(), &["00", "a dictionary"]),
        ("{}".to_owned(), &["a frame"]),
        (String::new(), &["EOF"]),
        ("\u{feff}{}".to_owned(), &["a frame"]),
    ] {
        dir.write("metadata.json", broken);
        fails(&dir, &[&["metadata.json"], words].concat());
    }
    dir.write("metadata.json", [0xff, 0xfe, 0x00]);
    fails(&dir, &["metadata.json"]);
}

#[test]
fn faults_of_pictures_name_them() {
    let (dir, _) = fixture("wild-pictures");
    dir.remove("images/02.png");
    fails(&dir, &["images/02.png", "missing", "metadata.json"]);
    dir.stripe("images/02.png", (7, 4), 200);
    fails(&dir, &["images/02.png", "size", "6×4", "7×4"]);
    dir.stripe("images/02.png", SIZE, 200);
    dir.stripe("occluders/02.png", (6, 5), 255);
    fails(&dir, &["occluders/02.png", "size", "6×4", "6×5"]);
    dir.remove("occluders/02.png");
    dir.remove("clean/masks/02.png");
    fails(&dir, &["clean/masks/02.png", "missing"]);
    dir.stripe("clean/masks/02.png", SIZE, 0);
    dir.stripe("clean/masks/00.png", SIZE, 1);
    fails(&dir, &["clean/masks", "subject pixel", "largest value is 1"]);
    dir.stripe("clean/masks/00.png", SIZE, 255);
    assert!(load(&dir).is_ok());
}

#[test]
fn the_shared_captures_are_read_and_the_body_covers_the_subject() {
    for name in ["mild", "severe"] {
        let Some(scene) = shared(&format!("captures/ocmotion_like/{name}")) else { return };
        let body = BodyModel::load(&find_body(&scene).unwrap()).unwrap();
        let capture = load_capture(&scene, &body, &LoadOptions::default()).unwrap();
        assert_eq!((capture.train.len(), capture.eval.len()), (100, 10));
        for eval in &capture.eval {
            assert_eq!(capture.train[eval.train_index].name, eval.frame.name);
            assert!(overlap(&eval.frame, &body) > 0.6, "{} {}", eval.frame.name, overlap(&eval.frame, &body));
        }
        // The published person also where the occluders are known, which are never on the subject's
        // mask.
        for frame in capture.train.iter().step_by(13) {
            let pixels = frame.pixels().unwrap();
            let occluder = pixels.occluder.as_ref().unwrap();
            assert!(pixels.mask.iter().zip(occluder).all(|(&mask, &occluded)| !(occluded && mask > 0.5)));
            assert!(overlap(frame, &body) > 0.6, "{} {}", frame.name, overlap(frame, &body));
        }
    }
}

#[cfg(unix)]
#[test]
fn links_that_lead_nowhere_are_named() {
    for name in ["occluders", "clean", "clean/images"] {
        let (dir, _) = fixture("wild-link");
        let path = dir.path().join(name);
        let _ = std::fs::remove_dir_all(&path);
        std::os::unix::fs::symlink("nowhere", &path).unwrap();
        fails(&dir, &[name]);
    }
}
