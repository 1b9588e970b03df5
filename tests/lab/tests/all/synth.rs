//! `synth` as a user meets it: what it writes is trained on, and nothing of the user's is lost.

use crate::common;

use std::path::Path;

use common::{done, folder, refused, text};
use occnerf::capture::{Capture, Frame, LoadOptions, load_capture};
use occnerf::{Config, Method, Preset, Trainer};

/// Runs `synth` with few small frames, which must succeed; returns what it says.
fn small(out: &Path, more: &[&str]) -> String {
    let usual = ["--size", "32", "--eval-cameras", "1", "--eval-every", "2"];
    let frames: &[&str] = if more.contains(&"--frames") { &[] } else { &["--frames", "4"] };
    done(&[&["synth", "--out", text(out)], &usual[..], frames, more].concat())
}

fn files(directory: &Path) -> usize {
    std::fs::read_dir(directory).unwrap().count()
}

#[test]
fn every_format_is_written_and_trained_on() {
    let place = folder("synth-formats");
    for format in ["humannerf", "zju-mocap", "ocmotion"] {
        let out = place.join(format);
        let said = small(&out, &["--format", format]);
        assert!(said.contains("4 frames, 2 views") && said.contains("24 joints"), "{said}");
        let source = xtask::source::load(Some(text(&out)), None, &LoadOptions::default()).unwrap();
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        (config.patches, config.patch_size, config.registration.rounds) = (1, 8, 0);
        let scene = source.scene(&config).unwrap();
        assert_eq!((scene.train.len(), scene.eval.len()), (4, 2), "{format}");
        assert!(Trainer::new(&scene, config).unwrap().step().unwrap().loss.is_finite());
    }
    assert_eq!(files(&place), 3, "nothing else is left beside them");
}

/// C libraries differ in the last bits of sines: so do numbers, and few pixels.
const ROUNDING: f32 = 1e-5;

#[test]
fn the_demo_of_the_product_is_what_the_command_writes() {
    let out = folder("synth-demo").join("demo");
    done(&["synth", "--no-body", "--out", text(&out)]);
    assert!(!out.join("body.safetensors").exists());
    let body = smpl::BodyModel::embedded();
    let read = |directory: &Path| load_capture(directory, &body, &LoadOptions::default()).unwrap();
    let (made, kept) = (read(&out), read(Path::new(xtask::source::DEMO_FOLDER)));
    let views = |capture: &Capture| -> Vec<(String, usize, Frame)> {
        let train = capture.train.iter().enumerate().map(|(i, frame)| (String::new(), i, frame.clone()));
        train.chain(capture.eval.iter().map(|v| (v.camera_name.clone(), v.train_index, v.frame.clone()))).collect()
    };
    let (made, kept) = (views(&made), views(&kept));
    assert_eq!((made.len(), kept.len()), (150, 150));
    for ((camera, index, a), (other, other_index, b)) in made.iter().zip(&kept) {
        assert_eq!((camera, index, &a.name), (other, other_index, &b.name));
        assert!(a.pose.iter().zip(&b.pose).all(|(a, b)| a.distance(*b) < ROUNDING), "{camera} {}", a.name);
        assert!(a.betas.iter().zip(&b.betas).all(|(a, b)| (a - b).abs() < ROUNDING));
        let matrix = |frame: &Frame| frame.camera.world_to_camera;
        assert!(matrix(a).abs_diff_eq(matrix(b), ROUNDING) && a.camera.focal == b.camera.focal);
        let (a, b) = (a.pixels().unwrap(), b.pixels().unwrap());
        let differ = a.image.pixels.iter().zip(&b.image.pixels).filter(|(a, b)| a != b).count();
        assert!(differ < 100 && a.image.width == b.image.width, "{camera} {index}: {differ}");
    }
}

#[test]
fn a_character_is_written_and_keeps_its_joints() {
    let Some(character) = testkit::files::shared("character/CesiumMan.glb") else { return };
    let out = folder("synth-character").join("capture");
    let said = small(&out, &[text(&character), "--occlusion", "objects", "--fraction", "0.4", "--format", "ocmotion"]);
    assert!(said.contains("19 joints"), "{said}");
    let metadata = std::fs::read_to_string(out.join("metadata.json")).unwrap();
    let frames: serde_json::Value = serde_json::from_str(&metadata).unwrap();
    assert_eq!(frames["000003"]["poses"].as_array().unwrap().len(), 3 * 19);
    assert_eq!(files(&out.join("occluders")), 4);
}

#[test]
fn nothing_is_overwritten_unasked() {
    let place = folder("synth-force");
    let out = place.join("capture");
    small(&out, &[]);
    let frame = out.join("images/frame_000003.png");
    assert!(frame.is_file());
    refused(&["synth", "--out", text(&out)], &["already holds a capture", "--force"]);
    small(&out, &["--force", "--frames", "2"]);
    assert!(!frame.exists() && out.join("images/frame_000001.png").is_file(), "the old capture is gone as a whole");

    let precious = place.join("precious");
    std::fs::create_dir_all(&precious).unwrap();
    std::fs::write(precious.join("thesis.txt"), "years of work").unwrap();
    refused(&["synth", "--out", text(&precious), "--force"], &["precious", "not empty", "synth.json"]);
    refused(&["synth", "--out", text(&precious.join("thesis.txt"))], &["thesis.txt", "not a directory"]);
    assert_eq!(std::fs::read_to_string(precious.join("thesis.txt")).unwrap(), "years of work");
    // An empty directory may be there already.
    let empty = folder("synth-force-empty");
    small(&empty, &[]);
    assert_eq!(files(&place), 2, "nothing half-written is left");
}

#[test]
fn what_cannot_be_made_is_refused_and_leaves_nothing_behind() {
    let place = folder("synth-refused");
    let out = place.join("capture");
    let with = |more: &[&str], words: &[&str]| refused(&[&["synth", "--out", text(&out)], more].concat(), words);
    with(&["--fraction", "1.5"], &["fraction", "0.95"]);
    with(&["--position", "-3"], &["position", "-1 to 1"]);
    with(&["--size", "3"], &["size", "16 to 2048"]);
    with(&["--frames", "10000", "--size", "2048"], &["frames", "GiB"]);
    with(&["--pose-noise", "nan"], &["pose_noise"]);
    with(&["--occlusion", "none", "--share", "0.5"], &["--share"]);
    with(&["--occlusion", "objects", "--share", "0.5"], &["--share", "every frame"]);
    with(&["/no/such.glb"], &["/no/such.glb"]);
    with(&["picture.png"], &["picture.png", ".glb"]);
    with(&["--motion", "/no/such.npz"], &["/no/such.npz"]);
    let broken = place.join("broken.glb");
    std::fs::write(&broken, b"glTF, but not for long").unwrap();
    with(&[text(&broken)], &["broken.glb"]);
    assert_eq!(files(&place), 1);
}
