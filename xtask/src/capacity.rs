//! `--capacity auto`: model sizes from the scene, pruning after training, and their record.

use std::path::Path;

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use occnerf::{Capacity, Config, Preset, Scene, Trainer};

use crate::optimise;
use crate::process::{note, say, unwritten};
use crate::run::{read_text, write};
use crate::source::Source;

/// Record in a run directory.
pub const FILE: &str = "capacity.json";

/// Sizes of the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum CapacityName {
    /// The preset's sizes, whatever the scene.
    Preset,
    /// Grid, width, samples and steps measured from the scene, and pruned after training.
    Auto,
}

/// Capacity of a scene, relative to `config`; sizes named by `set` are kept.
pub fn measure(source: &Source, config: &Config, set: &[String]) -> Result<Capacity> {
    if !config.method.has_field() {
        bail!("--capacity auto: the prior has no sizes to choose");
    }
    Ok(of_scene(&source.scene(config)?, config, set)?)
}

fn of_scene(scene: &Scene, config: &Config, set: &[String]) -> Result<Capacity, occnerf::Error> {
    let mut capacity = Capacity::measure(scene, config)?;
    capacity.choices.retain(|choice| set.iter().all(|set| set.split('=').next() != Some(&choice.key)));
    Ok(capacity)
}

/// Sizes of a new run from its scene, if any; by default, only those above its preset's.
pub fn choose(
    source: &Source,
    config: &Config,
    set: &[String],
    asked: Option<CapacityName>,
) -> Result<Option<Capacity>> {
    // The preset `paper` is the paper's setting.
    let own = !config.method.has_field() || config.preset == Preset::Paper;
    match asked {
        Some(CapacityName::Auto) => measure(source, config, set).map(Some),
        None if !own => {
            // By default, a failed measurement falls back to the preset.
            let measured = of_scene(&source.scene(config)?, config, set);
            let capacity = measured.map_err(|error| note!("warning: the preset's sizes are kept: {error}"));
            Ok(capacity.ok().map(Capacity::growth).filter(|capacity| !capacity.choices.is_empty()))
        }
        _ => Ok(None),
    }
}

/// Record of a run; `None` for preset sizes.
pub fn read(directory: &Path) -> Result<Option<Capacity>> {
    let path = directory.join(FILE);
    if !path.is_file() {
        return Ok(None);
    }
    serde_json::from_str(&read_text(&path)?).map(Some).with_context(|| path.display().to_string())
}

/// Writes the record of a new run, or removes an old one.
pub fn begin(directory: &Path, chosen: Option<&Capacity>) -> Result<()> {
    let path = directory.join(FILE);
    match chosen {
        Some(capacity) => save(directory, capacity),
        None if path.exists() => std::fs::remove_file(&path).map_err(unwritten(&path)),
        None => Ok(()),
    }
}

/// Writes the record.
pub fn save(directory: &Path, capacity: &Capacity) -> Result<()> {
    write(&directory.join(FILE), &serde_json::to_string_pretty(capacity)?)
}

/// Checks the option of a resumed run against its record.
pub fn resumed(directory: &Path, asked: Option<CapacityName>) -> Result<Option<Capacity>> {
    let capacity = read(directory)?;
    let begun = if capacity.is_some() { CapacityName::Auto } else { CapacityName::Preset };
    if asked.is_some_and(|asked| asked != begun) {
        bail!("the run to resume has other sizes; leave --capacity out, or start a new run with --out");
    }
    Ok(capacity)
}

/// Prunes and saves a trained run with a record.
pub fn prune(directory: &Path, trainer: &mut Trainer<'_>, checkpoint: &Path) -> Result<()> {
    let Some(mut capacity) = read(directory)? else { return Ok(()) };
    let pruned = trainer.prune();
    optimise::save(trainer, checkpoint)?;
    say!("pruned: {} of {} rows of the table; {} parameters", pruned.dropped, pruned.rows, pruned.parameters);
    capacity.pruned = Some(pruned);
    save(directory, &capacity)
}
