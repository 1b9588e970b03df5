//! `bench capacity`: parameters and memory against accuracy, of fixed sizes and of those chosen
//! from the scene.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Result;
use occnerf::{Config, Method, Preset};

use super::chart::{self, Axis, Mark, Panel, Picture, Shape, Style};
use super::pareto::{Pick, on_front};
use super::points::{Setting, Sweep};
use super::runner::{Bench, Kind, Line, Point};
use xtask::capacity;
use xtask::source::Source;

/// Fixed sizes around `balanced`: name, as `train --set` takes it, whether the quick form has it.
const AROUND: [(&str, &[&str], bool); 7] = [
    ("table 2^11", &["encoding.log2_table_size=11"], true),
    ("table 2^13", &["encoding.log2_table_size=13"], true),
    ("table 2^14", &["encoding.log2_table_size=14"], false),
    ("table 2^18", &["encoding.log2_table_size=18"], false),
    ("8 levels to 176", &["encoding.levels=8", "encoding.n_max=176"], false),
    ("width 16", &["field.width=16"], false),
    ("width 32", &["field.width=32"], true),
];

const WORTHS: [(&str, Pick); 2] =
    [("psnr_mask, dB", |l| l.outcome.psnr_mask), ("psnr_hidden, dB", |l| l.outcome.psnr_hidden)];

/// Every point of one capture. `paper_steps`: of the preset `paper` and what is chosen from it, if
/// they are wanted.
pub fn points(sweep: &Sweep, source: &Source, paper_steps: Option<u64>) -> Result<Vec<Point>> {
    let steps = sweep.steps;
    let setting = |preset, steps, set| Setting { preset, method: Method::Occnerf, steps, set };
    let mut points = Vec::new();
    // With one loss, the sizes alone differ.
    let mse = format!("loss.mse={}", Config::preset(Preset::Balanced, Method::Occnerf).loss.mse);
    let loss = [mse.as_str()];
    // `fast` is `balanced` with fewer steps.
    let presets = [(Preset::Balanced, Some(steps), &[][..]), (Preset::Paper, paper_steps, &loss)];
    for (preset, steps, set) in presets.into_iter().filter_map(|(preset, steps, set)| Some((preset, steps?, set))) {
        let (name, setting) = (preset.name(), setting(preset, steps, set));
        points.push(sweep.point(name, name, Kind::Preset, &setting)?);
        let mut auto = sweep.point(&format!("{name}, auto"), name, Kind::Auto, &setting)?;
        capacity::measure(source, &auto.job.config, &[])?.apply(&mut auto.job.config);
        auto.job.config.validate()?;
        auto.job.prune = true;
        auto.command.iter_mut().for_each(|command| command.push_str(" --capacity auto"));
        points.push(auto);
    }
    let balanced = Preset::Balanced.name();
    for (name, set, quick) in AROUND {
        if quick || !sweep.quick {
            points.push(sweep.point(name, balanced, Kind::Change, &setting(Preset::Balanced, steps, set))?);
        }
    }
    points.iter_mut().for_each(|point| point.bench = "capacity".to_owned());
    Ok(points)
}

/// Runs them.
pub fn run(points: Vec<Point>, bench: &mut Bench) -> Result<Vec<Line>> {
    let mut lines = Vec::new();
    for point in points {
        lines.extend(bench.run(point)?);
    }
    Ok(lines)
}

fn parameters(line: &Line) -> Option<f64> {
    Some(line.outcome.parameters as f64)
}

/// STEM.svg and STEM.png: a panel for each measure of accuracy.
pub fn chart(scene: &str, lines: &[Line], stem: &Path) -> Result<()> {
    let style = |line: &Line| match line.point.kind {
        Kind::Auto => Style(1, Shape::Square),
        Kind::Preset => Style(2, Shape::Triangle),
        _ => Style(0, Shape::Circle),
    };
    let legend = [
        ("front", Style(5, Shape::Dash)),
        ("preset", Style(2, Shape::Triangle)),
        ("auto: sizes from the scene", Style(1, Shape::Square)),
        ("balanced with one size changed", Style(0, Shape::Circle)),
    ];
    let panels = WORTHS.map(|(name, worth)| {
        let scored = lines.iter().filter(|l| l.outcome.error.is_none());
        let marks: Vec<Mark> = scored
            .filter_map(|line| {
                let at = (parameters(line)?, worth(line)?);
                Some(Mark { at, name: line.point.name.clone(), style: style(line) })
            })
            .collect();
        let on = lines.iter().zip(on_front(lines, parameters, worth)).filter(|(_, on)| *on);
        let mut along: Vec<(f64, f64)> = on.filter_map(|(l, _)| Some((parameters(l)?, worth(l)?))).collect();
        along.sort_by(|a, b| a.0.total_cmp(&b.0));
        Panel {
            title: String::new(),
            labels: ["parameters".to_owned(), name.to_owned()],
            scales: [
                Axis::around(marks.iter().map(|m| m.at.0), true),
                Axis::around(marks.iter().map(|m| m.at.1), false),
            ],
            lines: vec![chart::Line { points: along, color: 5 }],
            marks,
        }
    });
    let picture = Picture {
        title: format!("{scene}: parameters against accuracy on unseen views"),
        legend: legend.iter().map(|(name, style)| ((*name).to_owned(), *style)).collect(),
        columns: 2,
        size: (640, 460),
        panels: panels.into(),
    };
    picture.write(stem).map(|_| ())
}

/// A row a point; in brackets what it has of its preset's parameters, and its difference to that
/// preset.
pub fn table(lines: &[Line]) -> String {
    let mut text = String::from("| point | preset | parameters | MB | train s |");
    WORTHS.iter().for_each(|(name, _)| text.push_str(&format!(" {name} |")));
    text.push_str("\n| --- | --- | ---: | ---: | ---: | ---: | ---: |\n");
    for line in lines {
        let (point, outcome) = (&line.point, &line.outcome);
        let _ = write!(text, "| {} | {} |", point.name, point.factor);
        if let Some(error) = &outcome.error {
            let _ = writeln!(text, " failed: {} | | | | |", error.replace(['|', '\n'], " "));
            continue;
        }
        let base = lines.iter().find(|l| l.point.kind == Kind::Preset && l.point.factor == point.factor);
        let base = base.filter(|base| base.point.name != point.name && base.outcome.error.is_none());
        let share = base.map(|base| 100.0 * outcome.parameters as f64 / base.outcome.parameters.max(1) as f64);
        let share = share.map_or(String::new(), |share| format!(" ({share:.1} %)"));
        let megabytes = outcome.peak_rss_bytes as f64 / 1e6;
        let _ = write!(text, " {}{share} | {megabytes:.0} | {:.1} |", outcome.parameters, outcome.train_seconds);
        for (_, worth) in WORTHS {
            let difference = base.and_then(worth).zip(worth(line)).map(|(base, value)| value - base);
            let difference = difference.map_or(String::new(), |d| format!(" ({d:+.2})"));
            let value = worth(line).map_or("–".to_owned(), |v| format!("{v:.2}"));
            let _ = write!(text, " {value}{difference} |");
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;
    use crate::bench::runner::tests::line;

    fn lines() -> Vec<Line> {
        let mut lines = vec![
            line("fast", "fast", Kind::Preset, 20.0, 10.0),
            line("fast, auto", "fast", Kind::Auto, 19.95, 6.0),
            line("table 2^11", "fast", Kind::Change, 19.0, 8.0),
            line("bad", "fast", Kind::Change, 30.0, 1.0),
        ];
        for (line, parameters) in lines.iter_mut().zip([1000, 125, 200, 1]) {
            line.outcome.parameters = parameters;
        }
        lines[3].outcome.error = Some("one\ntwo | three".to_owned());
        lines
    }

    #[test]
    fn the_table_compares_each_point_with_its_preset() {
        let text = table(&lines());
        let rows: Vec<&str> = text.lines().skip(2).collect();
        assert!(rows[0].starts_with("| fast | fast | 1000 |") && !rows[0].contains('('), "{text}");
        assert!(rows[1].contains("125 (12.5 %)") && rows[1].contains("19.95 (-0.05)"), "{text}");
        assert!(rows[3].contains("failed: one two   three"), "{text}");
        let cells = |row: &str| row.matches('|').count();
        assert!(text.lines().all(|row| cells(row) == cells(rows[0])), "{text}");
    }

    #[test]
    fn a_chart_is_drawn_of_any_lines_and_names_what_is_on_it() {
        let stem = std::env::temp_dir().join(format!("xtask-capacity-{}", std::process::id()));
        for lines in [Vec::new(), lines()] {
            chart("a <scene>", &lines, &stem).unwrap();
            let svg = std::fs::read_to_string(stem.with_extension("svg")).unwrap();
            assert!(svg.contains("</svg>") && svg.contains("a &lt;scene&gt;"));
            assert_eq!(svg.contains("fast, auto"), !lines.is_empty());
            assert!(!svg.contains(">bad<"));
            for extension in ["svg", "png"] {
                std::fs::remove_file(stem.with_extension(extension)).unwrap();
            }
        }
    }
}
