//! `reproduce`: the paper's table, and others made in the same way, on somebody's data.

mod curves;
mod plan;
mod rows;
mod summary;

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use clap::Args;
use occnerf::{Lpips, Preset};
use synth::Perturbation;

use crate::results::{self, Section};
use crate::scene::{Corruption, SceneArguments, SceneOptions};
use plan::{Plan, Request};
use rows::{Row, Table};
use summary::Summary;
use xtask::list::unique_name;
use xtask::network::{load_lpips, network_name};
use xtask::optimise::SavingArguments;
use xtask::process::say;
use xtask::process::{Ending, Lock};
use xtask::run::{self, Metrics, RunConfig, make_directory};
use xtask::settings;
use xtask::shard::ShardArguments;
use xtask::source::{self, Source};
use xtask::train::{baked_unless_finished, finished};

#[derive(Args)]
pub struct ReproduceArguments {
    /// Captures, or demo [default: demo]
    scenes: Vec<String>,
    /// The body model of the captures [default: as in train]
    #[arg(long)]
    body: Option<PathBuf>,
    #[command(flatten)]
    load: SceneArguments,
    /// Directory of all runs and results
    #[arg(long, default_value = "runs/reproduce")]
    out: PathBuf,
    /// Minutes that everything may take; the number of steps follows from a measurement on this
    /// machine
    #[arg(long, default_value_t = 60.0)]
    budget: f64,
    /// Runs of each row, with seeds 1 to N; the table gives mean and standard deviation
    #[arg(long, default_value_t = 3, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Settings that every row starts from
    #[arg(long, default_value = "fast", value_parser = settings::preset())]
    preset: Preset,
    /// Steps of a row, in place of a budget
    #[arg(long)]
    steps: Option<u64>,
    /// Weights to measure LPIPS with, as in train
    #[arg(long, value_name = "PATH")]
    lpips: Option<PathBuf>,
    /// Weights that make the perceptual term of all rows LPIPS, as in train
    #[arg(long, value_name = "PATH")]
    perceptual_weights: Option<String>,
    /// Only these rows, comma separated, by the names of the table [default: all]
    #[arg(long, value_delimiter = ',', value_name = "ROW")]
    rows: Vec<String>,
    #[command(flatten)]
    saving: SavingArguments,
    #[command(flatten)]
    part: ShardArguments,
    /// How much wrong poses, shapes and masks cost: the main methods at each, one table
    #[arg(long)]
    robustness: bool,
    /// The way from the paper's text to the default instead, one change a row
    #[arg(long, conflicts_with_all = ["robustness", "components"])]
    story: bool,
    /// What each component is worth instead: each left out, from our start, a grey and a faint one
    #[arg(long, conflicts_with_all = ["robustness", "curves"])]
    components: bool,
    /// How good methods are after fewer and more steps, and at other rates, instead
    #[arg(long, conflicts_with_all = ["robustness", "story"])]
    curves: bool,
    /// Settings of the default instead, one changed a row, scored on every fifth training frame,
    /// from whose pixels nothing is learnt
    #[arg(long, conflicts_with_all = ["robustness", "story", "components", "curves"])]
    choices: bool,
    /// Make the tables a section of tests/lab/RESULTS.md, and that of the demo the table of README
    #[arg(long)]
    publish: bool,
}

/// A prior made wrong, and its directory.
const LEVELS: [(&str, Perturbation); 9] = {
    let none = Perturbation::NONE;
    [
        ("as-it-is", none),
        ("pose-2", Perturbation { pose_degrees: 2.0, ..none }),
        ("pose-5", Perturbation { pose_degrees: 5.0, ..none }),
        ("pose-10", Perturbation { pose_degrees: 10.0, ..none }),
        ("shape-1", Perturbation { shape: 1.0, ..none }),
        ("shape-2", Perturbation { shape: 2.0, ..none }),
        ("mask-minus-3", Perturbation { mask_pixels: -3, ..none }),
        ("mask-minus-1", Perturbation { mask_pixels: -1, ..none }),
        ("mask-plus-3", Perturbation { mask_pixels: 3, ..none }),
    ]
};
/// The methods themselves, each by its best pixel rule, and the baseline's own.
const MAIN: [&str; 5] = ["prior", "humannerf-style-bg", "humannerf-style", "hash-point", "occnerf"];

/// Runs the command.
pub fn reproduce(arguments: &ReproduceArguments) -> Result<()> {
    ensure!(arguments.budget > 0.0 && arguments.budget.is_finite(), "--budget: expected minutes above 0");
    let known = arguments.table().rows();
    for name in &arguments.rows {
        let names = known.iter().map(|row| &*row.name).collect::<Vec<_>>().join(", ");
        ensure!(known.iter().any(|row| row.name == *name), "--rows {name}: no such row; there are {names}");
    }
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    let demo = [source::DEMO.to_owned()];
    let scenes = if arguments.scenes.is_empty() { &demo[..] } else { &arguments.scenes };
    let minutes = arguments.budget / scenes.len() as f64;
    let runs = Runs::default();
    let rows = arguments.rows(|row| !arguments.robustness || MAIN.contains(&&*row.name));
    let levels = if arguments.robustness { LEVELS.len() } else { 1 };
    let each = levels * rows.iter().map(|row| row.runs(arguments.seeds) as usize).sum::<usize>();
    for (index, scene) in scenes.iter().enumerate() {
        // Of many jobs most have nothing to do with a scene, and need not load it.
        let first = runs.count.get();
        if arguments.part.shard.is_some_and(|shard| !(first..first + each).any(|run| shard.has(run))) {
            runs.count.set(first + each);
            continue;
        }
        say!("scene {} of {}: {scene}", index + 1, scenes.len());
        let directory = arguments.out.join(unique_name(scenes, index));
        let experiment = Experiment { arguments, lpips: lpips.as_ref(), scene, minutes, runs: &runs };
        if arguments.robustness {
            experiment.robustness(&directory.join("robustness"))?;
        } else {
            let table = arguments.table();
            let apart = if table == Table::Methods { directory } else { directory.join(table.name()) };
            experiment.table(&apart)?;
        }
    }
    let missing = runs.missing.into_inner();
    match missing.first() {
        Some(first) => {
            bail!(
                "{} of {} runs have no scores yet, such as {first}: run their parts again",
                missing.len(),
                runs.count.get()
            )
        }
        None => Ok(()),
    }
}

/// Runs met so far, over all scenes.
#[derive(Default)]
struct Runs {
    count: Cell<usize>,
    /// Those that a merge has found without scores.
    missing: RefCell<Vec<String>>,
}

/// What is asked for one scene.
struct Experiment<'a> {
    arguments: &'a ReproduceArguments,
    lpips: Option<&'a Lpips>,
    scene: &'a str,
    /// That everything may take.
    minutes: f64,
    runs: &'a Runs,
}

impl Experiment<'_> {
    fn plan(&self, directory: &Path, source: &Source, rows: &[Row], minutes: f64) -> Result<Plan> {
        let preset: Preset = self.arguments.preset;
        let request = Request {
            preset: preset.name().to_owned(),
            seeds: self.arguments.seeds,
            budget: self.arguments.steps.is_none().then_some(minutes),
            rows: rows.iter().map(|row| row.name.clone()).collect(),
            load: self.arguments.load.options()?,
            perceptual_weights: self.arguments.perceptual_weights.clone().unwrap_or_default(),
            lpips: network_name(self.lpips),
        };
        // The first of several jobs makes it, and the others wait.
        let _lock = Lock::wait(directory)?;
        match Plan::read(directory, &request, self.arguments.steps)? {
            Some(plan) => Ok(plan),
            None if self.arguments.part.merge => {
                bail!("{}: no part has begun with these arguments", directory.display())
            }
            None => Plan::make(directory, source, rows, request, preset, self.arguments.steps, self.lpips),
        }
    }

    fn load(&self, options: &SceneOptions) -> Result<Source> {
        options.load(self.scene, self.arguments.body.as_deref())
    }

    /// The table that is asked for.
    fn table(&self, directory: &Path) -> Result<()> {
        let options = self.arguments.load.options()?;
        let source = self.load(&options)?;
        make_directory(directory)?;
        let rows = self.arguments.rows(|_| true);
        let plan = self.plan(directory, &source, &rows, self.minutes)?;
        say!("{plan}");
        let summary = self.run_rows(&rows, &plan, (&source, options.corruption), directory)?;
        if !self.arguments.part.writes_tables() {
            return Ok(());
        }
        say!("\n{}", summary.markdown());
        if self.arguments.table() == Table::Curves {
            summary.chart(directory, Table::Curves.name())?;
        }
        for name in ["md", "json", "png"].map(|extension| directory.join(summary.file(extension))) {
            if name.is_file() {
                say!("written: {}", name.display());
            }
        }
        if self.arguments.publish {
            let (table, scene) = (self.arguments.table(), summary.name());
            let other = self.other();
            let title = format!("{} on {scene}{other}", table.title());
            let name = format!("{}-{scene}{}", table.name(), other.replace(" --", "-").replace(' ', "-"));
            let chart = [summary.chart(directory, &name)?];
            let body = summary.markdown();
            results::publish(&Section { name: &name, title: &title, body: &body, charts: &chart })?;
            // The one that everybody can make anew.
            if self.scene == source::DEMO && table == Table::Methods && other.is_empty() {
                let (set, table) = (results::set_of(&scene), summary.front());
                results::publish_table(&format!("{set}.\n\n{table}"))?;
            }
        }
        Ok(())
    }

    /// What sets this apart from the scene's main tables, as options.
    fn other(&self) -> String {
        let paper = if self.arguments.preset == Preset::Paper { " --preset paper" } else { "" };
        let lpips = if self.arguments.perceptual_weights.is_some() { " --perceptual-weights" } else { "" };
        format!("{paper}{lpips}{}", self.arguments.load.command_line())
    }

    /// The main rows at each level of wrongness.
    fn robustness(&self, directory: &Path) -> Result<()> {
        let options = self.arguments.load.options()?;
        ensure!(
            options.corruption.wrong == Perturbation::default(),
            "--robustness goes through its own errors: leave --wrong-… out"
        );
        let rows = self.arguments.rows(|row| MAIN.contains(&&*row.name));
        make_directory(directory)?;
        let mut plan = None;
        let mut levels = Vec::new();
        for (name, wrong) in LEVELS {
            say!("{name}");
            let corruption = Corruption { wrong, ..options.corruption };
            let source = self.load(&SceneOptions { corruption, ..options.clone() })?;
            let plan = match &mut plan {
                Some(plan) => plan,
                none => none.insert(self.plan(directory, &source, &rows, self.minutes / LEVELS.len() as f64)?),
            };
            say!("{plan}");
            let at = directory.join(name);
            make_directory(&at)?;
            levels.push((name, self.run_rows(&rows, plan, (&source, corruption), &at)?.scores()));
            if !self.arguments.part.writes_tables() {
                continue;
            }
            let text = summary::by_level(self.scene, &levels);
            run::write(&directory.join("robustness.md"), &text)?;
            run::write(&directory.join("robustness.json"), &serde_json::to_string_pretty(&levels)?)?;
        }
        if !self.arguments.part.writes_tables() {
            return Ok(());
        }
        say!("\n{}", summary::by_level(self.scene, &levels));
        say!("written: {}", directory.join("robustness.md").display());
        if self.arguments.publish {
            let scene = xtask::train::scene_name(Some(self.scene));
            let (name, title) = (format!("robustness-{scene}"), format!("A wrong prior on {scene}"));
            let body = format!("{}.\n\n{}", results::set_of(&scene), summary::by_level(&scene, &levels));
            results::publish(&Section { name: &name, title: &title, body: &body, charts: &[] })?;
        }
        Ok(())
    }

    /// Trains and scores every row that is not finished, with all its seeds.
    fn run_rows<'a>(
        &self,
        rows: &[Row],
        plan: &'a Plan,
        (source, corruption): (&'a Source, Corruption),
        directory: &Path,
    ) -> Result<Summary<'a>> {
        let mut summary = Summary::new(source, plan, self.arguments.table());
        let mut first = BTreeMap::new();
        for row in rows {
            let own = self.runs.count.get();
            first.insert(&*row.name, own);
            // Who trains a person bakes them.
            let begin = row.baked.and_then(|trained| first.get(trained)).map_or(own, |&index| index);
            for seed in 1..=row.runs(self.arguments.seeds) {
                let mut run = RunConfig::new(source, plan.config(row, self.arguments.preset, seed)?);
                if let Some(path) = &self.arguments.perceptual_weights {
                    run.train.loss.perceptual_weights.clone_from(path);
                }
                self.runs.count.set(self.runs.count.get() + 1);
                let job = Job { index: begin + seed as usize - 1, row, seed, run, corruption };
                if let Some(metrics) = self.run(directory, &job, source)? {
                    summary.add(row, &directory.join(row.run(seed)), metrics);
                }
            }
            // After every row, so that an end before the last leaves a table.
            if self.arguments.part.writes_tables() {
                summary.write(directory)?;
            }
        }
        Ok(summary)
    }
}

/// A run of a row.
struct Job<'a> {
    /// The part that does it is chosen by this.
    index: usize,
    row: &'a Row,
    seed: u64,
    run: RunConfig,
    corruption: Corruption,
}

impl Experiment<'_> {
    /// The scores of a run under `directory`; `None` where it is not this job's, or a merge does
    /// not find it.
    fn run(&self, directory: &Path, job: &Job<'_>, source: &Source) -> Result<Option<Metrics>> {
        let Job { index, row, seed, run, corruption } = job;
        let name = &row.run(*seed);
        let trained = row.trained(*seed).map(|trained| directory.join(trained));
        let (directory, part) = (&directory.join(name), self.arguments.part);
        if part.merge {
            let metrics = finished(directory, &run.train)?;
            if metrics.is_none() {
                self.runs.missing.borrow_mut().push(directory.display().to_string());
            }
            return Ok(metrics);
        }
        if part.shard.is_some_and(|shard| !shard.has(*index)) {
            return Ok(None);
        }
        let interval = self.arguments.saving.interval()?;
        for run in trained.iter().chain([directory]) {
            make_directory(run)?;
            corruption.keep(run)?;
        }
        let scored = match &trained {
            Some(trained) => baked_unless_finished(directory, trained, run, source, self.lpips, interval),
            None => row.method.run_unless_finished(directory, name, run, source, self.lpips, interval),
        };
        match scored {
            Err(error) if part.shard.is_some() && matches!(error.downcast_ref(), Some(Ending::Busy(_))) => {
                say!("{name}: in another job");
                Ok(None)
            }
            other => other.map(Some),
        }
    }
}

impl ReproduceArguments {
    fn table(&self) -> Table {
        let asked = [
            (self.story, Table::Story),
            (self.components, Table::Components),
            (self.curves, Table::Curves),
            (self.choices, Table::Choices),
        ];
        asked.into_iter().find(|(asked, _)| *asked).map_or(Table::Methods, |(_, table)| table)
    }

    fn rows(&self, wanted: impl Fn(&Row) -> bool) -> Vec<Row> {
        let kept = |row: &Row| (self.rows.is_empty() || self.rows.contains(&row.name)) && wanted(row);
        self.table().rows().into_iter().filter(kept).collect()
    }
}
