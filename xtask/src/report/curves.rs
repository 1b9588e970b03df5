//! Training curves as inline SVG.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Result, bail};

use super::page::escape;
use crate::run::read_text;
use crate::scale::{Scale, number};

/// Size of a plot in SVG units.
const SIZE: (f64, f64) = (520.0, 260.0);
/// Left, right, top and bottom of the plot.
const MARGIN: (f64, f64, f64, f64) = (56.0, 12.0, 10.0, 40.0);
/// Most points of a curve.
const MOST: usize = 600;
/// Colours of the style sheet.
const COLORS: usize = 7;

/// A log of training, or of a bench: one JSON object a line.
pub struct Log(Vec<serde_json::Value>);

impl Log {
    /// Reads a log; none if there is none, as for methods that do not train. A last line that
    /// was cut off is left out.
    pub fn read(path: &Path) -> Result<Option<Self>> {
        if !path.exists() {
            return Ok(None);
        }
        let text = read_text(path)?;
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

    /// Its lines.
    pub fn lines(&self) -> &[serde_json::Value] {
        &self.0
    }

    fn course(&self, key: &str) -> Vec<(f64, f64)> {
        let point = |line: &serde_json::Value| Some((line["seconds"].as_f64()?, line[key].as_f64()?));
        let finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
        let points: Vec<(f64, f64)> = self.0.iter().filter_map(point).filter(finite).collect();
        let stride = points.len().div_ceil(MOST).max(1);
        points.into_iter().step_by(stride).collect()
    }
}

/// Plot of one quantity of all logs against seconds, with a legend for several; empty below two
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
        let shown = points.iter().filter(|p| x.shows(p.0) && y.shows(p.1));
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

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;

    #[test]
    fn damaged_logs_are_drawn_or_refused_in_a_second() {
        let line = |i: u64| format!("{{\"step\":{i},\"seconds\":{}.25,\"loss\":0.{i},\"psnr\":1{i}.5}}\n", i / 7);
        let whole: String = (1..40).map(line).collect();
        let numbers = ["1e308", "-1e308", "1e-300", "1e999", "NaN", "null", "\"</svg>\""];
        let replaced = [":0.7", ":19.5", ":3,"].iter().flat_map(|old| {
            let end = if old.ends_with(',') { "," } else { "" };
            numbers.map(|new| whole.replace(old, &format!(":{new}{end}")).into_bytes())
        });
        let folder = testkit::files::Directory::new("curves");
        let path = folder.file("train.jsonl");
        let mut drawn = 0;
        for (case, bytes) in replaced.chain(testkit::files::damaged(whole.as_bytes(), 180)).enumerate() {
            std::fs::write(&path, &bytes).unwrap();
            // What another process kept waiting is tried again.
            let quick = (0..3).any(|_| {
                let start = Instant::now();
                if let Ok(Some(log)) = Log::read(&path) {
                    let logs = [(String::from("run"), log)];
                    let svg = curves(&logs, "loss", "loss", true) + &curves(&logs, "psnr", "psnr", false);
                    assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.len() < 1 << 20, "input {case}: {svg}");
                    drawn += 1;
                }
                start.elapsed() < Duration::from_secs(1)
            });
            assert!(quick, "input {case} took longer");
        }
        assert!(drawn > 20, "{drawn} drawn");
    }
}
