//! `--method surface`: a person without a field, from training to every format.

use crate::common;

use common::{done, folder, refused, text};
use occnerf::bake::Avatar;
use occnerf::capture::Layout;

#[test]
fn a_surface_is_trained_scored_drawn_exported_and_shown() {
    let folder = folder("surface");
    let (capture, run) = (folder.join("capture"), folder.join("run"));
    common::capture(&capture, Layout::HumanNerf, 64, 8);
    let said = done(&["train", text(&capture), "--out", text(&run), "--preset", "fast"]);
    assert!(said.contains("surface of ") && said.contains("| prior ") && said.contains("| surface "), "{said}");
    let avatar = run.join("avatar.safetensors");
    let person = Avatar::load(&avatar).unwrap();
    assert!(person.clips[0].motion.num_frames() == 8 && person.atlas.confidence.iter().any(|c| *c > 0));
    let scores = |said: &str| -> String {
        let line = said.lines().find(|line| line.starts_with("| surface ")).unwrap();
        line.split('|').skip(5).take(3).collect()
    };
    assert_eq!(scores(&done(&["eval", text(&run)])), scores(&said));
    let written = std::fs::read(&avatar).unwrap();
    for out in ["person.glb", "person.ply", "person.obj", "motion.npz"] {
        done(&["export", text(&run), "--out", text(&run.join(out))]);
        assert!(run.join(out).is_file(), "{out}");
    }
    let (most, small) = (person.faces.len() / 2, run.join("small.glb"));
    let fewer = ["--triangles", &most.to_string(), "--texture", "128", "--jpeg", "85"];
    done(&[&["export", text(&run), "--out", text(&small)], &fewer[..]].concat());
    let faces = rigged::Character::load(&small).unwrap().faces.len();
    assert!(faces <= most && faces * 10 > most * 9, "{faces} of {most}");
    done(&["view", text(&run)]);
    let page = std::fs::read(run.join("person.html")).unwrap();
    let shared = run.join("shared.html");
    done(&[&["view", text(&run), "--out", text(&shared)], &fewer[..]].concat());
    assert!(std::fs::read(&shared).unwrap().len() < page.len());
    done(&["render", text(&run), "freeview", "--size", "16x16"]);
    assert_eq!(std::fs::read(&avatar).unwrap(), written, "drawing bakes nothing");
    // Again, from the start: nothing is lost without a word.
    refused(&["train", text(&capture), "--out", text(&run), "--method", "surface"], &["already holds a run"]);
    done(&["train", text(&capture), "--out", text(&run), "--resume"]);
    assert_eq!(std::fs::read(&avatar).unwrap(), written);
    // It is as baked as it can be.
    done(&["render", text(&run), "freeview", "--baked", "--size", "16x16"]);
    assert_eq!(scores(&done(&["eval", text(&run), "--baked"])), scores(&said));
    refused(&["train", "--method", "surface", "--steps", "9"], &["--steps 9: the method surface takes no steps"]);
    refused(&["train", "--method", "surface", "--preview"], &["--preview: the method surface takes no steps"]);
    std::fs::write(&avatar, b"damaged").unwrap();
    refused(&["export", text(&run), "--out", text(&run.join("again.glb"))], &["avatar.safetensors"]);
    std::fs::remove_file(&avatar).unwrap();
    refused(&["export", text(&run), "--out", text(&run.join("again.glb"))], &["avatar.safetensors"]);
}

/// Every tenth frame of a capture without other cameras is scored; nothing is learnt from its
/// pixels.
#[test]
fn frames_are_held_out_where_there_is_no_other_camera() {
    let folder = folder("held-out");
    let capture = folder.join("capture");
    let config = synth::SynthConfig { size: 48, frames: 20, eval_cameras: 0, ..synth::SynthConfig::default() };
    let film = synth::synthesise(None, None, &config, &|_| {}).unwrap();
    film.write(&capture, Layout::HumanNerf, &|_| {}).unwrap();
    let out = |name: &str| folder.join(name);
    let said = done(&["train", text(&capture), "--out", text(&out("held")), "--method", "surface"]);
    assert!(said.contains("every 10th frame is scored") && said.contains("held-out frames, over known"), "{said}");
    let whole = ["--method", "surface", "--set", "held_out=0"];
    let said = done(&[&["train", text(&capture), "--out", text(&out("whole"))], &whole[..]].concat());
    assert!(said.contains("training views") && !said.contains("held-out frames"), "{said}");
}
