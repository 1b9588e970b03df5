//! `train --list`: parts of a list of scenes, and what they come to together.

use crate::common;

use common::{bytes, done, folder, refused, text, xtask};
use occnerf::capture::Layout;

#[test]
fn a_list_of_scenes_is_trained_in_parts() {
    let folder = folder("list");
    for name in ["a", "b", "c"] {
        common::capture(&folder.join(name), Layout::HumanNerf, 32, 3);
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
    // What is finished is not replaced with other settings, or another capture.
    let checkpoint = bytes(&out.join("a/checkpoint.safetensors"));
    let fails = |more: &[&'static str], words: &str| {
        let output = xtask(&with(more));
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.code() == Some(1) && said.contains(words), "{said}");
        assert!(bytes(&out.join("a/checkpoint.safetensors")) == checkpoint);
    };
    let longer = command.map(|word| if word == "2" { "3" } else { word });
    assert!(String::from_utf8_lossy(&xtask(&longer).stdout).contains("holds a run with other settings"));
    for more in [&["--seed", "2"][..], &["--set", "samples=8"]] {
        fails(more, "holds a run with other settings");
        refused(&with(&[more, &["--merge"]].concat()), &["have no scores yet"]);
    }
    // A scene that is none does not keep the others.
    std::fs::write(&list, format!("/no/such/scene\n{}\n", of("a"))).unwrap();
    let output = xtask(&with(&[]));
    assert_eq!(output.status.code(), Some(1));
    let printed = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(printed.contains("a: finished earlier") && printed.contains("1 of 2 scenes failed"), "{printed}");
    let images = folder.join("a/images");
    std::fs::copy(images.join("frame_000001.png"), images.join("frame_000000.png")).unwrap();
    fails(&[], "the capture as it was then");
    // Names that differ in case alone are one where the file system says so.
    common::capture(&folder.join("other/B"), Layout::HumanNerf, 32, 3);
    std::fs::write(&list, format!("{}\n{}\n", of("b"), of("other/B"))).unwrap();
    done(&with(&[]));
    assert!(out.join("B-2/metrics.json").is_file());
    refused(&["train", "--shard", "1/2"], &["--list"]);
    refused(&["train", "--list", text(&list), "--out", text(&out), "--method", "auto"], &["--list", "auto"]);
    assert_eq!(xtask(&["train", "--list", text(&list), "--shard", "3/2"]).status.code(), Some(2));
}
