//! The chart of methods by the number of steps, and by their rates.

use std::path::{Path, PathBuf};

use anyhow::Result;
use occnerf::SplitMetrics;

use crate::bench::chart::{Axis, Line, Mark, Panel, Picture, Shape, Style};
use xtask::run::Metrics;

/// What is drawn of a split, and over what: names and axes.
type Worth = (&'static str, fn(&SplitMetrics) -> Option<f64>);
const WORTHS: [Worth; 2] = [("psnr_mask, dB", |s| s.psnr_mask), ("ssim_mask", |s| s.ssim_mask)];
const AXES: [&str; 2] = ["steps", "factor on every rate"];

/// A row of the table: the method, the factor on its rates, its steps, and its runs.
struct Point<'a> {
    method: &'a str,
    rates: f64,
    steps: f64,
    runs: &'a [Metrics],
}

/// Writes the chart of rows, by their names and runs, to STEM.png and STEM.svg, and returns the
/// former.
pub fn draw<'a>(scene: &str, rows: impl Iterator<Item = (&'a str, &'a [Metrics])>, stem: &Path) -> Result<PathBuf> {
    let point = |(name, runs): (&'a str, &'a [Metrics])| {
        let ((method, rates), steps) = (said(name)?, runs.first()?.steps as f64);
        Some(Point { method, rates, steps, runs })
    };
    let points: Vec<Point<'_>> = rows.filter_map(point).collect();
    let mut methods: Vec<&str> = points.iter().map(|p| p.method).collect();
    methods.dedup();
    // Of the row that has neither other steps nor other rates, both charts have a point.
    let usual = |p: &&Point<'_>| points.iter().find(|q| q.method == p.method).map_or(p.steps, |first| first.steps);
    let mut panels = Vec::new();
    for (label, worth) in WORTHS {
        for (axis, name) in AXES.into_iter().enumerate() {
            let of = |p: &Point<'_>| {
                let values: Vec<f64> = p.runs.iter().filter_map(|m| worth(m.splits.first()?.1)).collect();
                let at = if axis == 0 { p.steps } else { p.rates };
                (!values.is_empty()).then(|| (at, values.iter().sum::<f64>() / values.len() as f64))
            };
            let shown = |p: &&Point<'_>| if axis == 0 { p.rates == 1.0 } else { p.steps == usual(p) };
            let lines: Vec<Vec<(f64, f64)>> = methods
                .iter()
                .map(|method| {
                    let of_method = points.iter().filter(|p| p.method == *method).filter(shown);
                    let mut line: Vec<(f64, f64)> = of_method.filter_map(of).collect();
                    line.sort_by(|a, b| a.0.total_cmp(&b.0));
                    line
                })
                .collect();
            let mark =
                |color: usize, &at: &(f64, f64)| Mark { at, name: String::new(), style: Style(color, Shape::Circle) };
            panels.push(Panel {
                title: String::new(),
                labels: [name.to_owned(), label.to_owned()],
                scales: [
                    Axis::around(lines.iter().flatten().map(|at| at.0), true),
                    Axis::around(lines.iter().flatten().map(|at| at.1), false),
                ],
                marks: lines.iter().enumerate().flat_map(|(c, line)| line.iter().map(move |at| mark(c, at))).collect(),
                lines: lines.into_iter().enumerate().map(|(color, points)| Line { points, color }).collect(),
            });
        }
    }
    let picture = Picture {
        title: format!("{scene}: methods on unseen views"),
        legend: methods.iter().enumerate().map(|(c, name)| ((*name).to_owned(), Style(c, Shape::Circle))).collect(),
        columns: 2,
        size: (480, 340),
        panels,
    };
    Ok(picture.write(stem)?[1].clone())
}

/// What the name of a row says: the method, and the factor on its rates.
fn said(name: &str) -> Option<(&str, f64)> {
    match name.rsplit_once("-rates-x") {
        Some((method, rates)) => Some((method, rates.parse().ok()?)),
        None => Some((name.rsplit_once("-x")?.0, 1.0)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reproduce::rows::Table;

    #[test]
    fn names_of_all_rows_say_their_method_and_rates_and_the_usual_row_comes_first() {
        let rows = Table::Curves.rows();
        let mut methods: Vec<&str> = Vec::new();
        for row in &rows {
            let (method, rates) = said(&row.name).unwrap();
            assert_eq!(rates as f32, row.rates, "{}", row.name);
            if methods.last() != Some(&method) {
                assert!(row.name.ends_with("-x1") && !methods.contains(&method), "{}", row.name);
                methods.push(method);
            }
        }
        assert_eq!(methods.len(), 4);
    }
}
