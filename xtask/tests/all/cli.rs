//! The command line as a user meets it: help, and one clear line for whatever is wrong.

use crate::common;

use common::{folder, refused, text, xtask};

#[test]
fn scenes_that_are_none_are_refused_and_leave_no_run_behind() {
    let out = folder("no-scene").join("run");
    refused(&["train", "/no/such/place", "--out", text(&out)], &["/no/such/place", "no such directory"]);
    let empty = folder("empty-scene");
    let layouts = ["annots.npy", "metadata.json", "mesh_infos.pkl"];
    refused(&["train", text(&empty), "--out", text(&out)], &[&[text(&empty)], &layouts[..]].concat());
    std::fs::write(empty.join("mesh_infos.pkl"), b"not a pickle").unwrap();
    refused(&["train", text(&empty), "--out", text(&out)], &[text(&empty), "body model", "--body"]);
    let body = empty.join("none.npz");
    refused(&["train", text(&empty), "--body", text(&body), "--out", text(&out)], &["none.npz"]);
    let character = empty.join("walker.GLB");
    std::fs::write(&character, b"glTF").unwrap();
    refused(&["train", text(&character), "--out", text(&out)], &["walker.GLB", "cargo lab synth", "cargo xtask train"]);
    assert!(!out.exists());
}

#[test]
fn settings_that_cannot_be_are_refused_by_key() {
    refused(&["train", "--set", "encoding.nmax=5"], &["encoding.nmax", "no key"]);
    refused(&["train", "--set", "samples=0"], &["samples", "1 to 1024"]);
    refused(&["train", "--set", "rates.table=nan"], &["rates.table"]);
    refused(&["train", "--set", "samples=many"], &["samples=many", "whole number"]);
}

#[test]
fn runs_that_are_none_are_refused() {
    let empty = folder("no-run");
    refused(&["train", "--resume", "--out", text(&empty)], &["checkpoint.safetensors", "no-run"]);
    refused(&["eval", text(&empty)], &["config.toml", "not a run"]);
    refused(&["render", text(&empty), "tpose"], &["config.toml", "not a run"]);
    std::fs::write(empty.join("checkpoint.safetensors"), [0xff; 64]).unwrap();
    refused(&["train", "--resume", "--out", text(&empty)], &["checkpoint.safetensors", "safetensors"]);
    refused(&["train", "--out", text(&empty)], &["already holds a run", "--resume"]);
}

#[test]
fn help_names_the_commands_and_every_option_of_train() {
    let help = |arguments: &[&str]| String::from_utf8(xtask(arguments).stdout).unwrap();
    let general = help(&["--help"]);
    for command in ["train", "eval", "render", "export"] {
        assert!(general.contains(command), "{general}");
    }
    assert!(general.contains("Exit codes:") && general.contains("a result cannot be written"), "{general}");
    let train = help(&["train", "--help"]);
    let options = "--out --preset --method --ablate --occluded --steps --seed --threads --resume --resize --stride \
                   --max-frames --eval-stride --camera --lpips --perceptual-weights";
    for option in options.split_whitespace() {
        assert!(train.contains(option), "{train}");
    }
}
