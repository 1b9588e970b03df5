//! `reproduce` on a tiny capture: the whole way from frames to tables, twice.

use crate::common;

use common::{done, folder, refused, text, tiny};

#[test]
fn tables_have_every_row_once_and_a_second_call_trains_nothing() {
    let folder = folder("reproduce");
    let (capture, out) = (folder.join("capture"), folder.join("out"));
    tiny(&capture, "humannerf");
    let arguments = ["reproduce", text(&capture), "--out", text(&out), "--steps", "2", "--seeds", "2"];
    let arguments =
        [&arguments[..], &["--rows", "prior,humannerf-style-bg,humannerf-style,hash-point,occnerf"]].concat();
    let first = done(&arguments);
    assert!(first.contains("9 runs in"), "{first}");
    let table = std::fs::read_to_string(out.join("capture/reproduce.md")).unwrap();
    for row in ["prior", "humannerf-style-bg", "humannerf-style", "hash-point", "occnerf"] {
        assert_eq!(table.matches(&format!("| {row} ")).count(), 2, "{row}, novel and training views: {table}");
    }
    assert!(table.contains(" ± "), "{table}");
    let json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(out.join("capture/reproduce.json")).unwrap()).unwrap();
    assert_eq!(json["rows"].as_array().unwrap().len(), 5);
    assert!(out.join("capture/reproduce.png").is_file());
    assert_eq!(std::fs::read_to_string(out.join("bench.jsonl")).unwrap().lines().count(), 9);
    assert!(done(&arguments).contains("0 runs in"));
    // Without the log, the run directories tell what is finished.
    std::fs::remove_file(out.join("bench.jsonl")).unwrap();
    done(&arguments);
    assert_eq!(std::fs::read_to_string(out.join("capture/reproduce.md")).unwrap(), table);
}

#[test]
fn rows_of_any_length_without_views_kept_back_are_scored_and_another_capture_of_the_name_is_refused() {
    let folder = folder("reproduce-lengths");
    let (capture, other) = (folder.join("one/person"), folder.join("two/person"));
    for capture in [&capture, &other] {
        let size = ["--size", "32", "--frames", "3", "--format", "ocmotion"];
        done(&[&["synth", "--out", text(capture)], &size[..]].concat());
        std::fs::remove_dir_all(capture.join("clean")).unwrap();
    }
    let out = folder.join("out");
    let rest = ["--out", text(&out), "--seeds", "1", "--steps", "2", "--rows"];
    let rows = "prior,humannerf-style,humannerf-style-4x,occnerf";
    let arguments = |capture| [&["reproduce", capture], &rest[..], &[rows]].concat();
    done(&arguments(text(&capture)));
    let table = std::fs::read_to_string(out.join("person/reproduce.md")).unwrap();
    let steps = |row: &str| {
        let line = table.lines().find(|line| line.starts_with(&format!("| {row} "))).unwrap();
        line.split('|').nth(3).unwrap().trim().parse::<u64>().unwrap()
    };
    assert_eq!([steps("humannerf-style-4x"), steps("humannerf-style"), steps("occnerf")], [8, 2, 2]);
    assert!(!table.contains("Novel views") && out.join("person/reproduce.png").is_file(), "{table}");
    let refusal = common::lab(&arguments(text(&other)));
    let said = String::from_utf8_lossy(&refusal.stderr);
    assert!(!refusal.status.success() && said.contains("one/person") && said.contains("two/person"), "{said}");
}

#[test]
fn a_run_on_a_corrupted_capture_is_read_as_such_or_not_at_all() {
    let folder = folder("corrupted");
    let (capture, out) = (folder.join("capture"), folder.join("out"));
    tiny(&capture, "humannerf");
    done(&["reproduce", text(&capture), "--out", text(&out), "--rows", "prior", "--wrong-pose", "2"]);
    let run = out.join("capture/prior");
    let config = xtask::run::RunConfig::read(&run).unwrap();
    let refusal = config.source(&run).err().unwrap().to_string();
    assert!(refusal.contains("lab:") && refusal.contains("no such directory"), "{refusal}");
    assert!(done(&["budget", text(&run)]).contains("error by cause"));
    let other = ["reproduce", text(&capture), "--out", text(&out), "--rows", "prior"];
    let said = String::from_utf8(common::lab(&other).stderr).unwrap();
    assert!(said.contains("give another --out"), "{said}");
}

#[test]
fn unknown_rows_tables_and_captures_are_refused() {
    refused(&["reproduce", "--rows", "occnerv"], &["occnerv", "hash-point"]);
    refused(&["reproduce", "/nowhere"], &["/nowhere"]);
}
