//! `bench`: what every approximation costs and is worth, and where methods break.

mod axes;
pub mod chart;
mod difficulty;
mod kernels;
mod pareto;
mod points;
mod stability;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use clap::{Args, Subcommand};

pub use self::difficulty::Difficulty;
use crate::results::{self, Section};
use crate::sweep::{Captures, Line, Runner, SittingArguments, job};
use xtask::network::load_lpips;
use xtask::process::say;
use xtask::run::{use_threads, write};
use xtask::{source, train};

/// Unseen views that a point of `pareto` is scored on, and in the quick form.
const VIEWS: (usize, usize) = (50, 20);

#[derive(Args)]
pub struct BenchArguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Seconds against accuracy of every named approximation, each preset and each method: a table
    /// and charts.
    Pareto(Box<ParetoArguments>),
    /// What happens to the demo as it gets hard: less to see, worse poses, shorter videos, …; a
    /// table of breaking points and charts.
    Stability(StabilityArguments),
    /// Cost against error of the geometric kernels.
    Kernels {
        /// Where to write
        #[arg(long, default_value = "runs/bench-kernels")]
        out: PathBuf,
        /// Fewer queries
        #[arg(long)]
        quick: bool,
        /// Make what is found a section of tests/lab/RESULTS.md
        #[arg(long)]
        publish: bool,
    },
    /// One run, handed over on standard input.
    #[command(hide = true)]
    Point {
        #[arg(long)]
        threads: Option<usize>,
    },
}

/// Options of every sweep.
#[derive(Args)]
struct SweepArguments {
    /// Output directory; runs already in it are kept [default: runs/bench-NAME]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Fewer points and fewer steps: about 10 minutes on 2 cores
    #[arg(long)]
    quick: bool,
    /// Steps of each run [default: 400, quick: 80; stability: 200, quick: 100]; presets of pareto
    /// run their own number at 400 and in proportion otherwise
    #[arg(long)]
    steps: Option<u64>,
    #[command(flatten)]
    sitting: SittingArguments,
}

#[derive(Args)]
struct ParetoArguments {
    #[command(flatten)]
    on: Captures,
    #[command(flatten)]
    sweep: SweepArguments,
    /// Weights to score LPIPS with, as for `train`
    #[arg(long, value_name = "PATH")]
    lpips: Option<PathBuf>,
}

#[derive(Args)]
struct StabilityArguments {
    #[command(flatten)]
    sweep: SweepArguments,
    /// Only these axes, comma separated, such as hidden,"pose noise" [default: all]
    #[arg(long, value_delimiter = ',')]
    axes: Vec<String>,
    /// Pixels a side of the pictures, 64 to 512 for figures that mean something
    #[arg(long, default_value_t = 96)]
    side: u32,
    /// Trained runs at most; those of more seeds are left out first
    #[arg(long, default_value_t = 60)]
    max_runs: usize,
}

/// Runs the command.
pub fn bench(arguments: &BenchArguments) -> Result<()> {
    match &arguments.what {
        What::Pareto(arguments) => pareto(arguments),
        What::Stability(arguments) => stability(arguments),
        What::Kernels { out, quick, publish } => kernels::run(out, *quick, *publish),
        What::Point { threads } => {
            use_threads(*threads)?;
            job::serve()
        }
    }
}

impl SweepArguments {
    fn out(&self, name: &str) -> PathBuf {
        self.out.clone().unwrap_or_else(|| Path::new("runs").join(format!("bench-{name}")))
    }

    fn steps(&self, usual: u64, quick: u64) -> Result<u64> {
        let steps = self.steps.unwrap_or(if self.quick { quick } else { usual });
        ensure!((1..=1_000_000).contains(&steps), "--steps {steps}: expected 1 to 1000000");
        Ok(steps)
    }

    /// Runs `run` on each of `scenes`, then `draw`, which gets the stem of its charts and returns a
    /// section of the table; prints, writes and publishes the table.
    fn sweep(
        &self,
        [name, title]: [&str; 2],
        scenes: &[String],
        run: impl Fn(&str, &mut Runner) -> Result<Vec<Line>>,
        draw: impl Fn(&str, &[Line], &Path) -> Result<String>,
    ) -> Result<()> {
        let out = self.out(name);
        let mut runner = self.sitting.open(&out)?;
        let mut text = String::new();
        for scene in scenes {
            let lines = run(scene, &mut runner)?;
            if self.sitting.part.writes_tables() {
                let short = train::scene_name(Some(scene));
                let section = draw(&short, &lines, &out.join(format!("{name}-{short}")))?;
                text.push_str(&format!("## {scene}\n\n{}.\n\n{section}\n", results::set_of(&short)));
            }
        }
        let SittingArguments { part, publish, .. } = &self.sitting;
        if part.writes_tables() {
            let path = out.join(format!("{name}.md"));
            write(&path, &text)?;
            say!("\n{text}\nwritten: {}\nwritten: {}", runner.path().display(), path.display());
        }
        runner.end(part)?;
        if *publish && part.writes_tables() {
            let charts = results::charts(&out, name)?;
            results::publish(&Section { name, title, body: &text, charts: &charts })?;
        }
        Ok(())
    }
}

fn pareto(ParetoArguments { on, sweep, lpips }: &ParetoArguments) -> Result<()> {
    load_lpips(lpips.as_deref())?;
    let (quick, steps) = (sweep.quick, sweep.steps(points::FULL_STEPS, points::FULL_STEPS / 5)?);
    let views = if quick { VIEWS.1 } else { VIEWS.0 };
    let run = |scene: &str, runner: &mut Runner| {
        let (scene_arguments, place) = (on.command_line(scene), on.place(scene)?);
        let around = points::Sweep { scene_arguments, place, views, steps, quick, lpips: lpips.clone() };
        runner.run_all(around.points()?)
    };
    sweep.sweep(["pareto", "Speed against accuracy"], &on.checked()?, run, |name, lines, stem| {
        pareto::charts(name, lines, stem)?;
        Ok(pareto::table(lines))
    })
}

fn stability(StabilityArguments { sweep, axes: wanted, side, max_runs }: &StabilityArguments) -> Result<()> {
    let (quick, steps) = (sweep.quick, sweep.steps(200, 100)?);
    ensure!((16..=2048).contains(side), "--side {side}: expected 16 to 2048");
    let mut axes = axes::all(*side, quick);
    let known = axes.iter().map(|a| a.name).collect::<Vec<_>>().join(", ");
    if let Some(unknown) = wanted.iter().find(|name| axes.iter().all(|a| a.name != name.trim())) {
        bail!("--axes {unknown}: there are {known}");
    }
    axes.retain(|axis| wanted.is_empty() || wanted.iter().any(|name| name.trim() == axis.name));
    let hard = stability::Sweep { axes, steps, quick, max_runs: *max_runs };
    let run = |_: &str, runner: &mut Runner| hard.run(runner);
    sweep.sweep(["stability", "Where methods break"], &[source::DEMO.to_owned()], run, |name, lines, stem| {
        stability::charts(name, &hard.axes, lines, stem)?;
        Ok(format!("{}\n{}\n", stability::table(&hard.axes, lines), stability::finite(lines)))
    })
}
