//! Quantities of training logs over time, as inline SVG.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result, bail};

use super::page::escape;
use crate::bench::{Scale, number};

/// Of a drawing, in its own units.
const SIZE: (f64, f64) = (520.0, 260.0);
/// Left, right, top and bottom of the plot.
const MARGIN: (f64, f64, f64, f64) = (56.0, 12.0, 10.0, 40.0);
/// More points than pixels show nothing.
const MOST: usize = 600;
/// Colours that the style knows.
const COLORS: usize = 7;

/// A training log: one JSON object a line.
pub struct Log(Vec<serde_json::Value>);

impl Log {
    /// Reads train.jsonl; none if there is none, as for methods that do not train. A last line that
    /// was cut off is left out.
    pub fn read(path: &Path) -> Result<Option<Self>> {
        if !path.exists() {
            return Ok(None);
        }
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let rows: Vec<&str> = text.lines().collect();
        let mut values = Vec::new();
        for (i, row) in rows.iter().enumerate() {
            match serde_json::from_str(row) {
                Ok(value) => values.push(value),
                Err(_) if i + 1 == rows.len() || row.trim().is_empty() => {}
                Err(error) => bail!("{}, line {}: {error}", path.display(), i + 1),
            }
        }
        Ok(Some(Self(values)))
    }

    fn course(&self, key: &str) -> Vec<(f64, f64)> {
        let point = |line: &serde_json::Value| Some((line["seconds"].as_f64()?, line[key].as_f64()?));
        let finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
        let points: Vec<(f64, f64)> = self.0.iter().filter_map(point).filter(finite).collect();
        let stride = points.len().div_ceil(MOST).max(1);
        points.into_iter().step_by(stride).collect()
    }
}

/// One quantity of all logs against seconds, with a key if there are several; nothing without two
/// points.
pub fn curves(logs: &[(String, Log)], key: &str, label: &str, logarithmic: bool) -> String {
    let courses: Vec<(&str, Vec<(f64, f64)>)> = logs
        .iter()
        .map(|(name, log)| (name.as_str(), log.course(key)))
        .filter(|(_, points)| points.len() > 1)
        .collect();
    if courses.is_empty() {
        return String::new();
    }
    let all = || courses.iter().flat_map(|c| &c.1);
    let x = Scale::around(all().map(|p| p.0), false);
    let y = Scale::around(all().map(|p| p.1), logarithmic);
    let (left, right, top, bottom) = MARGIN;
    let across = |v: f64| left + x.share(v) * (SIZE.0 - left - right);
    let down = |v: f64| SIZE.1 - bottom - y.share(v) * (SIZE.1 - top - bottom);
    let mut svg = format!("<svg class=curve viewBox=\"0 0 {} {}\" role=img>", SIZE.0, SIZE.1);
    let _ = write!(svg, "<title>{}</title>", escape(label));
    for tick in y.ticks() {
        let v = down(tick);
        let _ = write!(
            svg,
            "<line class=grid x1={left} x2={} y1={v:.1} y2={v:.1} /><text x={} y={:.1} text-anchor=end>{}</text>",
            SIZE.0 - right,
            left - 6.0,
            v + 4.0,
            number(tick)
        );
    }
    for tick in x.ticks().into_iter().filter(|t| *t >= 0.0) {
        let (u, v) = (across(tick), SIZE.1 - bottom + 16.0);
        let _ = write!(svg, "<text x={u:.1} y={v} text-anchor=middle>{}</text>", number(tick));
    }
    let (middle, low) = ((left + SIZE.0 - right) / 2.0, SIZE.1 - 6.0);
    let _ = write!(svg, "<text x={middle} y={low} text-anchor=middle>seconds</text>");
    for (i, (_, points)) in courses.iter().enumerate() {
        let shown = points.iter().filter(|p| y.shows(p.1));
        let line: Vec<String> = shown.map(|p| format!("{:.1},{:.1}", across(p.0), down(p.1))).collect();
        let _ = write!(svg, "<polyline points=\"{}\" style=\"stroke:var(--c{})\" />", line.join(" "), i % COLORS);
    }
    svg.push_str("</svg>\n");
    if courses.len() > 1 {
        svg.push_str("<p class=key>");
        for (i, (name, _)) in courses.iter().enumerate() {
            let _ = write!(svg, "<span><i style=\"background:var(--c{})\"></i>{}</span> ", i % COLORS, escape(name));
        }
        svg.push_str("</p>\n");
    }
    format!("<h3>{}</h3>\n{svg}", escape(label))
}
