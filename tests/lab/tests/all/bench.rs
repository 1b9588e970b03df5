//! A tiny real sweep, and pages of runs and benches.

use crate::common;

use std::path::{Path, PathBuf};

use common::{done, folder, refused, text};
use image::{Rgb, RgbImage};
use occnerf::{Config, Method, Preset};

/// Nothing on the page comes from elsewhere, and nothing in it is markup that a file brought along.
fn self_contained(page: &str) {
    for attribute in ["src=", "href="] {
        for at in page.match_indices(attribute).map(|(at, _)| at + attribute.len()) {
            let value = page[at..].trim_start_matches('"');
            assert!(value.starts_with("data:") || value.starts_with('#'), "{}", &value[..40.min(value.len())]);
        }
    }
    for word in ["http:", "https:", "url(", "@import", "<link", "<iframe", "<b onclick"] {
        assert!(!page.contains(word), "{word}");
    }
    assert!(page.contains("name=\"viewport\"") && page.contains("prefers-color-scheme"));
}

#[test]
fn a_sweep_goes_on_where_it_was_cut_off() {
    let out = folder("sweep");
    let sweep = ["bench", "stability", "--quick", "--axes", "hidden", "--side", "24", "--steps", "1"];
    let sweep = [&sweep[..], &["--out", text(&out)]].concat();
    let first = done(&sweep);
    // Two levels of five methods.
    assert!(first.contains("10 runs in"), "{first}");
    assert!(first.contains("every loss, gradient and pixel was finite"), "{first}");
    for name in ["bench.jsonl", "stability.md", "stability-demo.svg", "stability-demo.png"] {
        assert!(out.join(name).is_file(), "{name}");
        assert!(first.contains(text(&out.join(name))), "{first}");
    }
    let log = std::fs::read_to_string(out.join("bench.jsonl")).unwrap();
    assert_eq!(log.lines().count(), 10);
    for line in log.lines() {
        let line: serde_json::Value = serde_json::from_str(line).unwrap();
        assert!(line["error"].is_null() && line["psnr_mask"].as_f64().unwrap() > 1.0, "{line}");
        assert!(line["peak_rss_bytes"].as_u64().is_some() && line["seconds_per_frame"].as_f64().unwrap() > 0.0);
        assert_eq!(line["job"]["place"]["made"]["demo"]["size"], 24, "{line}");
    }
    assert!(done(&sweep).contains("0 runs in"));
    std::fs::write(out.join("bench.jsonl"), &log[..log.len() - 200]).unwrap();
    assert!(done(&sweep).contains("1 runs in"));
    let page = done(&["report", text(&out)]);
    assert!(page.contains("report.html"), "{page}");
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    self_contained(&page);
    assert!(page.contains("hidden") && page.contains("data:image/svg+xml;base64,"));
}

#[test]
fn without_time_a_sweep_says_what_is_left() {
    let out = folder("no-time");
    let said = done(&["bench", "stability", "--minutes", "0", "--out", text(&out)]);
    assert!(said.contains("0 runs in") && said.contains("points are left"), "{said}");
    refused(&["bench", "pareto", "/no/such/place"], &["/no/such/place"]);
    refused(&["bench", "pareto", "--minutes=-1"], &["minutes"]);
    refused(&["bench", "stability", "--axes", "weather"], &["weather", "pose noise"]);
    refused(&["bench", "stability", "--side", "4"], &["--side 4"]);
    refused(&["bench", "point"], &["standard input"]);
}

/// A finished run as `train` leaves it, its method's name given.
fn run(name: &str, method: &str) -> PathBuf {
    let path = folder(name);
    std::fs::create_dir_all(path.join("renders")).unwrap();
    let config = toml::to_string(&Config::preset(Preset::Fast, Method::Occnerf)).unwrap();
    let config = config.lines().fold(String::from("scene = \"<b onclick=x>\"\n\n[train]\n"), |text, line| {
        text + &line.replace('[', "[train.") + "\n"
    });
    std::fs::write(path.join("config.toml"), config).unwrap();
    let split = serde_json::json!({
        "psnr_vis": 15.0, "ssim_vis": 0.5, "psnr_mask": 18.25, "ssim_mask": 0.7, "psnr_hidden": null, "psnr_full": 20.0,
        "ssim_full": 0.9, "lpips_full": null, "mask_iou": 0.9, "render_seconds_per_frame": 0.25, "frames": [],
    });
    let metrics = serde_json::json!({
        "method": method, "preset": "fast", "occluded": "unknown", "scene": "</script><b onclick=x>", "seed": 1, "steps": 7,
        "train_seconds": 3.0, "peak_rss_bytes": 1000, "parameters": 5, "splits": { "novel_view": split },
    });
    std::fs::write(path.join("metrics.json"), metrics.to_string()).unwrap();
    let log: Vec<String> = (0..9)
        .map(|i| serde_json::json!({ "step": i, "seconds": i, "loss": 1.0 / f64::from(i + 1), "psnr": i }).to_string())
        .collect();
    std::fs::write(path.join("train.jsonl"), log.join("\n") + "\n{\"step\": 9, \"sec").unwrap();
    // Two pairs of pictures on white.
    let sheet = RgbImage::from_fn(4 * 12 + 4, 16, |x, y| {
        if x % 12 < 4 || !(4..12).contains(&y) { Rgb([255; 3]) } else { Rgb([x as u8, y as u8, 9]) }
    });
    sheet.save(path.join("renders/novel_views.png")).unwrap();
    path
}

fn page_of(arguments: &[&Path], out: &Path) -> String {
    let mut all = vec!["report", "--out", out.to_str().unwrap()];
    all.extend(arguments.iter().map(|p| p.to_str().unwrap()));
    done(&all);
    std::fs::read_to_string(out).unwrap()
}

#[test]
fn a_page_of_runs_needs_nothing_else_and_escapes_what_files_say() {
    let (a, b) = (run("page-a", "<b onclick=x>&amp;"), run("page-b", "plain"));
    let page = page_of(&[&a, &b], &folder("page").join("both.html"));
    self_contained(&page);
    assert!(page.contains("&lt;b onclick=x&gt;&amp;amp;") && page.contains("18.25"));
    assert!(page.contains("<polyline") && page.contains("config.toml"));
    // One viewer for both: they have the same truth.
    assert_eq!(page.matches("<div class=viewer>").count(), 1);
    let at = page.find("application/json\">").unwrap() + "application/json\">".len();
    let data = &page[at..at + page[at..].find("</script>").unwrap()];
    let data: serde_json::Value = serde_json::from_str(data).unwrap();
    assert_eq!(data["sides"].as_array().unwrap().len(), 3);
    assert_eq!((data["views"].as_array().unwrap().len(), data["sides"][2]["name"].as_str()), (2, Some("page-b")));
    // A folder of runs is its runs.
    let parent = folder("page-parent");
    std::fs::rename(run("page-c", "plain"), parent.join("inside")).unwrap();
    assert!(page_of(&[&parent], &parent.join("page.html")).contains("inside"));
}

#[test]
fn what_is_damaged_is_named() {
    let damaged = |name: &str, file: &str, content: &[u8], words: &[&str]| {
        let path = run(name, "plain");
        std::fs::write(path.join(file), content).unwrap();
        refused(&["report", path.to_str().unwrap()], words);
        assert!(!path.join("report.html").exists());
    };
    damaged("bad-metrics", "metrics.json", b"{\"method\": 3}", &["bad-metrics", "metrics.json"]);
    damaged("bad-config", "config.toml", b"scene = 3", &["config.toml"]);
    damaged("bad-log", "train.jsonl", b"{}\nnot json\n{}\n", &["train.jsonl", "line 2"]);
    damaged("bad-picture", "renders/novel_views.png", b"\x89PNG and no more", &["novel_views.png"]);
    damaged("bad-other", "renders/other.png", b"nothing", &["other.png", "not a PNG"]);
    damaged("bad-bench", "bench.jsonl", b"{}\n{}\n", &["bench.jsonl", "line 1"]);
    let path = run("no-metrics", "plain");
    std::fs::remove_file(path.join("metrics.json")).unwrap();
    refused(&["report", path.to_str().unwrap()], &["metrics.json"]);
    refused(&["report", "/no/such/run"], &["/no/such/run", "no such directory"]);
    refused(&["report", folder("empty").to_str().unwrap()], &["neither a run", "bench.jsonl"]);
}
