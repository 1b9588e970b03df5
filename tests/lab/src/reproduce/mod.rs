//! `reproduce`: the paper's table, and others made in the same way, on a user's data.

mod rows;
mod summary;

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use clap::Args;
use occnerf::{Config, Preset};

use crate::results::{self, Section};
use crate::sweep::{Captures, Job, Keep, Kind, Line, Point, Runner, SittingArguments};
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
    #[command(flatten)]
    on: Captures,
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
    let ReproduceArguments { on, sitting, .. } = arguments;
    let (table, rows) = (arguments.table(), arguments.rows()?);
    // Bad input leaves nothing behind. A part need not load all scenes.
    load_lpips(arguments.lpips.as_deref())?;
    let is_whole = sitting.part.writes_tables() && !sitting.part.merge;
    let scenes = if is_whole { on.checked()? } else { on.scenes() };
    let mut runner = sitting.open(&arguments.out)?;
    let mut failed = Vec::new();
    for (index, scene) in scenes.iter().enumerate() {
        let directory = arguments.out.join(unique_name(&scenes, index));
        let directory = if table == Table::Methods { directory } else { directory.join(table.name()) };
        let summary = arguments.run(scene, &rows, &directory, &mut runner, &mut failed)?;
        if !sitting.part.writes_tables() {
            continue;
        }
        say!("\n{}", summary.markdown());
        for name in ["md", "json", "png"].map(|extension| directory.join(summary.file(extension))) {
            if name.is_file() {
                say!("written: {}", name.display());
            }
        }
        if sitting.publish {
            arguments.publish(scene, &summary, &directory)?;
        }
    }
    runner.end(&sitting.part)?;
    match failed.first() {
        Some(first) => bail!("{} runs failed, such as {first}", failed.len()),
        None => Ok(()),
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

    /// Trains and scores every row that is not finished, with all its seeds; `failed` gets the runs
    /// that did not work out, and why.
    fn run(
        &self,
        scene: &str,
        rows: &[Row],
        directory: &Path,
        runner: &mut Runner,
        failed: &mut Vec<String>,
    ) -> Result<Summary> {
        let steps = self.steps.unwrap_or(Config::preset(self.preset, occnerf::Method::Occnerf).steps);
        let settings = format!("preset {}, {steps} steps a run, {} seeds", self.preset.name(), self.seeds);
        let (table, place) = (self.table(), self.on.place(scene)?);
        let mut summary = Summary::new(scene, settings, table);
        for row in rows {
            for seed in 1..=row.runs(self.seeds) {
                let mut config = row.config(self.preset, steps, seed)?;
                if let Some(path) = &self.perceptual_weights {
                    config.loss.perceptual_weights.clone_from(path);
                }
                let path = directory.join(row.run(seed));
                let trained = row.baked.map(|row| directory.join(format!("{row}-s{seed}")));
                let keep = Some(Keep { directory: path.clone(), trained });
                let lpips = self.lpips.clone();
                let point = Point {
                    bench: table.name().to_owned(),
                    name: row.run(seed),
                    factor: "as-it-is".to_owned(),
                    level: None,
                    kind: Kind::Row,
                    command: None,
                    job: Job { lpips, keep, ..Job::new(place.clone(), usize::MAX, row.method, config) },
                };
                let Some(Line { outcome, .. }) = runner.run(point)? else { continue };
                match (outcome.metrics, outcome.error) {
                    (Some(metrics), None) => summary.add(row, &path, metrics),
                    (_, error) => failed.push(format!("{}: {}", path.display(), error.unwrap_or_default())),
                }
            }
            // After every row, so that an end before the last leaves a table.
            if self.sitting.part.writes_tables() {
                make_directory(directory)?;
                summary.write(directory)?;
            }
        }
        Ok(summary)
    }

    /// Makes a table a section of the results, named by the options that set it apart from the
    /// scene's main tables.
    fn publish(&self, scene: &str, summary: &Summary, directory: &Path) -> Result<()> {
        let (table, name) = (self.table(), scene_name(Some(scene)));
        let paper = if self.preset == Preset::Paper { " --preset paper" } else { "" };
        let lpips = if self.perceptual_weights.is_some() { " --perceptual-weights" } else { "" };
        let other = format!("{paper}{lpips}{}", self.on.load.command_line());
        let section = format!("{}-{name}{}", table.name(), other.replace(" --", "-").replace(' ', "-"));
        let title = format!("{} on {name}{other}", table.title());
        let (body, charts) = (summary.markdown(), [summary.chart(directory, &section)?]);
        results::publish(&Section { name: &section, title: &title, body: &body, charts: &charts })?;
        // The one that everybody can reproduce.
        if scene == source::DEMO && table == Table::Methods && other.is_empty() {
            results::publish_table(&format!("{}.\n\n{}", results::set_of(&name), summary.front()))?;
        }
        Ok(())
    }
}
