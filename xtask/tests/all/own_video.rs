//! A video of one's own: no views are kept back, and what is scored says so.

use crate::common;

use common::{done, folder, refused, text};
use occnerf::capture::Layout;
use synth::{Occlusion, Perturbation, SynthConfig, synthesise};

const TITLE: &str = "training views, over visible pixels:";

/// Bodies of 3 + 1 frames take 0.95 MiB, decoding a picture 1.7, keeping it 0.56: two of the four
/// are kept.
#[test]
fn pictures_that_are_not_kept_in_memory_are_read_before_training_too() {
    let folder = folder("own-video-memory");
    let (capture, run) = (folder.join("capture"), folder.join("run"));
    common::capture(&capture, Layout::Wild, 192, 3);
    let quick = ["--preset", "fast", "--method", "hash-point", "--steps", "1", "--memory", "4"];
    done(&[&["train", text(&capture), "--out", text(&run)], &quick[..]].concat());
    let clean = capture.join("clean/images/000000.png");
    let whole = std::fs::read(&clean).unwrap();
    std::fs::write(&clean, &whole[..whole.len() / 2]).unwrap();
    let other = folder.join("other");
    refused(&[&["train", text(&capture), "--out", text(&other)], &quick[..]].concat(), &["clean/images/000000.png"]);
    assert!(!other.join("checkpoint.safetensors").exists());
}

#[test]
fn scores_are_called_what_they_are() {
    let folder = folder("own-video");
    let (capture, run) = (folder.join("capture"), folder.join("run"));
    common::capture(&capture, Layout::Wild, 32, 3);
    std::fs::remove_dir_all(capture.join("clean")).unwrap();
    let quick = ["--preset", "fast", "--method", "hash-point", "--steps", "1"];
    let said = done(&[&["train", text(&capture), "--out", text(&run)], &quick[..]].concat());
    assert!(said.contains(TITLE) && !said.contains("novel"), "{said}");
    let prior = said.lines().find(|line| line.starts_with("| prior")).unwrap();
    assert!(prior.split('|').nth(5).is_some_and(|cell| cell.trim().parse::<f64>().is_ok()), "{prior}");
    let said = done(&["eval", text(&run)]);
    assert!(said.contains(TITLE) && !said.contains("novel"), "{said}");
    let metrics = std::fs::read_to_string(run.join("metrics.json")).unwrap();
    assert!(!metrics.contains("novel_view") && metrics.contains("train_view"), "{metrics}");
    refused(&["eval", text(&run), "--split", "novel-view"], &["keeps no views back", "train-view"]);
}

#[test]
fn scores_of_a_run_that_went_on_are_those_of_its_last_step() {
    let folder = folder("scored-twice");
    let (capture, run) = (folder.join("capture"), folder.join("run"));
    common::capture(&capture, Layout::HumanNerf, 32, 3);
    let quick = ["--preset", "fast", "--method", "hash-point", "--steps", "3"];
    let train = [&["train", text(&capture), "--out", text(&run)], &quick[..]].concat();
    let steps_are = |steps: &str| {
        let metrics = std::fs::read_to_string(run.join("metrics.json")).unwrap();
        metrics.contains(&format!("\"steps\": {steps},")) && !metrics.contains("\"train_seconds\": 0.0,")
    };
    for (stop, more) in [("1", &[][..]), ("2", &["--resume"][..])] {
        done(&[&train[..], more, &["--stop-after", stop]].concat());
        done(&["eval", text(&run)]);
        assert!(steps_are(stop));
    }
    // Of a run that is asked for fewer steps than it has taken, too.
    done(&["train", "--resume", "--out", text(&run), "--steps", "1"]);
    assert!(steps_are("2"));
}

#[test]
fn a_run_on_masks_that_are_too_small_goes_on_with_those_that_it_began_with() {
    let folder = folder("mended-masks");
    let (capture, whole, stopped) = (folder.join("capture"), folder.join("whole"), folder.join("stopped"));
    let occlusion = Occlusion::Objects { fraction: 0.5, position: 0.0 };
    let config = SynthConfig { size: 160, frames: 6, occlusion, ..SynthConfig::default() };
    let mut made = synthesise(None, None, &config, &|_| {}).unwrap();
    let wrong = Perturbation { mask_pixels: -3, pose_degrees: 6.0, ..Perturbation::NONE };
    wrong.apply(&mut made.capture, &made.body).unwrap();
    made.write(&capture, Layout::Wild, &|_| {}).unwrap();
    let quick = ["--preset", "fast", "--method", "hash-point", "--steps", "4"];
    let train = |run| [&["train", text(&capture), "--out", run], &quick[..]].concat();
    done(&train(text(&whole)));
    done(&[&train(text(&stopped))[..], &["--stop-after", "2"]].concat());
    done(&["train", "--resume", "--out", text(&stopped)]);
    let [one, two] = [whole, stopped].map(|run| std::fs::read(run.join("checkpoint.safetensors")).unwrap());
    assert!(one == two);
}

#[test]
#[cfg(target_os = "linux")]
fn training_says_before_it_begins_what_memory_it_takes() {
    let folder = folder("memory-said");
    let (capture, run) = (folder.join("capture"), folder.join("run"));
    common::capture(&capture, Layout::HumanNerf, 128, 4);
    let said = done(&["train", text(&capture), "--out", text(&run), "--method", "hash-point", "--steps", "40"]);
    let mebibytes: f64 = said.split("memory: about ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    let metrics = std::fs::read_to_string(run.join("metrics.json")).unwrap();
    let metrics: serde_json::Value = serde_json::from_str(&metrics).unwrap();
    let taken = metrics["peak_rss_bytes"].as_f64().unwrap() / f64::from(1 << 20);
    assert!((taken / mebibytes - 1.0).abs() < 0.3, "{mebibytes} MiB said, {taken} taken");
}
