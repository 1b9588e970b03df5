//! report.html: a run's scores, its course and its pictures on one page that needs no other file.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use crate::run::{self, Metrics};
use crate::table;

/// Size of the chart in pixels.
const CHART: (f64, f64) = (640.0, 200.0);
const PICTURES: [(&str, &str); 2] = [
    ("renders/novel_views.png", "Views that training never saw: truth left, result right; a row a camera"),
    ("renders/train_views.png", "Training views: what the video showed left, result right"),
];

/// Writes the page of a finished run.
pub fn write(directory: &Path, metrics: &Metrics) -> Result<()> {
    let mut page = String::from("<!doctype html><meta charset=\"utf-8\">");
    let title = escape(&format!("{} on {}, {} steps", metrics.method, metrics.scene, metrics.steps));
    let style = "body{font:15px sans-serif;margin:2em;max-width:1200px}img{max-width:100%}pre{overflow:auto}";
    write!(page, "<title>{title}</title><style>{style}</style><h1>{title}</h1>")?;
    let table = table::markdown(&[(metrics.method.clone(), metrics)]);
    write!(page, "<pre>{}</pre>", escape(&table))?;
    let log = directory.join("train.jsonl");
    if log.is_file() {
        let text = std::fs::read_to_string(&log).with_context(|| log.display().to_string())?;
        page.push_str(&chart(&text, "psnr", "PSNR of the training patches, dB, against seconds"));
        page.push_str(&chart(&text, "loss", "Weighted loss against seconds"));
    }
    for (name, caption) in PICTURES {
        let path = directory.join(name);
        if path.is_file() {
            let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
            let data = STANDARD.encode(bytes);
            write!(page, "<h2>{caption}</h2><img alt=\"{caption}\" src=\"data:image/png;base64,{data}\">")?;
        }
    }
    let config = std::fs::read_to_string(directory.join("config.toml")).unwrap_or_default();
    write!(page, "<h2>config.toml</h2><pre>{}</pre>", escape(&config))?;
    run::write(&directory.join("report.html"), &page)
}

/// One quantity of the log as a line; nothing if there are not two points.
fn chart(log: &str, key: &str, caption: &str) -> String {
    let points: Vec<(f64, f64)> = log
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .filter_map(|line| Some((line["seconds"].as_f64()?, line[key].as_f64()?)))
        .filter(|(x, y)| x.is_finite() && y.is_finite())
        .collect();
    let range = |pick: fn(&(f64, f64)) -> f64| {
        let values = points.iter().map(pick);
        (values.clone().fold(f64::INFINITY, f64::min), values.fold(f64::NEG_INFINITY, f64::max))
    };
    let ((x0, x1), (y0, y1)) = (range(|p| p.0), range(|p| p.1));
    if points.len() < 2 || x1 <= x0 {
        return String::new();
    }
    let (width, height) = CHART;
    let place = |&(x, y): &(f64, f64)| {
        let (u, v) = ((x - x0) / (x1 - x0), (y - y0) / (y1 - y0).max(1e-12));
        format!("{:.1},{:.1}", u * width, height - v * height)
    };
    let line = points.iter().map(place).collect::<Vec<_>>().join(" ");
    format!(
        "<h2>{caption}</h2><svg width=\"{width}\" height=\"{height}\" viewBox=\"-5 -5 {} {}\"><polyline points=\"{line}\" \
         fill=\"none\" stroke=\"#06c\" stroke-width=\"2\"/></svg><p>{x0:.0} to {x1:.0} s, {y0:.3} to {y1:.3}</p>",
        width + 10.0,
        height + 10.0
    )
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}
