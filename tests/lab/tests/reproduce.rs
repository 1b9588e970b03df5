//! `reproduce` on a tiny capture: the whole way from frames to tables, twice.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod common;

use common::{TINY, done, folder, refused, text};

#[test]
fn tables_have_every_row_once_and_a_second_call_trains_nothing() {
    let folder = folder("reproduce");
    let (capture, out) = (folder.join("capture"), folder.join("out"));
    done(&[&["synth", "--out", text(&capture)], &TINY[..]].concat());
    let arguments = ["reproduce", text(&capture), "--out", text(&out), "--steps", "2", "--seeds", "2"];
    let arguments =
        [&arguments[..], &["--rows", "prior,humannerf-style-bg,humannerf-style,hash-point,occnerf"]].concat();
    let first = done(&arguments);
    assert_eq!(first.matches(": training\n").count(), 1 + 2 * 4, "{first}");
    let table = std::fs::read_to_string(out.join("capture/reproduce.md")).unwrap();
    for row in ["prior", "humannerf-style-bg", "humannerf-style", "hash-point", "occnerf"] {
        assert_eq!(table.matches(&format!("| {row} ")).count(), 2, "{row}, novel and training views: {table}");
    }
    assert!(table.contains(" ± "), "{table}");
    let json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(out.join("capture/reproduce.json")).unwrap()).unwrap();
    assert_eq!(json["rows"].as_array().unwrap().len(), 5);
    assert!(out.join("capture/reproduce.png").is_file());
    let second = done(&arguments);
    assert_eq!(second.matches(": finished earlier\n").count(), 9, "{second}");
    assert_eq!(std::fs::read_to_string(out.join("capture/reproduce.md")).unwrap(), table);
}

#[test]
fn rows_of_any_length_without_views_kept_back_fit_a_budget_and_another_capture_of_the_name_is_refused() {
    let folder = folder("reproduce-lengths");
    let (capture, other) = (folder.join("one/person"), folder.join("two/person"));
    for capture in [&capture, &other] {
        let size = ["--size", "32", "--frames", "3", "--format", "ocmotion"];
        done(&[&["synth", "--out", text(capture)], &size[..]].concat());
        std::fs::remove_dir_all(capture.join("clean")).unwrap();
    }
    let out = folder.join("out");
    let rest = ["--out", text(&out), "--seeds", "1", "--budget", "0.01", "--rows"];
    let rows = "prior,humannerf-style,humannerf-style-4x,humannerf-style-time,occnerf";
    let arguments = |capture| [&["reproduce", capture], &rest[..], &[rows]].concat();
    done(&arguments(text(&capture)));
    let table = std::fs::read_to_string(out.join("person/reproduce.md")).unwrap();
    let steps = |row: &str| {
        let line = table.lines().find(|line| line.starts_with(&format!("| {row} "))).unwrap();
        line.split('|').nth(3).unwrap().trim().parse::<u64>().unwrap()
    };
    assert_eq!(steps("humannerf-style-4x"), 4 * steps("humannerf-style"));
    assert!(steps("humannerf-style-time") > 0 && steps("occnerf") == steps("humannerf-style"));
    assert!(!table.contains("Novel views") && out.join("person/reproduce.png").is_file(), "{table}");
    let refusal = common::lab(&arguments(text(&other)));
    let said = String::from_utf8_lossy(&refusal.stderr);
    assert!(!refusal.status.success() && said.contains("one/person") && said.contains("two/person"), "{said}");
}

#[test]
fn robustness_is_a_line_for_each_error_of_the_prior() {
    let folder = folder("robustness");
    let (capture, out) = (folder.join("capture"), folder.join("out"));
    done(&["synth", "--out", text(&capture), "--size", "48", "--frames", "3", "--eval-cameras", "1"]);
    let arguments = ["reproduce", text(&capture), "--robustness", "--out", text(&out), "--steps", "1", "--seeds", "1"];
    done(&[&arguments[..], &["--rows", "prior,occnerf"]].concat());
    let table = std::fs::read_to_string(out.join("capture/robustness/robustness.md")).unwrap();
    assert_eq!(table.lines().filter(|line| line.starts_with('|')).count(), 2 + 9, "{table}");
}

#[test]
fn unknown_rows_and_impossible_budgets_are_refused() {
    refused(&["reproduce", "--rows", "occnerv"], &["occnerv", "hash-point"]);
    refused(&["reproduce", "--budget", "0"], &["--budget"]);
    refused(&["reproduce", "/nowhere"], &["/nowhere"]);
}
