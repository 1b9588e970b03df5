//! Captures written from what estimators and segmenters leave, read back.

use std::path::{Path, PathBuf};

use array_files::npz::Npz;
use glam::{DMat3, DQuat, DVec3};
use occnerf::capture::{ImportOptions, Imported, LoadOptions, Tool, import, load_capture};
use serde_json::Value;
use smpl::BodyModel;
use testkit::files::shared;

fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("import").join(name);
    let _ = std::fs::remove_dir_all(&path);
    path
}

fn options(dir: &Path, fit: &str, masks: Option<&str>) -> ImportOptions {
    let masks = masks.map(|masks| dir.join(masks));
    ImportOptions { frames: dir.join("frames"), fit: dir.join(fit), masks, ..ImportOptions::default() }
}

fn metadata(capture: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(capture.join("metadata.json")).unwrap()).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(items) => items.iter().flat_map(numbers).collect(),
        other => vec![other.as_f64().unwrap()],
    }
}

fn near(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst <= tolerance, "{what}: off by {worst}");
}

/// Rows of a rotation, from its axis-angle.
fn rotation(axis: &[f64]) -> DMat3 {
    DMat3::from_quat(DQuat::from_scaled_axis(DVec3::from_slice(axis)))
}

#[test]
fn captures_hold_what_another_reader_made_of_the_same_files() {
    let Some(dir) = shared("estimators") else { return };
    for (name, fit, masks, person, tool, frames) in [
        ("wham", "wham/wham_output.pkl", Some("sam2"), None, Tool::Wham, 20),
        ("wham_person1", "wham/wham_output.pkl", Some("sam2"), Some("1"), Tool::Wham, 6),
        ("wham_gap", "wham/wham_output_gap.pkl", Some("sam2"), None, Tool::Wham, 17),
        ("phalp", "phalp/demo_clip.pkl", None, None, Tool::Phalp, 18),
        ("phalp_person2", "phalp/demo_clip.pkl", None, Some("2"), Tool::Phalp, 5),
        ("gvhmr", "gvhmr/hmr4d_results.pt", Some("matanyone"), None, Tool::Gvhmr, 20),
        ("prompthmr", "prompthmr/results.pkl", None, None, Tool::PromptHmr, 12),
        ("prompthmr_person2", "prompthmr/results.pkl", None, Some("2"), Tool::PromptHmr, 3),
        ("romp", "romp/video_results.npz", Some("sam2_per_object"), None, Tool::Romp, 20),
        ("romp_person2", "romp/video_results.npz", Some("sam2"), Some("2"), Tool::Romp, 5),
        ("easymocap", "easymocap", Some("sam2"), None, Tool::EasyMocap, 20),
        ("easymocap_person1", "easymocap", Some("sam2"), Some("1"), Tool::EasyMocap, 5),
    ] {
        let out = folder(name);
        let options = ImportOptions { person: person.map(str::to_owned), ..options(&dir, fit, masks) };
        let imported = import(&options, &out).unwrap();
        assert_eq!((imported.tool, imported.frames), (tool, frames), "{name}");
        let body = BodyModel::load(&out.join("body.safetensors")).unwrap();
        // Others may be outside the picture.
        let capture = person.is_none().then(|| load_capture(&out, &body, &LoadOptions::default()).unwrap());
        assert!(capture.as_ref().is_none_or(|capture| capture.train.len() == imported.frames), "{name}");

        let mut expected = Npz::open(&dir.join(format!("expected/expected_{name}.npz"))).unwrap();
        let mut expected = |key: &str| expected.array(key).unwrap().to_f64();
        let (k, indices, poses) = (expected("K"), expected("frame_index"), expected("poses"));
        let (roots, pelvises) = (expected("root_cam"), expected("pelvis_cam"));
        // Of few frames some are left out of the mean as outliers.
        let (betas, spread) = (expected("betas_mean"), imported.betas_spread + 1e-6);
        let records = metadata(&out);
        assert_eq!(records.as_object().unwrap().len(), indices.len(), "{name}");
        for (i, index) in indices.iter().enumerate() {
            let frame = format!("{:06}", *index as usize + 1);
            assert!(capture.as_ref().is_none_or(|capture| capture.train[i].name == frame), "{name}");
            let record = &records[&frame];
            near(name, &numbers(&record["betas"]), &betas, spread);
            near(name, &numbers(&record["cam_intrinsics"]), &k, 1e-5);
            let (pose, e) = (numbers(&record["poses"]), numbers(&record["cam_extrinsics"]));
            near(name, &pose[3..], &poses[pose.len() * i + 3..pose.len() * (i + 1)], 1e-5);
            let turn = DMat3::from_cols_array(&[e[0], e[4], e[8], e[1], e[5], e[9], e[2], e[6], e[10]]);
            let root = (turn * rotation(&pose)).transpose().to_cols_array();
            near(&format!("{name} root"), &root, &roots[9 * i..][..9], 1e-5);
            // With one shape for all frames the pelvis stays where the frame's own shape has it.
            let betas: Vec<f32> = numbers(&record["betas"]).iter().map(|&b| b as f32).collect();
            let joint = body.shaped(&betas).joints[0].as_dvec3();
            let pelvis = turn * joint + DVec3::new(e[3], e[7], e[11]);
            near(&format!("{name} pelvis"), &pelvis.to_array(), &pelvises[3 * i..][..3], 1e-5);
        }
    }
}

#[test]
fn options_of_an_import_do_what_they_say() {
    let Some(dir) = shared("estimators") else { return };
    let run = |name: &str, change: fn(&mut ImportOptions)| -> (Imported, PathBuf) {
        let mut options = options(&dir, "wham/wham_output.pkl", Some("sam2"));
        change(&mut options);
        let out = folder(name);
        (import(&options, &out).unwrap(), out)
    };
    let (plain, out) = run("plain", |_| {});
    assert_eq!((plain.person.as_str(), &plain.others), ("0", &vec![("1".to_owned(), 6)]));
    assert!((plain.focal - 362.038_671_967_5).abs() < 1e-6 && plain.betas_spread > 0.0 && plain.betas_spread < 0.5);
    assert!(!out.join("occluders").exists());
    let picture = out.join("images/000001.png");
    assert_eq!(std::fs::read(&picture).unwrap(), std::fs::read(dir.join("frames/000001.png")).unwrap());
    let linked = std::fs::symlink_metadata(&picture).unwrap().is_symlink();
    assert_eq!(linked, cfg!(unix));

    let (other, out) = run("person", |options| options.person = Some("1".to_owned()));
    assert_eq!((other.frames, other.unfitted), (6, [9, 5, 0]));
    assert!(out.join("masks/000010.png").is_file() && !out.join("masks/000009.png").exists());

    let (_, out) = run("copy", |options| (options.copy, options.occluder_objects) = (true, vec![2]));
    assert!(!std::fs::symlink_metadata(out.join("images/000001.png")).unwrap().is_symlink());
    let body = BodyModel::load(&out.join("body.safetensors")).unwrap();
    let capture = load_capture(&out, &body, &LoadOptions::default()).unwrap();
    let pixels = capture.train[0].pixels().unwrap();
    assert!(pixels.occluder.as_ref().unwrap().iter().filter(|o| **o).count() > 1000);

    let (focal, _) = run("focal", |options| options.focal = Some(415.0));
    assert_eq!(focal.focal, 415.0);

    // Eight masks of twenty frames.
    let (few, _) =
        run("few", |options| options.masks = options.masks.as_ref().map(|m| m.with_file_name("grounded_sam2")));
    assert_eq!((few.frames, few.unmasked), (8, 12));
}

#[test]
fn the_true_focal_length_brings_the_capture_back() {
    let Some(dir) = shared("estimators") else { return };
    let out = folder("true-focal");
    let mut options = options(&dir, "wham/wham_output.pkl", Some("sam2"));
    options.focal = Some(415.0);
    import(&options, &out).unwrap();
    let own = metadata(&dir.join("../captures/ocmotion_like/mild"));
    let (ours, body) = (metadata(&out), BodyModel::load(&out.join("body.safetensors")).unwrap());
    let pelvis = |record: &Value| {
        let e = numbers(&record["cam_extrinsics"]);
        let betas: Vec<f32> = numbers(&record["betas"]).iter().map(|&b| b as f32).collect();
        let j = body.shaped(&betas).joints[0].as_dvec3();
        [0, 1, 2].map(|row| e[4 * row] * j.x + e[4 * row + 1] * j.y + e[4 * row + 2] * j.z + e[4 * row + 3])
    };
    // Frames 55 to 74 of the capture; its principal point is 0.7 pixels from the centre.
    let names: Vec<&String> = own.as_object().unwrap().keys().collect();
    for i in [0, 10, 19] {
        let (a, b) = (pelvis(&ours[format!("{:06}", i + 1)]), pelvis(&own[names[55 + i]]));
        near("pelvis", &a, &b, 0.02);
    }
}
