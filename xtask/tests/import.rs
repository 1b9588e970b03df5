//! From an estimator's files to a drawn person, and what is refused on the way.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod common;

use std::path::{Path, PathBuf};

use common::{done, folder, refused, text};

fn estimators() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/estimators");
    if path.is_dir() {
        return Some(path);
    }
    println!("skipped: {} is absent", path.display());
    None
}

#[test]
fn a_newcomer_gets_a_person_with_three_commands() {
    let Some(dir) = estimators() else { return };
    let folder = folder("import-newcomer");
    let (capture, run) = (folder.join("capture"), folder.join("run"));
    let (frames, fit) = (dir.join("frames"), dir.join("phalp"));
    let fit = fit.join("demo_clip.pkl");
    let said = done(&["import", "--frames", text(&frames), "--fit", text(&fit), "--out", text(&capture)]);
    for words in ["4D-Humans", "18 of 20 frames", "2 (5 frames)", "left over", "no usual mistake", "train on it"] {
        assert!(said.contains(words), "{words}: {said}");
    }
    assert!(image::open(capture.join("check.png")).unwrap().width() > 500);
    let quick = ["--preset", "fast", "--method", "hash-point", "--steps", "1"];
    done(&[&["train", text(&capture), "--out", text(&run)], &quick[..]].concat());
    done(&["render", text(&run), "tpose"]);
    // A second import needs leave to replace the first.
    let again = ["import", "--frames", text(&frames), "--fit", text(&fit), "--out", text(&capture)];
    refused(&again, &["--force"]);
    done(&[&again[..], &["--force"]].concat());
}

#[test]
fn what_cannot_be_imported_is_said_in_one_line_and_leaves_nothing() {
    let Some(dir) = estimators() else { return };
    let folder = folder("import-refused");
    let out = folder.join("capture");
    let (frames, wham, masks) = (dir.join("frames"), dir.join("wham/wham_output.pkl"), dir.join("sam2"));
    let import = |more: &[&str], words: &[&str]| {
        let line = ["import", "--frames", text(&frames), "--out", text(&out)];
        refused(&[&line[..], more].concat(), words);
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
    };
    import(&["--fit", text(&wham)], &["wham_output.pkl", "--masks"]);
    import(&["--fit", text(&wham), "--masks", "nowhere"], &["nowhere", "--masks"]);
    import(&["--fit", text(&wham), "--masks", text(&masks), "--object", "7"], &["sam2", "object 7", "objects 1, 2"]);
    import(&["--fit", text(&wham), "--masks", text(&masks), "--person", "7"], &["person 7", "0 (20 frames)"]);
    import(&["--fit", text(&wham), "--masks", text(&masks), "--focal", "0"], &["focal"]);
    import(&["--fit", text(&masks), "--masks", text(&masks)], &["sam2", "EasyMocap"]);
    let body = dir.join("../body/open_body_x.npz");
    import(&["--fit", text(&wham), "--masks", text(&masks), "--body", text(&body)], &["SMPL_NEUTRAL.pkl", "55 joints"]);
}

#[test]
fn help_says_where_the_tools_leave_their_files() {
    let help = done(&["import", "--help"]);
    for word in
        ["wham_output.pkl", "hmr4d_results.pt", "video_results.npz", "mask_data", "pha/0000.png", "smpl.is.tue.mpg.de"]
    {
        assert!(help.contains(word), "{word}");
    }
}

/// Rewrites every frame of a capture's metadata.json.
fn rewritten(capture: &Path, change: impl Fn(&mut serde_json::Value)) {
    let path = capture.join("metadata.json");
    let mut records: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    records.as_object_mut().unwrap().values_mut().for_each(change);
    std::fs::write(&path, records.to_string()).unwrap();
}

fn each(list: &mut serde_json::Value, change: impl Fn(f64) -> f64) {
    for number in list.as_array_mut().unwrap() {
        *number = change(number.as_f64().unwrap()).into();
    }
}

#[test]
fn check_names_the_mistake_in_a_capture_on_disk() {
    let Some(dir) = estimators() else { return };
    let folder = folder("check-mistakes");
    let capture = folder.join("capture");
    let (frames, fit, masks) = (dir.join("frames"), dir.join("wham/wham_output.pkl"), dir.join("sam2"));
    let line =
        ["import", "--frames", text(&frames), "--fit", text(&fit), "--masks", text(&masks), "--out", text(&capture)];
    done(&line);
    let whole = std::fs::read_to_string(capture.join("metadata.json")).unwrap();
    type Change = fn(&mut serde_json::Value);
    // The extrinsics of an import are a translation alone.
    let mistakes: [(&str, Change); 5] = [
        ("camera to world", |record| {
            (0..3).for_each(|row| each(&mut record["cam_extrinsics"][row], |x| if x == 1.0 { x } else { -x }));
        }),
        ("points up (OpenGL)", |record| (1..3).for_each(|row| each(&mut record["cam_extrinsics"][row], |x| -x))),
        ("millimetres", |record| {
            (0..3).for_each(|row| each(&mut record["cam_extrinsics"][row], |x| if x == 1.0 { x } else { 1000.0 * x }));
        }),
        ("in degrees", |record| each(&mut record["poses"], f64::to_degrees)),
        ("times too long", |record| {
            (0..2).for_each(|row| each(&mut record["cam_intrinsics"][row], |x| if x > 200.0 { 2.0 * x } else { x }));
        }),
    ];
    for (words, change) in mistakes {
        std::fs::write(capture.join("metadata.json"), &whole).unwrap();
        rewritten(&capture, change);
        let said = done(&["check", text(&capture)]);
        assert!(said.contains("likely mistake") && said.contains(words), "{words}: {said}");
    }
}
