//! Costs against accuracy of the points of a sweep: `bench pareto`.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Result;

use super::chart::{Mark, Panel, Picture, Shape, Style, front, legend};
use crate::sweep::{Kind, Line};

/// A measured quantity of a run.
type Pick = fn(&Line) -> Option<f64>;

/// What is worth having, with its digits in tables.
const WORTHS: [(&str, Pick, usize); 4] = [
    ("psnr_mask, dB", |l| l.outcome.psnr_mask, 2),
    ("psnr_hidden, dB", |l| l.outcome.psnr_hidden, 2),
    ("ssim_mask", |l| l.outcome.ssim_mask, 4),
    // Less is better.
    ("−LPIPS", |l| l.outcome.lpips.map(|lpips| -lpips), 4),
];

/// What it costs: the end of the chart's name, the label, the quantity.
type Cost = (&'static str, &'static str, Pick);
/// Costs of `bench pareto`, the first that of the fronts in its table.
const COSTS: [Cost; 3] = [
    ("-training", "seconds of training", |l| Some(l.outcome.train_seconds)),
    ("-frame", "seconds a frame", |l| Some(l.outcome.seconds_per_frame)),
    ("-parameters", "parameters", |l| Some(l.outcome.parameters as f64)),
];

const STYLES: [(Kind, &str, Style); 5] = [
    (Kind::Base, "base", Style(6, Shape::Square)),
    (Kind::Change, "one change", Style(0, Shape::Circle)),
    (Kind::Preset, "preset", Style(2, Shape::Triangle)),
    (Kind::Baseline, "other method", Style(1, Shape::Ring)),
    (Kind::Baked, "baked", Style(4, Shape::Circle)),
];

/// Cost and worth of a line that did not fail; NaN where either is missing.
fn place(line: &Line, cost: Pick, worth: Pick) -> (f64, f64) {
    match cost(line).zip(worth(line)) {
        Some(at) if line.outcome.error.is_none() => at,
        _ => (f64::NAN, f64::NAN),
    }
}

/// A picture for each cost, with a panel for each worth, and one of the points around the base.
pub fn charts(scene: &str, lines: &[Line], stem: &Path) -> Result<()> {
    let styles = STYLES.iter().filter(|(kind, ..)| lines.iter().any(|l| l.point.kind == *kind));
    let names: Vec<(&str, Style)> = styles.map(|&(_, name, style)| (name, style)).collect();
    for (suffix, label, cost) in COSTS {
        let mut panels = Vec::new();
        for (name, worth, _) in WORTHS {
            let scored: Vec<(&Line, (f64, f64))> = lines
                .iter()
                .map(|l| (l, place(l, cost, worth)))
                .filter(|(_, at)| at.0.is_finite() && at.1.is_finite())
                .collect();
            let all: Vec<(f64, f64)> = scored.iter().map(|s| s.1).collect();
            if scored.is_empty() && !lines.is_empty() {
                continue;
            }
            let close = close_to_base(&scored);
            let panel = |title: &str, zoom: bool| {
                let shown = scored.iter().zip(&close).filter(|(_, close)| !zoom || **close);
                let mark = |(&(line, at), close): (&(&Line, (f64, f64)), &bool)| {
                    let named = zoom || !close || line.point.kind == Kind::Base;
                    let name = if named { line.point.name.clone() } else { String::new() };
                    let style = STYLES.iter().find(|s| s.0 == line.point.kind).map_or(Style(0, Shape::Circle), |s| s.2);
                    Mark { at, name, style }
                };
                Panel::scatter(title, [label, name], shown.map(mark).collect(), &all)
            };
            panels.push(panel(if close.contains(&true) { "everything" } else { "" }, false));
            if close.contains(&true) {
                panels.push(panel("around the base", true));
            }
        }
        let title = format!("{scene}: {label} against accuracy on unseen views");
        let legend = legend(&[&[("front", Style(5, Shape::Dash))], &names[..]].concat());
        let picture = Picture { title, legend, columns: 2, size: (640, 460), panels };
        picture.write(Path::new(&format!("{}{suffix}", stem.display())))?;
    }
    Ok(())
}

/// Points that crowd around the base, if there is one: at most 1.6 times slower or faster, and not
/// much farther off than most changes.
fn close_to_base(scored: &[(&Line, (f64, f64))]) -> Vec<bool> {
    let base = scored.iter().find(|s| s.0.point.kind == Kind::Base).map(|s| s.1);
    let Some(base) = base else { return vec![false; scored.len()] };
    let off = |s: &(&Line, (f64, f64))| (s.1.1 - base.1).abs();
    let mut changes: Vec<f64> = scored.iter().filter(|s| s.0.point.kind == Kind::Change).map(off).collect();
    changes.sort_by(f64::total_cmp);
    let most = changes.get(changes.len() / 2).map_or(f64::INFINITY, |median| 4.0 * median);
    scored.iter().map(|s| off(s) <= most && (s.1.0 / base.0).ln().abs() <= 1.6f64.ln()).collect()
}

/// A row a point, in brackets its difference to the base, or to the preset that it is a change of;
/// the last column says on which fronts of training time it is.
pub fn table(lines: &[Line]) -> String {
    let mut text = String::from("| point | changes | train s | s/frame |");
    WORTHS.iter().for_each(|(name, ..)| text.push_str(&format!(" {name} |")));
    text.push_str(" parameters | MB | on the front of |\n| --- | --- | ---: | ---: |");
    WORTHS.iter().for_each(|_| text.push_str(" ---: |"));
    text.push_str(" ---: | ---: | --- |\n");
    let fronts =
        WORTHS.map(|(_, worth, _)| front(&lines.iter().map(|l| place(l, COSTS[0].2, worth)).collect::<Vec<_>>()));
    for (i, line) in lines.iter().enumerate() {
        let (point, outcome) = (&line.point, &line.outcome);
        let _ = write!(text, "| {} | {} |", point.name, point.factor);
        if let Some(error) = &outcome.error {
            let _ = writeln!(text, " failed: {} | | | | | | | | |", error.replace(['|', '\n'], " "));
            continue;
        }
        let is_base =
            |l: &&Line| l.point.kind == Kind::Base || (l.point.kind == Kind::Preset && l.point.factor == point.factor);
        let base = lines.iter().find(is_base).filter(|base| base.point.name != point.name);
        let _ = write!(text, " {:.1} | {:.3} |", outcome.train_seconds, outcome.seconds_per_frame);
        for (_, pick, digits) in WORTHS {
            let difference = base.and_then(pick).zip(pick(line)).map(|(b, v)| v - b);
            let difference = difference.map_or(String::new(), |d| format!(" ({d:+.digits$})"));
            let value = pick(line).map_or("–".to_owned(), |v| format!("{v:.digits$}"));
            let _ = write!(text, " {value}{difference} |");
        }
        let share = base.filter(|base| base.outcome.parameters != outcome.parameters);
        let share = share.map(|base| 100.0 * outcome.parameters as f64 / base.outcome.parameters.max(1) as f64);
        let share = share.map_or(String::new(), |share| format!(" ({share:.1} %)"));
        let names = WORTHS.iter().zip(&fronts).filter(|(_, on)| on[i]);
        let names: Vec<&str> = names.map(|((name, ..), _)| name.trim_end_matches(", dB")).collect();
        let megabytes = outcome.peak_rss_bytes as f64 / 1e6;
        let _ = writeln!(text, " {}{share} | {megabytes:.0} | {} |", outcome.parameters, names.join(", "));
    }
    text
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;
    use crate::sweep::tests::line;

    #[test]
    fn the_table_names_the_front_and_failed_points_and_compares_each_with_its_base() {
        let mut failed = line("bad", "k", Kind::Change, 30.0, 1.0);
        failed.outcome.error = Some("one\ntwo | three".to_owned());
        let mut lines = [
            line("base", "base", Kind::Base, 20.0, 10.0),
            line("slow", "k", Kind::Change, 19.5, 12.0),
            line("good", "k", Kind::Change, 20.25, 9.0),
            failed,
        ];
        (lines[0].outcome.parameters, lines[2].outcome.parameters) = (1000, 125);
        let text = table(&lines);
        let rows: Vec<&str> = text.lines().skip(2).collect();
        assert_eq!(rows.len(), 4);
        assert!(rows[0].ends_with("|  |") && rows[1].contains("(-0.50)") && rows[1].ends_with("|  |"), "{text}");
        assert!(rows[2].contains("20.25 (+0.25)") && rows[2].contains("psnr_mask, psnr_hidden"), "{text}");
        assert!(rows[2].contains("125 (12.5 %)") && rows[3].contains("failed: one two   three"), "{text}");
        let cells = |row: &str| row.matches('|').count();
        assert!(text.lines().all(|row| cells(row) == cells(rows[0])), "{text}");
        (lines[0].point.kind, lines[0].point.factor) = (Kind::Preset, "k".to_owned());
        assert!(table(&lines).contains("20.25 (+0.25)"));
    }

    #[test]
    fn charts_are_drawn_of_any_lines_at_all() {
        let stem = std::env::temp_dir().join(format!("lab-pareto-{}", std::process::id()));
        for count in [0, 1, 40] {
            let name = |i: usize| format!("point <{i}> & more");
            let of = |i: usize| {
                let mut line = line(&name(i), "k", Kind::Change, 20.0 + (i % 7) as f64, 1.0 + (i % 5) as f64);
                line.outcome.parameters = 1000 + i;
                line
            };
            let lines: Vec<Line> = (0..count).map(of).collect();
            charts("a scene", &lines, &stem).unwrap();
            for (suffix, ..) in COSTS {
                let path = format!("{}{suffix}", stem.display());
                let svg = std::fs::read_to_string(format!("{path}.svg")).unwrap();
                assert!(svg.contains("</svg>") && (count == 0 || svg.contains("point &lt;0&gt; &amp; more")));
                assert_eq!(image::open(format!("{path}.png")).unwrap().width(), 1280);
                std::fs::remove_file(format!("{path}.svg")).unwrap();
                std::fs::remove_file(format!("{path}.png")).unwrap();
            }
        }
    }
}
