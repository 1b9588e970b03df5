//! `bench`: what every approximation costs and is worth, and where methods break.

mod axes;
pub mod chart;
mod difficulty;
mod front;
mod kernels;
mod pareto;
mod points;
mod stability;
mod triangles;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use clap::{Args, Subcommand};
use occnerf::capture::Layout;

pub use self::difficulty::Difficulty;
use crate::results::{self, Section};
use crate::sweep::{Line, Place, Runner, SittingArguments, job};
use xtask::network::load_lpips;
use xtask::process::say;
use xtask::run::{use_threads, write};
use xtask::{source, train};

/// Steps of a point of `pareto` at which presets run their own number of steps: those of `fast`.
const FULL_STEPS: u64 = 400;
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
    Pareto(ParetoArguments),
    /// What happens as it gets hard: less to see, worse poses, shorter videos, …; a table of breaking
    /// points and charts.
    Stability(StabilityArguments),
    /// Cost against error of the geometric kernels.
    Kernels(KernelArguments),
    /// Size against accuracy of a run's avatar with fewer triangles, its texture as PNG and JPEG: a
    /// table and a chart.
    Triangles {
        /// Run directory, of a surface or baked
        run: PathBuf,
        /// Where to write
        #[arg(long, default_value = "runs/bench-triangles")]
        out: PathBuf,
    },
    /// One run, handed over on standard input.
    #[command(hide = true)]
    Point {
        #[arg(long)]
        threads: Option<usize>,
    },
}

/// What a sweep over captures is run on.
#[derive(Args)]
struct SceneArguments {
    /// Captures, as `train` takes them [default: the demo]
    scenes: Vec<String>,
    /// The body model of the captures
    #[arg(long)]
    body: Option<PathBuf>,
    #[command(flatten)]
    load: crate::scene::SceneArguments,
}

/// What a sweep is, and where it goes.
#[derive(Args)]
struct SweepArguments {
    #[command(flatten)]
    on: SceneArguments,
    /// Where to write; what is there is not run again [default: runs/bench-NAME]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Fewer points and fewer steps: about 10 minutes on 2 cores
    #[arg(long)]
    quick: bool,
    /// Steps of each run [default: 400, quick: 80; stability: 200, quick: 100]; presets of pareto run
    /// their own number at 400 and in proportion otherwise
    #[arg(long)]
    steps: Option<u64>,
    #[command(flatten)]
    sitting: SittingArguments,
}

#[derive(Args)]
struct ParetoArguments {
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
    /// Pixels a side of the pictures, 64 to 512 for figures that mean something; of captures, where
    /// --resize is not given
    #[arg(long, default_value_t = 96)]
    side: u32,
    /// Trained runs at most of each scene; those of more seeds are left out first
    #[arg(long, default_value_t = 60)]
    max_runs: usize,
}

#[derive(Args)]
struct KernelArguments {
    /// Where to write
    #[arg(long, default_value = "runs/bench-kernels")]
    out: PathBuf,
    /// Fewer queries
    #[arg(long)]
    quick: bool,
    /// Make what is found a section of tests/lab/RESULTS.md
    #[arg(long)]
    publish: bool,
}

/// Runs the command.
pub fn bench(arguments: &BenchArguments) -> Result<()> {
    match &arguments.what {
        What::Pareto(arguments) => pareto(arguments),
        What::Stability(arguments) => stability(arguments),
        What::Kernels(arguments) => kernels::run(&arguments.out, arguments.quick, arguments.publish),
        What::Triangles { run, out } => triangles::run(run, out),
        What::Point { threads } => {
            use_threads(*threads)?;
            job::serve()
        }
    }
}

impl SceneArguments {
    /// The scenes; what is wrong with a capture is said before anything is run.
    fn checked(&self) -> Result<Vec<String>> {
        let scenes = if self.scenes.is_empty() { vec![source::DEMO.to_owned()] } else { self.scenes.clone() };
        for scene in scenes.iter().filter(|s| *s != source::DEMO || !self.load.command_line().is_empty()) {
            self.load.options()?.load(scene, self.body.as_deref())?;
        }
        Ok(scenes)
    }

    /// What `bench stability` does to a scene.
    fn axes(&self, scene: &str, side: u32, quick: bool) -> Result<Vec<axes::Axis>> {
        if scene == source::DEMO {
            ensure!(self.load.command_line().is_empty(), "bench stability makes its own demo, without options");
            return Ok(axes::of_demo(side, quick));
        }
        ensure!(Path::new(scene).is_dir(), "{scene}: expected the demo, or a capture on disk (synth makes one)");
        // The one layout that leaves open what hides the person.
        let obstacle = Layout::detect(Path::new(scene))? == Layout::ZjuMocap;
        Ok(axes::of_capture(&self.place(scene)?, side, obstacle, quick))
    }

    fn place(&self, scene: &str) -> Result<Place> {
        let load = self.load.options()?.identified(scene, self.body.as_deref())?;
        Ok(Place::Scene { scene: scene.to_owned(), body: self.body.clone(), load })
    }

    /// What makes `train` read the same capture.
    fn command_line(&self, scene: &str) -> String {
        let mut text = if scene == source::DEMO { String::new() } else { format!(" {scene}") };
        if let Some(body) = &self.body {
            text.push_str(&format!(" --body {}", body.display()));
        }
        text + &self.load.command_line()
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
    fn sweep<S>(
        &self,
        [name, title]: [&str; 2],
        scenes: &[(String, S)],
        run: impl Fn(&str, &S, &mut Runner) -> Result<Vec<Line>>,
        draw: impl Fn(&str, &S, &[Line], &Path) -> Result<String>,
    ) -> Result<()> {
        let out = self.out(name);
        let mut runner = self.sitting.open(&out)?;
        let mut text = String::new();
        for (scene, of_scene) in scenes {
            let lines = run(scene, of_scene, &mut runner)?;
            if self.sitting.part.writes_tables() {
                let short = train::scene_name(Some(scene));
                let section = draw(&short, of_scene, &lines, &out.join(format!("{name}-{short}")))?;
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

fn pareto(ParetoArguments { sweep, lpips }: &ParetoArguments) -> Result<()> {
    load_lpips(lpips.as_deref())?;
    let (quick, steps) = (sweep.quick, sweep.steps(FULL_STEPS, FULL_STEPS / 5)?);
    let views = if quick { VIEWS.1 } else { VIEWS.0 };
    let scenes: Vec<(String, ())> = sweep.on.checked()?.into_iter().map(|scene| (scene, ())).collect();
    let run = |scene: &str, _: &(), runner: &mut Runner| {
        let (scene_arguments, place) = (sweep.on.command_line(scene), sweep.on.place(scene)?);
        let around =
            points::Sweep { scene_arguments, place, views, steps, full_steps: FULL_STEPS, quick, lpips: lpips.clone() };
        runner.run_all(around.points()?)
    };
    sweep.sweep(["pareto", "Speed against accuracy"], &scenes, run, |name, _, lines, stem| {
        pareto::charts(name, lines, &pareto::COSTS, stem)?;
        Ok(pareto::table(lines, pareto::COSTS[0]))
    })
}

fn stability(arguments: &StabilityArguments) -> Result<()> {
    let StabilityArguments { sweep, side, max_runs, .. } = arguments;
    let (quick, steps) = (sweep.quick, sweep.steps(200, 100)?);
    ensure!((16..=2048).contains(side), "--side {side}: expected 16 to 2048");
    let mut of_scenes = Vec::new();
    for scene in sweep.on.checked()? {
        let mut axes = sweep.on.axes(&scene, *side, quick)?;
        if !arguments.axes.is_empty() {
            let known = axes.iter().map(|a| a.name).collect::<Vec<_>>().join(", ");
            if let Some(unknown) = arguments.axes.iter().find(|name| axes.iter().all(|a| a.name != name.trim())) {
                bail!("--axes {unknown}: of {scene} there are {known}");
            }
            axes.retain(|axis| arguments.axes.iter().any(|name| name.trim() == axis.name));
        }
        of_scenes.push((scene, stability::Sweep { axes, steps, quick, max_runs: *max_runs }));
    }
    let run = |_: &str, of_scene: &stability::Sweep, runner: &mut Runner| of_scene.run(runner);
    sweep.sweep(["stability", "Where methods break"], &of_scenes, run, |name, of_scene, lines, stem| {
        stability::charts(name, &of_scene.axes, lines, stem)?;
        Ok(format!("{}\n{}\n", stability::table(&of_scene.axes, lines), stability::finite(lines)))
    })
}
