//! `train --capacity auto` on a tiny capture.

use crate::common;

use std::path::{Path, PathBuf};

use common::{done, folder, refused, text};
use occnerf::capture::Layout;
use serde_json::Value;

fn capture(folder: &Path) -> PathBuf {
    let out = folder.join("capture");
    common::capture(&out, Layout::HumanNerf, 32, 4);
    out
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn config(run: &Path) -> toml::Table {
    std::fs::read_to_string(run.join("config.toml")).unwrap().parse().unwrap()
}

#[test]
fn sizes_are_chosen_once_recorded_kept_on_resuming_and_pruned_at_the_end() {
    let folder = folder("capacity");
    let (capture, run) = (capture(&folder), folder.join("run"));
    let small =
        ["--preset", "fast", "--method", "occnerf", "--steps", "2", "--set", "patches=1", "--set", "patch_size=8"];
    let auto = ["train", text(&capture), "--out", text(&run), "--capacity", "auto", "--set", "encoding.levels=5"];
    let said = done(&[&auto[..], &small, &["--stop-after", "1"]].concat());
    assert!(said.contains("capacity from the scene") && said.contains("encoding.log2_table_size"), "{said}");
    let begun = json(&run.join("capacity.json"));
    let choice = |key: &str| begun["choices"].as_array().unwrap().iter().find(|c| c["key"] == key);
    assert!(choice("encoding.levels").is_none(), "{begun}: --set has the last word");
    let size = choice("encoding.log2_table_size").unwrap();
    assert!(size["chosen"].as_f64() < size["preset"].as_f64() && size["why"].as_str().unwrap().len() > 20);
    let train = &config(&run)["train"];
    assert_eq!(train["encoding"]["levels"].as_integer(), Some(5));
    assert_eq!(train["encoding"]["log2_table_size"].as_integer(), size["chosen"].as_f64().map(|v| v as i64));
    assert!(begun["pruned"].is_null());

    refused(&["train", "--resume", "--out", text(&run), "--capacity", "preset"], &["--capacity"]);
    let before = config(&run);
    let said = done(&[&auto[..], &small, &["--resume"]].concat());
    assert!(!said.contains("capacity from the scene") && said.contains("pruned: "), "{said}");
    assert_eq!(config(&run), before);
    let ended = json(&run.join("capacity.json"));
    assert_eq!(ended["choices"], begun["choices"]);
    let metrics = json(&run.join("metrics.json"));
    assert!(metrics["parameters"].as_u64().unwrap() > 0);
    assert_eq!(ended["pruned"]["parameters"], metrics["parameters"]);
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(page.contains("sizes from the scene") && page.contains("Pruned after training"), "{page}");
    // The pruned checkpoint is read like any other.
    done(&["eval", text(&run), "--split", "novel-view"]);
    assert_eq!(json(&run.join("metrics.json"))["parameters"], metrics["parameters"]);

    std::fs::write(run.join("capacity.json"), "{\"measured\": 3}").unwrap();
    refused(&["eval", text(&run)], &["capacity.json"]);
    refused(&["train", text(&capture), "--capacity", "auto", "--method", "prior"], &["prior", "--capacity"]);
}
