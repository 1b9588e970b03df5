//! `bench pareto`: seconds against accuracy of every named approximation.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Result;

use super::chart::{self, Axis, Mark, Panel, Picture, Shape, Style};
use super::front::front;
use super::points::Sweep;
use super::runner::{Bench, Kind, Line};

/// A measured quantity of a run.
pub type Pick = fn(&Line) -> Option<f64>;

/// What is worth having, with its digits in tables.
const WORTHS: [(&str, Pick, usize); 3] = [
    ("psnr_mask, dB", |l| l.outcome.psnr_mask, 2),
    ("psnr_hidden, dB", |l| l.outcome.psnr_hidden, 2),
    ("ssim_mask", |l| l.outcome.ssim_mask, 4),
];
/// What it costs.
const COSTS: [(&str, &str, Pick); 2] = [
    ("training", "seconds of training", |l| Some(l.outcome.train_seconds)),
    ("frame", "seconds a frame", |l| Some(l.outcome.seconds_per_frame)),
];

fn style(line: &Line) -> Style {
    match line.point.kind {
        Kind::Base => Style(6, Shape::Square),
        Kind::Change | Kind::Level => Style(0, Shape::Circle),
        Kind::Combination => Style(3, Shape::Circle),
        Kind::Preset | Kind::Auto => Style(2, Shape::Triangle),
        Kind::Baseline => Style(1, Shape::Ring),
        Kind::Baked => Style(4, Shape::Circle),
    }
}

/// Runs the sweep of one capture: single changes, then their best combinations.
pub fn run(sweep: &Sweep, bench: &mut Bench) -> Result<Vec<Line>> {
    let mut lines = Vec::new();
    for point in sweep.first()? {
        lines.extend(bench.run(point)?);
    }
    for point in sweep.combinations(&lines)? {
        lines.extend(bench.run(point)?);
    }
    Ok(lines)
}

/// Which lines are on the front of a cost and a worth.
pub fn on_front(lines: &[Line], cost: Pick, worth: Pick) -> Vec<bool> {
    let of = |line: &Line, pick: Pick| if line.outcome.error.is_some() { None } else { pick(line) };
    let points = lines.iter().map(|l| (of(l, cost).unwrap_or(f64::NAN), of(l, worth).unwrap_or(f64::NAN)));
    front(&points.collect::<Vec<_>>())
}

/// One picture for each cost, a panel for each worth: STEM-training and STEM-frame.
pub fn charts(scene: &str, lines: &[Line], stem: &Path) -> Result<()> {
    let legend = [
        ("front", Style(5, Shape::Dash)),
        ("base", Style(6, Shape::Square)),
        ("one change", Style(0, Shape::Circle)),
        ("combination", Style(3, Shape::Circle)),
        ("preset", Style(2, Shape::Triangle)),
        ("other method", Style(1, Shape::Ring)),
        ("baked", Style(4, Shape::Circle)),
    ];
    for (suffix, label, cost) in COSTS {
        let mut panels = Vec::new();
        for (name, worth, _) in WORTHS {
            let on = on_front(lines, cost, worth);
            let scored: Vec<(&Line, (f64, f64), bool)> = lines
                .iter()
                .zip(on)
                .filter(|(l, _)| l.outcome.error.is_none())
                .filter_map(|(l, on)| Some((l, (cost(l)?, worth(l)?), on)))
                .collect();
            let mut along: Vec<(f64, f64)> = scored.iter().filter(|s| s.2).map(|s| s.1).collect();
            along.sort_by(|a, b| a.0.total_cmp(&b.0));
            let close = close_to_base(&scored);
            let panel = |title: &str, zoom: bool| {
                let shown = || scored.iter().zip(&close).filter(move |(_, close)| !zoom || **close);
                let mark = |((line, at, _), close): (&(&Line, (f64, f64), bool), &bool)| {
                    let named = zoom || !close || line.point.kind == Kind::Base;
                    let name = if named { line.point.name.clone() } else { String::new() };
                    Mark { at: *at, name, style: style(line) }
                };
                Panel {
                    title: title.to_owned(),
                    labels: [label.to_owned(), name.to_owned()],
                    scales: [
                        Axis::around(shown().map(|s| s.0.1.0), true),
                        Axis::around(shown().map(|s| s.0.1.1), false),
                    ],
                    lines: vec![chart::Line { points: along.clone(), color: 5 }],
                    marks: shown().map(mark).collect(),
                }
            };
            panels.extend([panel("everything", false), panel("around the base", true)]);
        }
        let picture = Picture {
            title: format!("{scene}: {label} against accuracy on unseen views"),
            legend: legend.iter().map(|(name, style)| ((*name).to_owned(), *style)).collect(),
            columns: 2,
            size: (640, 460),
            panels,
        };
        picture.write(Path::new(&format!("{}-{suffix}", stem.display())))?;
    }
    Ok(())
}

/// Which points crowd around the base: at most 1.6 times slower or faster, and not much farther off
/// than most changes.
fn close_to_base(scored: &[(&Line, (f64, f64), bool)]) -> Vec<bool> {
    let base = scored.iter().find(|s| s.0.point.kind == Kind::Base).map(|s| s.1);
    let Some(base) = base else { return vec![true; scored.len()] };
    let off = |s: &(&Line, (f64, f64), bool)| (s.1.1 - base.1).abs();
    let mut changes: Vec<f64> = scored.iter().filter(|s| s.0.point.kind == Kind::Change).map(off).collect();
    changes.sort_by(f64::total_cmp);
    let most = changes.get(changes.len() / 2).map_or(f64::INFINITY, |median| 4.0 * median);
    scored.iter().map(|s| off(s) <= most && (s.1.0 / base.0).ln().abs() <= 1.6f64.ln()).collect()
}

/// A row a point, differences to the base in brackets; the last column says on which fronts of
/// training time it is.
pub fn table(lines: &[Line]) -> String {
    let base = lines.iter().find(|l| l.point.kind == Kind::Base);
    let mut text = String::from("| point | changes | train s | s/frame |");
    WORTHS.iter().for_each(|(name, ..)| text.push_str(&format!(" {name} |")));
    text.push_str(" parameters | MB | on the front of |\n| --- | --- | ---: | ---: |");
    WORTHS.iter().for_each(|_| text.push_str(" ---: |"));
    text.push_str(" ---: | ---: | --- |\n");
    let fronts = WORTHS.map(|(_, worth, _)| on_front(lines, COSTS[0].2, worth));
    for (i, line) in lines.iter().enumerate() {
        let (point, outcome) = (&line.point, &line.outcome);
        let _ = write!(text, "| {} | {} |", point.name, point.factor);
        if let Some(error) = &outcome.error {
            let _ = writeln!(text, " failed: {} | | | | | | | |", error.replace(['|', '\n'], " "));
            continue;
        }
        let _ = write!(text, " {:.1} | {:.3} |", outcome.train_seconds, outcome.seconds_per_frame);
        for (_, pick, digits) in WORTHS {
            let difference = base.and_then(pick).zip(pick(line)).map(|(b, v)| v - b);
            let difference = difference.filter(|_| point.kind != Kind::Base);
            let difference = difference.map_or(String::new(), |d| format!(" ({d:+.digits$})"));
            let value = pick(line).map_or("–".to_owned(), |v| format!("{v:.digits$}"));
            let _ = write!(text, " {value}{difference} |");
        }
        let names = WORTHS.iter().zip(&fronts).filter(|(_, on)| on[i]);
        let names: Vec<&str> = names.map(|((name, ..), _)| name.trim_end_matches(", dB")).collect();
        let megabytes = outcome.peak_rss_bytes as f64 / 1e6;
        let _ = writeln!(text, " {} | {megabytes:.0} | {} |", outcome.parameters, names.join(", "));
    }
    text
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;
    use crate::bench::runner::tests::line;

    #[test]
    fn the_table_names_the_front_and_failed_points() {
        let mut failed = line("bad", "k", Kind::Change, 30.0, 1.0);
        failed.outcome.error = Some("one\ntwo | three".to_owned());
        let lines = [
            line("base", "base", Kind::Base, 20.0, 10.0),
            line("slow", "k", Kind::Change, 19.5, 12.0),
            line("good", "k", Kind::Change, 20.25, 9.0),
            failed,
        ];
        let text = table(&lines);
        let rows: Vec<&str> = text.lines().skip(2).collect();
        assert_eq!(rows.len(), 4);
        assert!(rows[0].ends_with("|  |") && rows[1].contains("(-0.50)") && rows[1].ends_with("|  |"), "{text}");
        assert!(rows[2].contains("20.25 (+0.25)") && rows[2].contains("psnr_mask, psnr_hidden"), "{text}");
        assert!(rows[3].contains("failed: one two   three"), "{text}");
        let cells = |row: &str| row.matches('|').count();
        assert!(text.lines().all(|row| cells(row) == cells(rows[0])), "{text}");
    }

    #[test]
    fn charts_are_drawn_of_any_lines_at_all() {
        let stem = std::env::temp_dir().join(format!("xtask-pareto-{}", std::process::id()));
        for count in [0, 1, 40] {
            let name = |i: usize| format!("point <{i}> & more");
            let of = |i: usize| line(&name(i), "k", Kind::Change, 20.0 + (i % 7) as f64, 1.0 + (i % 5) as f64);
            let lines: Vec<Line> = (0..count).map(of).collect();
            charts("a scene", &lines, &stem).unwrap();
            for suffix in ["training", "frame"] {
                let path = format!("{}-{suffix}", stem.display());
                let svg = std::fs::read_to_string(format!("{path}.svg")).unwrap();
                assert!(svg.contains("</svg>") && (count == 0 || svg.contains("point &lt;0&gt; &amp; more")));
                assert_eq!(image::open(format!("{path}.png")).unwrap().width(), 1280);
                std::fs::remove_file(format!("{path}.svg")).unwrap();
                std::fs::remove_file(format!("{path}.png")).unwrap();
            }
        }
    }
}
