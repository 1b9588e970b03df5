//! `bench stability`: what happens as it gets hard.

use std::collections::HashSet;
use std::fmt::Write as _;
use std::path::Path;

use anyhow::Result;

use super::axes::Axis;
use super::chart::{self, Mark, Panel, Picture, Shape, Style};
use crate::methods::Method;
use crate::sweep::{Line, Runner};

/// Methods that are trained, ours first.
const TRAINED: [Method; 3] = [Method::Occnerf, Method::HashPoint, Method::Humannerf];
/// A method is broken where it loses more than this against the easiest level, dB.
const COLLAPSE: f64 = 3.0;
/// Seeds at a breaking point.
const SEEDS: std::ops::RangeInclusive<u64> = 1..=3;

/// What a sweep came to: the runs of one seed a method and level, and more seeds where one breaks.
pub struct Sweep {
    pub axes: Vec<Axis>,
    pub steps: u64,
    pub quick: bool,
    /// Trained runs at most.
    pub max_runs: usize,
}

/// How one method fared along one axis.
pub struct Course {
    /// (index of the level, psnr_mask of every seed, why it counts as broken).
    pub levels: Vec<(usize, Vec<f64>, Option<String>)>,
}

impl Sweep {
    /// Runs what the log does not have: every level of ours, the easy case and the hardest level of
    /// the peers, then the peers where ours breaks first, and more seeds where anything does.
    pub fn run(&self, runner: &mut Runner) -> Result<Vec<Line>> {
        let (mut lines, mut trained) = (Vec::<Line>::new(), 0);
        let mut run = |lines: &mut Vec<Line>, (axis, level): (&Axis, usize), method: Method, seed| -> Result<()> {
            let point = axis.levels[level].point(axis, method, self.steps, seed);
            if method.has_field() && lines.iter().all(|l| l.point.job != point.job) {
                if trained >= self.max_runs {
                    return Ok(());
                }
                trained += 1;
            }
            if lines.iter().all(|l| l.point != point) {
                lines.extend(runner.run(point)?);
            }
            Ok(())
        };
        let axes = self.axes.iter();
        let places = axes.flat_map(|axis| (0..axis.levels.len()).map(move |level| (axis, level)));
        let places: Vec<(&Axis, usize)> = places.collect();
        for &place in &places {
            run(&mut lines, place, Method::Prior, 1)?;
            run(&mut lines, place, Method::Surface, 1)?;
        }
        for method in TRAINED {
            let is_end = |axis: &Axis, level: usize| axis.levels[level].easy || level + 1 == axis.levels.len();
            for &(axis, level) in places.iter().filter(|place| method == Method::Occnerf || is_end(place.0, place.1)) {
                run(&mut lines, (axis, level), method, 1)?;
            }
        }
        let broken = |lines: &[Line], method| -> Vec<(&Axis, usize)> {
            let first = |axis| course(axis, method, lines).levels.iter().find(|l| l.2.is_some()).map(|l| (axis, l.0));
            self.axes.iter().filter_map(first).collect()
        };
        for place in broken(&lines, Method::Occnerf) {
            for method in &TRAINED[1..] {
                run(&mut lines, place, *method, 1)?;
            }
        }
        for method in TRAINED.into_iter().filter(|_| !self.quick) {
            for place in broken(&lines, method) {
                for seed in SEEDS.skip(1) {
                    run(&mut lines, place, method, seed)?;
                }
            }
        }
        Ok(lines)
    }
}

/// What the log says of a method along an axis. Broken is a level with an error or anything not
/// finite, one that loses more than 3 dB against the easiest level measured, and, for what is
/// trained, one below the prior.
pub fn course(axis: &Axis, method: Method, lines: &[Line]) -> Course {
    let of = |level: usize, method: Method| {
        lines.iter().filter(move |l| {
            let point = &l.point;
            point.factor == axis.name && point.level == Some(axis.levels[level].value) && point.job.method == method
        })
    };
    let mean = |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
    let mut easiest = None;
    let mut levels = Vec::new();
    for level in 0..axis.levels.len() {
        let runs: Vec<&Line> = of(level, method).collect();
        if runs.is_empty() {
            continue;
        }
        let values: Vec<f64> = runs.iter().filter_map(|l| l.outcome.psnr_mask).collect();
        let value = mean(&values);
        let prior = of(level, Method::Prior).find_map(|l| l.outcome.psnr_mask);
        let failed = runs.iter().find_map(|l| l.outcome.error.clone());
        let odd: usize = runs.iter().map(|l| l.outcome.non_finite + l.outcome.bad_gradients).sum();
        let why = match (failed, value) {
            (Some(error), _) => Some(format!("failed: {error}")),
            _ if odd > 0 => Some(format!("{odd} numbers not finite")),
            (None, None) => Some("no score".to_owned()),
            (None, Some(value)) => {
                let below = prior.filter(|p| method != Method::Prior && value < *p);
                let lost = easiest.filter(|e| e - value > COLLAPSE);
                match (below, lost) {
                    (Some(prior), _) => Some(format!("{:.1} dB below the prior", prior - value)),
                    (_, Some(easiest)) => Some(format!("{:.1} dB below the easiest", easiest - value)),
                    _ => None,
                }
            }
        };
        easiest = easiest.or(value);
        levels.push((level, values, why));
    }
    Course { levels }
}

/// Breaking points as a Markdown table, a row an axis.
pub fn table(axes: &[Axis], lines: &[Line]) -> String {
    let mut text = String::from("| gets harder |");
    let methods = [&[Method::Prior, Method::Surface], &TRAINED[..]].concat();
    methods.iter().for_each(|m| text.push_str(&format!(" {} |", m.name())));
    text.push_str("\n| --- |");
    methods.iter().for_each(|_| text.push_str(" --- |"));
    for axis in axes {
        let name = |i: usize| format!("{}{}", xtask::scale::number(axis.levels[i].value), axis.unit);
        let all: Vec<String> = (0..axis.levels.len()).map(name).collect();
        let _ = write!(text, "\n| {}: {} |", axis.name, all.join(", "));
        for method in &methods {
            let course = course(axis, *method, lines);
            let score = |values: &[f64]| {
                let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
                match values.len() {
                    0 => "–".to_owned(),
                    1 => format!("{low:.1}"),
                    n => format!("{low:.1} to {high:.1} ({n} seeds)"),
                }
            };
            let cell = match (course.levels.iter().find(|l| l.2.is_some()), course.levels.last()) {
                (Some((level, values, Some(why))), _) => {
                    let before = course.levels.iter().take_while(|l| l.2.is_none()).last();
                    let before =
                        before.map_or(String::new(), |b| format!("holds at {} ({}), ", name(b.0), score(&b.1)));
                    format!("{before}**breaks at {}**: {why} ({})", name(*level), score(values))
                }
                (_, Some((level, values, _))) => format!("holds at {} ({})", name(*level), score(values)),
                _ => "not run".to_owned(),
            };
            let _ = write!(text, " {} |", cell.replace('|', "/"));
        }
    }
    text.push('\n');
    text
}

/// What was not finite anywhere, as one sentence.
pub fn finite(lines: &[Line]) -> String {
    let jobs: HashSet<String> = lines.iter().filter_map(|l| serde_json::to_string(&l.point.job).ok()).collect();
    let odd: Vec<String> = lines
        .iter()
        .filter(|l| l.outcome.error.is_some() || l.outcome.non_finite + l.outcome.bad_gradients > 0)
        .map(|l| {
            let Line { point, outcome } = l;
            let what = outcome.error.clone().unwrap_or_else(|| {
                format!("{} numbers and {} gradients not finite", outcome.non_finite, outcome.bad_gradients)
            });
            format!("{}, {}: {what}", point.name, point.job.method.name())
        })
        .collect();
    if odd.is_empty() {
        format!("{} runs: none failed, and every loss, gradient and pixel was finite.", jobs.len())
    } else {
        format!("{} runs, not all in order: {}.", jobs.len(), odd.join("; "))
    }
}

/// A panel an axis: psnr_mask of every method, breaking points crossed.
pub fn charts(scene: &str, axes: &[Axis], lines: &[Line], stem: &Path) -> Result<()> {
    let colors = [5, 2, 0, 4, 1];
    let methods = [&[Method::Prior, Method::Surface], &TRAINED[..]].concat().into_iter().zip(colors);
    let mut legend: Vec<(String, Style)> =
        methods.clone().map(|(m, color)| (m.name().to_owned(), Style(color, Shape::Circle))).collect();
    legend.push(("broken".to_owned(), Style(6, Shape::Cross)));
    let mut panels = Vec::new();
    for axis in axes {
        let mut panel = Panel {
            title: axis.name.to_owned(),
            labels: [axis.unit.trim().to_owned(), "psnr_mask, dB".to_owned()],
            scales: [
                chart::Axis::Names(axis.levels.iter().map(|l| xtask::scale::number(l.value)).collect()),
                chart::Axis::Names(Vec::new()),
            ],
            lines: Vec::new(),
            marks: Vec::new(),
        };
        for (method, color) in methods.clone() {
            let course = course(axis, method, lines);
            let middle = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
            let points = course.levels.iter().filter(|l| !l.1.is_empty());
            panel.lines.push(chart::Line { points: points.map(|(i, v, _)| (*i as f64, middle(v))).collect(), color });
            for (level, values, why) in &course.levels {
                let shape = if why.is_some() { Shape::Cross } else { Shape::Circle };
                let seeds = values.iter().map(|&v| ((*level as f64, v), Style(color, shape)));
                panel.marks.extend(seeds.map(|(at, style)| Mark { at, name: String::new(), style }));
            }
        }
        panel.scales[1] = chart::Axis::around(panel.marks.iter().map(|m| m.at.1), false);
        panels.push(panel);
    }
    let title = format!("{scene} as it gets harder, left to right: psnr_mask of unseen views");
    Picture { title, legend, columns: 3, size: (400, 270), panels }.write(stem).map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::axes;
    use crate::sweep::Outcome;

    /// Lines of a method along an axis with these scores, level by level.
    fn lines(axis: &Axis, method: Method, scores: &[Option<f64>]) -> Vec<Line> {
        let line = |(level, psnr_mask): (&axes::Level, &Option<f64>)| Line {
            point: level.point(axis, method, 10, 1),
            outcome: Outcome { psnr_mask: *psnr_mask, ..Outcome::default() },
        };
        axis.levels.iter().zip(scores).map(line).collect()
    }

    fn breaks(course: &Course) -> Option<usize> {
        course.levels.iter().find(|l| l.2.is_some()).map(|l| l.0)
    }

    #[test]
    fn a_method_breaks_below_the_prior_by_three_decibels_or_at_anything_not_finite() {
        let axis = axes::all(96, false).remove(0);
        let prior = lines(&axis, Method::Prior, &[Some(15.0), Some(15.0), Some(14.0), Some(10.0)]);
        let mut all = prior.clone();
        all.extend(lines(&axis, Method::Occnerf, &[Some(19.0), Some(18.0), Some(16.5), Some(15.5)]));
        all.extend(lines(&axis, Method::HashPoint, &[Some(16.0), Some(14.9), Some(14.5), Some(13.0)]));
        assert_eq!(breaks(&course(&axis, Method::Occnerf, &all)), Some(3));
        assert_eq!(breaks(&course(&axis, Method::HashPoint, &all)), Some(1));
        assert_eq!(breaks(&course(&axis, Method::Prior, &all)), Some(3));
        assert!(course(&axis, Method::Humannerf, &all).levels.is_empty());
        all[5].outcome.bad_gradients = 1;
        assert_eq!(breaks(&course(&axis, Method::Occnerf, &all)), Some(1));
        all[4].outcome.error = Some("a | b".to_owned());
        assert_eq!(breaks(&course(&axis, Method::Occnerf, &all)), Some(0));
        let table = table(&[axis], &all);
        assert!(table.contains("a / b") && table.contains("not run") && table.lines().count() == 3, "{table}");
        assert!(finite(&all).contains("not all in order") && finite(&prior).contains("every loss"));
    }
}
