//! `reproduce`: the paper's table, and others made in the same way, on a user's data.

mod rows;
mod summary;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use clap::Args;
use occnerf::{Config, Preset};

use crate::results::{self, Section};
use crate::scene::{SceneArguments, SceneOptions};
use crate::sweep::{Job, Keep, Kind, Place, Point, Runner, SittingArguments};
use rows::{Row, Table};
use summary::Summary;
use xtask::list::unique_name;
use xtask::network::load_lpips;
use xtask::process::say;
use xtask::run::make_directory;
use xtask::settings;
use xtask::source;
use xtask::train::scene_name;

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
    /// Runs of each row, with seeds 1 to N; the table gives mean and standard deviation
    #[arg(long, default_value_t = 3, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Settings that every row starts from
    #[arg(long, default_value = "fast", value_parser = settings::preset())]
    preset: Preset,
    /// Steps of a row [default: the preset's]
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
    /// The way from the paper's text to the default instead, one change a row
    #[arg(long, group = "table")]
    story: bool,
    /// What each component is worth instead: each left out, from our start, a grey and a faint one
    #[arg(long, group = "table")]
    components: bool,
    /// Settings of the default instead, one changed a row, scored on every fifth training frame,
    /// from whose pixels nothing is learnt
    #[arg(long, group = "table")]
    choices: bool,
    #[command(flatten)]
    sitting: SittingArguments,
}

/// Runs the command.
pub fn reproduce(arguments: &ReproduceArguments) -> Result<()> {
    let ReproduceArguments { sitting, .. } = arguments;
    let (table, rows, load) = (arguments.table(), arguments.rows()?, arguments.load.options()?);
    let steps = arguments.steps.unwrap_or(Config::preset(arguments.preset, occnerf::Method::Occnerf).steps);
    let settings = format!("preset {}, {steps} steps a run, {} seeds", arguments.preset.name(), arguments.seeds);
    let demo = [source::DEMO.to_owned()];
    let scenes = if arguments.scenes.is_empty() { &demo[..] } else { &arguments.scenes };
    // Bad input leaves nothing behind. A part need not load all scenes.
    load_lpips(arguments.lpips.as_deref())?;
    if sitting.part.writes_tables() && !sitting.part.merge {
        scenes.iter().try_for_each(|scene| load.load(scene, arguments.body.as_deref()).map(drop))?;
    }
    let mut runner = sitting.open(&arguments.out)?;
    let (mut turn, mut failed) = (0, Vec::new());
    for (index, scene) in scenes.iter().enumerate() {
        let directory = arguments.out.join(unique_name(scenes, index));
        let directory = if table == Table::Methods { directory } else { directory.join(table.name()) };
        let mut experiment =
            Experiment { arguments, table, rows: &rows, scene, steps, settings: &settings, turn, failed };
        experiment.run(&mut runner, &load, &directory)?;
        (turn, failed) = (experiment.turn, experiment.failed);
    }
    runner.end(&sitting.part)?;
    match failed.first() {
        Some(first) => bail!("{} runs failed, such as {first}", failed.len()),
        None => Ok(()),
    }
}

/// A table of one scene.
struct Experiment<'a> {
    arguments: &'a ReproduceArguments,
    table: Table,
    rows: &'a [Row],
    scene: &'a str,
    steps: u64,
    settings: &'a str,
    /// Runs of all scenes so far.
    turn: usize,
    /// Runs of all scenes that failed, and why.
    failed: Vec<String>,
}

impl<'a> Experiment<'a> {
    /// Runs what is left, and makes the table.
    fn run(&mut self, runner: &mut Runner, load: &SceneOptions, directory: &Path) -> Result<()> {
        let (table, sitting) = (self.table, &self.arguments.sitting);
        let summary = self.run_rows(runner, load.clone(), directory)?;
        if !sitting.part.writes_tables() {
            return Ok(());
        }
        let name = scene_name(Some(self.scene));
        say!("\n{}", summary.markdown());
        for name in ["md", "json", "png"].map(|extension| directory.join(summary.file(extension))) {
            if name.is_file() {
                say!("written: {}", name.display());
            }
        }
        if sitting.publish {
            let chart = summary.chart(directory, &self.section())?;
            self.publish(&summary.markdown(), &[chart])?;
            // The one that everybody can reproduce.
            if self.scene == source::DEMO && table == Table::Methods && self.other().is_empty() {
                results::publish_table(&format!("{}.\n\n{}", results::set_of(&name), summary.front()))?;
            }
        }
        Ok(())
    }

    /// Trains and scores every row that is not finished, with all its seeds.
    fn run_rows(&mut self, runner: &mut Runner, load: SceneOptions, directory: &Path) -> Result<Summary<'a>> {
        let ReproduceArguments { body, seeds, preset, lpips, .. } = self.arguments;
        let load = load.identified(self.scene, body.as_deref())?;
        let tables = self.arguments.sitting.part.writes_tables();
        let mut summary = Summary::new(self.scene, self.settings, self.table);
        let mut firsts: Vec<(&str, usize)> = Vec::new();
        for row in self.rows {
            // Who trains a person bakes them.
            let trained = firsts.iter().find(|first| row.baked == Some(first.0));
            let first = trained.map_or(self.turn, |first| first.1);
            firsts.push((&row.name, self.turn));
            for seed in 1..=row.runs(*seeds) {
                let mut config = row.config(*preset, self.steps, seed)?;
                if let Some(path) = &self.arguments.perceptual_weights {
                    config.loss.perceptual_weights.clone_from(path);
                }
                let keep = Keep {
                    directory: directory.join(row.run(seed)),
                    trained: row.baked.map(|row| directory.join(format!("{row}-s{seed}"))),
                    lpips: lpips.clone(),
                };
                let place = Place::Scene { scene: self.scene.to_owned(), body: body.clone(), load: load.clone() };
                let point = Point {
                    bench: self.table.name().to_owned(),
                    name: row.run(seed),
                    factor: "as-it-is".to_owned(),
                    level: None,
                    kind: Kind::Row,
                    command: None,
                    job: Job { keep: Some(keep), ..Job::new(place, usize::MAX, row.method, config) },
                };
                let line = runner.run_turn(first + seed as usize - 1, point)?;
                self.turn += 1;
                let Some(line) = line else { continue };
                match (line.outcome.metrics, line.outcome.error) {
                    (Some(metrics), None) => summary.add(row, &directory.join(row.run(seed)), metrics),
                    (_, error) => {
                        let what = directory.join(row.run(seed));
                        self.failed.push(format!("{}: {}", what.display(), error.unwrap_or_default()));
                    }
                }
            }
            // After every row, so that an end before the last leaves a table.
            if tables {
                make_directory(directory)?;
                summary.write(directory)?;
            }
        }
        Ok(summary)
    }

    /// Options that set this apart from the scene's main tables.
    fn other(&self) -> String {
        let paper = if self.arguments.preset == Preset::Paper { " --preset paper" } else { "" };
        let lpips = if self.arguments.perceptual_weights.is_some() { " --perceptual-weights" } else { "" };
        format!("{paper}{lpips}{}", self.arguments.load.command_line())
    }

    /// Name of the section of the results.
    fn section(&self) -> String {
        let other = self.other().replace(" --", "-").replace(' ', "-");
        format!("{}-{}{other}", self.table.name(), scene_name(Some(self.scene)))
    }

    fn publish(&self, body: &str, charts: &[PathBuf]) -> Result<()> {
        if !self.arguments.sitting.publish {
            return Ok(());
        }
        let title = format!("{} on {}{}", self.table.title(), scene_name(Some(self.scene)), self.other());
        results::publish(&Section { name: &self.section(), title: &title, body, charts })
    }
}

impl ReproduceArguments {
    fn table(&self) -> Table {
        let asked = [(self.story, Table::Story), (self.components, Table::Components), (self.choices, Table::Choices)];
        asked.into_iter().find(|(asked, _)| *asked).map_or(Table::Methods, |(_, table)| table)
    }

    /// The rows that are asked for.
    fn rows(&self) -> Result<Vec<Row>> {
        let mut rows = self.table().rows();
        let names = rows.iter().map(|row| row.name.clone()).collect::<Vec<_>>();
        let unknown = self.rows.iter().find(|name| !names.contains(name));
        ensure!(unknown.is_none(), "--rows {}: no such row; there are {}", self.rows.join(","), names.join(", "));
        rows.retain(|row| self.rows.is_empty() || self.rows.contains(&row.name));
        Ok(rows)
    }
}
