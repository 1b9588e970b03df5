//! `reproduce`: the paper's table on somebody's data.

mod plan;
mod rows;
mod summary;

use std::path::{Path, PathBuf};

use anyhow::{Result, ensure};
use clap::Args;

use crate::run::RunConfig;
use crate::settings::PresetName;
use crate::source::{self, LoadArguments};
use crate::train::{run_unless_finished, scene_name};
use plan::Plan;
use rows::ROWS;
use summary::Summary;

#[derive(Args)]
pub struct ReproduceArguments {
    /// Captures, or demo [default: demo]
    scenes: Vec<String>,
    /// The body model of the captures [default: as in train]
    #[arg(long)]
    body: Option<PathBuf>,
    #[command(flatten)]
    load: LoadArguments,
    /// Directory of all runs and results
    #[arg(long, default_value = "runs/reproduce")]
    out: PathBuf,
    /// Minutes that everything may take; the number of steps follows from a measurement on this machine
    #[arg(long, default_value_t = 60.0)]
    budget: f64,
    /// Runs of each row, with seeds 1 to N; the table gives mean and standard deviation
    #[arg(long, default_value_t = 3, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Settings that every row starts from
    #[arg(long, default_value = "fast")]
    preset: PresetName,
    /// Steps of a row, in place of a budget
    #[arg(long)]
    steps: Option<u64>,
    /// Rows to leave out, comma separated, by the names of the table
    #[arg(long, value_delimiter = ',', value_name = "ROW")]
    without: Vec<String>,
}

/// Runs the command.
pub fn reproduce(arguments: &ReproduceArguments) -> Result<()> {
    ensure!(arguments.budget > 0.0 && arguments.budget.is_finite(), "--budget: expected minutes above 0");
    for name in &arguments.without {
        let known = ROWS.iter().map(|row| row.name).collect::<Vec<_>>().join(", ");
        ensure!(ROWS.iter().any(|row| row.name == name), "--without {name}: no such row; there are {known}");
    }
    let demo = [source::DEMO.to_owned()];
    let scenes = if arguments.scenes.is_empty() { &demo[..] } else { &arguments.scenes };
    let minutes = arguments.budget / scenes.len() as f64;
    for (index, scene) in scenes.iter().enumerate() {
        println!("scene {} of {}: {scene}", index + 1, scenes.len());
        let directory = arguments.out.join(directory_name(scenes, index));
        one_scene(arguments, scene, &directory, minutes)?;
    }
    Ok(())
}

/// The scene's own name, numbered where another scene before it has the same.
fn directory_name(scenes: &[String], index: usize) -> String {
    let name = |i: usize| scene_name(Some(&scenes[i]));
    match (0..index).filter(|&i| name(i) == name(index)).count() {
        0 => name(index),
        earlier => format!("{}-{}", name(index), earlier + 1),
    }
}

fn one_scene(arguments: &ReproduceArguments, scene: &str, directory: &Path, minutes: f64) -> Result<()> {
    let source = source::load(Some(scene), arguments.body.as_deref(), &arguments.load.options())?;
    std::fs::create_dir_all(directory)?;
    let rows: Vec<_> = ROWS.iter().filter(|row| arguments.without.iter().all(|name| name != row.name)).collect();
    let preset = arguments.preset.into();
    let plan = Plan::read_or_make(directory, &source, &rows, preset, arguments.seeds, minutes, arguments.steps)?;
    println!("{plan}");
    let mut summary = Summary::new(&source, &plan);
    for row in rows {
        for seed in 1..=row.runs(arguments.seeds) {
            let train = row.config(preset, seed, &plan);
            let name = if row.learns() { format!("{}-s{seed}", row.name) } else { row.name.to_owned() };
            let run =
                RunConfig { scene: source.scene.clone(), body: source.body.clone(), load: source.load.clone(), train };
            let metrics = run_unless_finished(&directory.join(&name), &name, &run, &source)?;
            summary.add(row, &directory.join(&name), metrics);
        }
        // After every row, so that an end before the last leaves a table.
        summary.write(directory)?;
    }
    println!("\n{}", summary.markdown());
    for name in ["reproduce.md", "reproduce.json", "reproduce.png"] {
        println!("written: {}", directory.join(name).display());
    }
    Ok(())
}
