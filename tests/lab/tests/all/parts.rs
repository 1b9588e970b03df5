//! Many jobs on one folder: parts, overlapping parts, dead parts, and what they come to together.

use crate::common;

use std::path::Path;

use common::{done, folder, refused, text, tiny};

/// Rows without what depends on the clock.
fn timeless(table: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(table).unwrap();
    let row = |line: &str| {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        [&cells[..4], &cells[5..]].concat().join("|")
    };
    text.lines().filter(|line| line.starts_with('|')).map(row).collect()
}

#[test]
fn parts_of_a_reproduction_make_the_table_that_one_job_makes() {
    let folder = folder("parts");
    let capture = folder.join("capture");
    tiny(&capture, "humannerf");
    let rows = "prior,hash-point,occnerf,occnerf-baked";
    let command = |out: &Path, more: &[&str]| -> Vec<String> {
        let all = ["reproduce", text(&capture), "--out", text(out), "--steps", "2", "--seeds", "2", "--rows", rows];
        all.iter().chain(more).map(|word| (*word).to_owned()).collect()
    };
    let run = |words: &[String]| done(&words.iter().map(String::as_str).collect::<Vec<_>>());
    let (one, many) = (folder.join("one"), folder.join("many"));
    run(&command(&one, &[]));
    let first = run(&command(&many, &["--shard", "1/3"]));
    assert!(!many.join("capture/reproduce.md").exists() && first.contains("of other parts"), "{first}");
    let seeds = |row: &str| (1..3).map(|seed| many.join(format!("capture/{row}-s{seed}")).exists()).collect::<Vec<_>>();
    assert_eq!(seeds("occnerf-baked"), seeds("occnerf"), "who trains a person bakes them");
    let merge = command(&many, &["--merge"]);
    refused(&merge.iter().map(String::as_str).collect::<Vec<_>>(), &["have no scores yet"]);
    // The same part twice at once, and another.
    std::thread::scope(|scope| {
        for part in ["2/3", "2/3", "3/3"] {
            let words = command(&many, &["--shard", part]);
            scope.spawn(move || {
                let output = common::lab(&words.iter().map(String::as_str).collect::<Vec<_>>());
                let said = String::from_utf8_lossy(&output.stderr).into_owned();
                assert!(output.status.success() || said.contains("in use by another process"), "{said}");
            });
        }
    });
    run(&merge);
    let table = |out: &Path| timeless(&out.join("capture/reproduce.md"));
    assert_eq!(table(&many), table(&one));
    assert_eq!(table(&one).len(), 2 * (2 + 4));

    let moved = folder.join("moved");
    std::fs::rename(&many, &moved).unwrap();
    let merge = command(&moved, &["--merge"]);
    run(&merge);
    assert_eq!(table(&moved), table(&one), "a sweep's folder may be moved");
    let scores = |seed: u32| moved.join(format!("capture/occnerf-s{seed}/metrics.json"));
    std::fs::copy(scores(1), scores(2)).unwrap();
    refused(&merge.iter().map(String::as_str).collect::<Vec<_>>(), &["such as occnerf-s2", "have no scores yet"]);
}
