//! `bench kernels`: cost against error of each geometric approximation, one thread, medians.

mod figure;
mod measure;

use std::path::Path;

use anyhow::Result;

use self::figure::{Figure, Sample};
use super::chart::{Axis, Mark, Panel, Picture, Shape, Style};
use crate::results::{self, KERNELS, Section};
use xtask::process::say;
use xtask::table;

/// Measures everything and draws it.
pub fn run(directory: &Path, quick: bool, publish: bool) -> Result<()> {
    xtask::run::make_directory(directory)?;
    let figure = Figure::new(if quick { 4_000 } else { 20_000 });
    let kernels = [
        measure::distance(&figure)?,
        measure::neighbours(&figure)?,
        measure::motion(&figure)?,
        measure::samples(&figure, if quick { 300 } else { 2000 })?,
        measure::table(&figure, if quick { 20 } else { 60 })?,
    ];
    let results: Vec<&Sample> = kernels.iter().flat_map(|k| &k.samples).collect();
    let path = directory.join(KERNELS);
    xtask::run::write(&path, &serde_json::to_string_pretty(&results)?)?;
    let mut text = String::new();
    for kernel in &kernels {
        let mut lines = vec![[kernel.name, kernel.cost, kernel.error].map(str::to_owned).to_vec()];
        let line = |s: &Sample| vec![s.name.clone(), format!("{:.1}", s.nanoseconds), format!("{:.3}", s.error)];
        lines.extend(kernel.samples.iter().map(line));
        text.push_str(&format!("{}\n", table::aligned(&lines, 1)));
    }
    say!("{text}");
    say!("written: {}", path.display());
    let panels = kernels.iter().map(|kernel| {
        let of = |pick: fn(&Sample) -> f64| kernel.samples.iter().map(pick);
        Panel {
            title: kernel.name.to_owned(),
            labels: [kernel.cost.to_owned(), kernel.error.to_owned()],
            scales: [
                Axis::around(of(|s| s.nanoseconds), true),
                Axis::around(of(|s| s.error), of(|s| s.error).all(|e| e > 0.0)),
            ],
            lines: Vec::new(),
            marks: (kernel.samples.iter())
                .map(|s| Mark {
                    at: (s.nanoseconds, s.error),
                    name: s.name.clone(),
                    style: if s.default { Style(1, Shape::Square) } else { Style(0, Shape::Circle) },
                })
                .collect(),
        }
    });
    let legend = vec![
        ("what a preset uses".to_owned(), Style(1, Shape::Square)),
        ("alternatives".to_owned(), Style(0, Shape::Circle)),
    ];
    let title = "Cost against error of each approximation (embedded body, one thread, medians)".to_owned();
    Picture { title, legend, columns: 2, size: (520, 380), panels: panels.collect() }
        .write(&directory.join("kernels"))?;
    if publish {
        let charts = results::charts(directory, "kernels")?;
        let (name, title) = ("kernels", "Cost against error of the geometric kernels");
        results::publish(&Section { name, title, body: &text, charts: &charts })?;
    }
    Ok(())
}
