//! Many jobs on one folder: parts, overlapping parts, dead parts, and what they come to together.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod common;

use std::path::Path;

use common::{TINY, done, folder, refused, text, xtask};

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
    done(&[&["synth", "--out", text(&capture)], &TINY[..]].concat());
    let rows = "prior,hash-point,occnerf,occnerf-baked";
    let command = |out: &Path, more: &[&str]| -> Vec<String> {
        let all = ["reproduce", text(&capture), "--out", text(out), "--steps", "2", "--seeds", "2", "--rows", rows];
        all.iter().chain(more).map(|word| (*word).to_owned()).collect()
    };
    let run = |words: &[String]| done(&words.iter().map(String::as_str).collect::<Vec<_>>());
    let (one, many) = (folder.join("one"), folder.join("many"));
    run(&command(&one, &[]));
    let first = run(&command(&many, &["--shard", "1/3"]));
    assert!(!many.join("capture/reproduce.md").exists() && first.contains(": training"), "{first}");
    let seeds = |row: &str| (1..3).map(|seed| many.join(format!("capture/{row}-s{seed}")).exists()).collect::<Vec<_>>();
    assert_eq!(seeds("occnerf-baked"), seeds("occnerf"), "who trains a person bakes them");
    let merge = command(&many, &["--merge"]);
    refused(&merge.iter().map(String::as_str).collect::<Vec<_>>(), &["have no scores yet"]);
    // The same part twice at once, and another.
    std::thread::scope(|scope| {
        for part in ["2/3", "2/3", "3/3"] {
            let words = command(&many, &["--shard", part]);
            scope.spawn(move || run(&words));
        }
    });
    run(&merge);
    let table = |out: &Path| timeless(&out.join("capture/reproduce.md"));
    assert_eq!(table(&many), table(&one));
    assert_eq!(table(&one).len(), 2 * (2 + 4));
    refused(&["reproduce", text(&capture), "--out", text(&folder.join("none")), "--merge"], &["no part has begun"]);
}

#[test]
fn a_list_of_scenes_is_trained_in_parts() {
    let folder = folder("list");
    for name in ["a", "b", "c"] {
        let capture = folder.join(name);
        done(&["synth", "--out", text(&capture), "--size", "32", "--frames", "3", "--eval-cameras", "1"]);
    }
    let list = folder.join("scenes.txt");
    let of = |name: &str| text(&folder.join(name)).to_owned();
    std::fs::write(&list, format!("# captures\n{}\n\n{} # the second\n{}\n", of("a"), of("b"), of("c"))).unwrap();
    let out = folder.join("out");
    let command = ["train", "--list", text(&list), "--out", text(&out), "--steps", "2", "--method", "hash-point"];
    let with = |more: &[&'static str]| [&command[..], more].concat();
    done(&with(&["--shard", "1/2"]));
    refused(&with(&["--merge"]), &["of 3 scenes have no scores yet"]);
    done(&with(&["--shard", "2/2"]));
    let said = done(&with(&["--merge"]));
    let table = std::fs::read_to_string(out.join("list.md")).unwrap();
    assert!(["| a ", "| b ", "| c "].iter().all(|row| table.contains(row) && said.contains(row)), "{table}");
    assert_eq!(done(&with(&[])).matches(": finished earlier").count(), 3);
    // A scene that is none does not keep the others.
    std::fs::write(&list, format!("/no/such/scene\n{}\n", of("a"))).unwrap();
    let output = xtask(&with(&[]));
    assert_eq!(output.status.code(), Some(1));
    let printed = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(printed.contains("a: finished earlier") && printed.contains("1 of 2 scenes failed"), "{printed}");
    refused(&["train", "--shard", "1/2"], &["--list"]);
    assert_eq!(xtask(&["train", "--list", text(&list), "--shard", "3/2"]).status.code(), Some(2));
}
