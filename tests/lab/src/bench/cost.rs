//! `bench cost`: what a training step costs, and how time and memory grow with the work.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Result, bail};
use occnerf::{Config, Preset};
use synth::DemoConfig;

use super::chart::{Axis, Line, Mark, Panel, Picture, Shape, Style};
use super::difficulty::Difficulty;
use crate::methods::Method;
use crate::sweep::{Job, Kind, Place, Point, Runner};
use xtask::scale::number;

/// Steps of each run; the median is over the second half, when buffers have grown to size.
const STEPS: u64 = 10;

/// A quantity that is doubled again and again.
struct Growth {
    name: &'static str,
    levels: &'static [f64],
    set: fn(&mut Config, &mut Difficulty, f64),
}

/// Around the preset `fast` on a demo of few frames.
const GROWTHS: [Growth; 6] = [
    Growth {
        name: "rays a step",
        levels: &[1024.0, 2048.0, 4096.0, 8192.0, 16384.0],
        set: |c, _, l| c.patches = l as usize / 1024,
    },
    Growth { name: "samples a ray", levels: &[24.0, 48.0, 96.0, 192.0, 384.0], set: |c, _, l| c.samples = l as usize },
    Growth {
        name: "million parameters",
        levels: &[14.0, 16.0, 18.0, 20.0],
        set: |c, _, l| (c.encoding.log2_table_size, c.encoding.n_max) = (l as u32, 2048),
    },
    Growth { name: "vertices", levels: &[0.0, 1.0, 2.0], set: |_, d, l| d.refined = l as u32 },
    Growth {
        name: "frames",
        levels: &[10.0, 100.0, 1000.0, 3000.0],
        set: |_, d, l| (d.demo.size, d.demo.frames, d.demo.eval_every) = (64, l as usize, l as usize),
    },
    Growth {
        // The last has as many as 1920 × 1080.
        name: "pixels of a frame",
        levels: &[128.0, 256.0, 512.0, 1024.0, 1440.0],
        set: |_, d, l| d.demo.size = l as u32,
    },
];

/// Runs everything, writes cost.md, growth.svg and growth.png.
pub fn run(runner: &mut Runner, out: &Path) -> Result<String> {
    let mut text = String::from(
        "| preset | s a step | live samples | ns a live sample | MB |\n| --- | ---: | ---: | ---: | ---: |\n",
    );
    // `fast` is `balanced` with fewer steps.
    for preset in [Preset::Balanced, Preset::Paper] {
        text.push_str(&row(preset, runner)?);
    }
    text.push('\n');
    let mut panels = Vec::new();
    let mut table = String::from(
        "Seconds to make a capture ready, to take a step and to draw a view; behind each the power of the level that it \
         grew with since the line before.\n\n\
         | what grows | level | ready s | | step s | | drawn s | | MB | samples |\n\
         | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |\n",
    );
    for growth in &GROWTHS {
        panels.extend(grow(growth, runner, &mut table)?);
    }
    let linear = ("linear".to_owned(), Style(5, Shape::Dash));
    let picture = Picture {
        title: "Time and memory as the work grows".to_owned(),
        legend: TIMES
            .iter()
            .map(|(name, color)| ((*name).to_owned(), Style(*color, Shape::Circle)))
            .chain([linear])
            .collect(),
        columns: 4,
        size: (330, 280),
        panels,
    };
    picture.write(&out.join("growth"))?;
    let _ = write!(text, "{table}");
    Ok(text)
}

fn point(name: String, factor: &str, config: Config, difficulty: Difficulty) -> Point {
    let job = Job::new(Place::Made(difficulty), 1, Method::Occnerf, config);
    Point {
        bench: "cost".to_owned(),
        name,
        factor: factor.to_owned(),
        level: None,
        kind: Kind::Level,
        command: None,
        job,
    }
}

fn small() -> Difficulty {
    let demo = DemoConfig { frames: 12, eval_cameras: 1, eval_every: 12, ..DemoConfig::default() };
    Difficulty { demo, ..Difficulty::default() }
}

/// Row of a preset.
fn row(preset: Preset, runner: &mut Runner) -> Result<String> {
    let config = Config { steps: STEPS, ..Method::Occnerf.preset(preset) };
    let Some(line) = runner.run(point(preset.name().to_owned(), "profile", config, small()))? else {
        return Ok(String::new());
    };
    let outcome = &line.outcome;
    if let Some(error) = &outcome.error {
        bail!("{}: {error}", preset.name());
    }
    let (step, live) = (outcome.step_seconds, outcome.live_samples);
    let (each, megabytes) = (1e9 * step / live, outcome.peak_rss_bytes as f64 / 1e6);
    Ok(format!("| `{}` | {step:.3} | {live:.0} | {each:.0} | {megabytes:.0} |\n", preset.name()))
}

/// What is timed, and its colour.
const TIMES: [(&str, usize); 3] = [("a step, or memory", 0), ("making ready", 1), ("drawing a view", 2)];

/// Two panels, time and memory, and rows of the table.
fn grow(growth: &Growth, runner: &mut Runner, table: &mut String) -> Result<Vec<Panel>> {
    let (mut times, mut memory): ([Vec<(f64, f64)>; 3], _) = (Default::default(), Vec::new());
    for &level in growth.levels {
        let (mut config, mut difficulty) = (Method::Occnerf.preset(Preset::Fast), small());
        config.steps = STEPS;
        (growth.set)(&mut config, &mut difficulty, level);
        let Some(line) = runner.run(point(format!("{} {level}", growth.name), growth.name, config, difficulty))? else {
            continue;
        };
        let outcome = &line.outcome;
        if let Some(error) = &outcome.error {
            bail!("{} {level}: {error}", growth.name);
        }
        let at = match growth.name {
            "vertices" => outcome.vertices as f64,
            "million parameters" => 1e-6 * outcome.parameters as f64,
            "pixels of a frame" => level * level,
            _ => level,
        };
        let megabytes = outcome.peak_rss_bytes as f64 / 1e6;
        let _ = write!(table, "| {} | {} |", growth.name, number(at));
        let seconds = [outcome.step_seconds, outcome.prepare_seconds, outcome.seconds_per_frame];
        for (course, seconds) in times.iter_mut().zip(seconds) {
            course.push((at, seconds));
        }
        for i in [1, 0, 2] {
            let exponent = match times[i].as_slice() {
                [.., a, b] => format!("{:.2}", (b.1 / a.1).ln() / (b.0 / a.0).ln()),
                _ => String::new(),
            };
            let _ = write!(table, " {:.3} | {exponent} |", seconds[i]);
        }
        let _ = writeln!(table, " {megabytes:.0} | {:.0} |", outcome.live_samples);
        memory.push((at, megabytes));
    }
    let panel = |what: &str, courses: &[Vec<(f64, f64)>]| {
        // Through the last point, so that what grows faster than linearly lies below it before.
        let linear =
            courses[0].last().map_or(Vec::new(), |end| courses[0].iter().map(|p| (p.0, end.1 * p.0 / end.0)).collect());
        let all = || courses.iter().flatten();
        let mut lines = vec![Line { points: linear, color: 5 }];
        let mut marks = Vec::new();
        for (course, (_, color)) in courses.iter().zip(TIMES) {
            lines.push(Line { points: course.clone(), color });
            let style = Style(color, Shape::Circle);
            marks.extend(course.iter().map(|&at| Mark { at, name: String::new(), style }));
        }
        Panel {
            title: format!("{what} against {}", growth.name),
            labels: [growth.name.to_owned(), what.to_owned()],
            scales: [Axis::around(all().map(|p| p.0), true), Axis::around(all().map(|p| p.1), true)],
            lines,
            marks,
        }
    };
    Ok(vec![panel("seconds", &times), panel("MB", &[memory])])
}
