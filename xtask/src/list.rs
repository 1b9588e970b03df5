//! `train --list`: every scene of a plain list, one run each, alone or as one of many jobs.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};

use crate::network::load_lpips;
use crate::process::{Ending, one_line, say, telling};
use crate::run::{self, Metrics, RunConfig};
use crate::train::{TrainArguments, finished, run_unless_finished, scene_name};
use crate::{source, table};

/// Longest list that is read.
const MAX_BYTES: u64 = 16 << 20;

/// Trains this job's scenes of the list under OUT/SCENE; `--merge` makes the table. A failed scene
/// is reported, and is an error after all others.
pub fn train_list(arguments: &TrainArguments) -> Result<()> {
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    let scenes = read(arguments.list.as_deref().context("--list: no file")?)?;
    let out = arguments.out.as_deref().context("--list: give --out, the folder of all runs")?;
    ensure!(!arguments.settings.is_auto(), "--method auto chooses for one scene; it does not go with --list");
    let (config, load) = (arguments.settings.config()?, arguments.load.options()?);
    let interval = arguments.saving.interval()?;
    let (mut rows, mut failed, mut missing): (Vec<(String, Metrics)>, Vec<String>, Vec<String>) = Default::default();
    for (index, scene) in scenes.iter().enumerate() {
        if arguments.part.shard.is_some_and(|shard| !shard.has(index)) {
            continue;
        }
        let name = unique_name(&scenes, index);
        let directory = out.join(&name);
        let trained = source::load(Some(scene), arguments.body.as_deref(), &load).and_then(|source| {
            let run = RunConfig::new(&source, config.clone())?;
            if arguments.part.merge {
                return finished(&directory, &directory, &run);
            }
            run_unless_finished(&directory, &name, &run, &source, lpips.as_ref(), interval).map(Some)
        });
        match trained {
            Ok(Some(metrics)) => rows.push((name, metrics)),
            Ok(None) => missing.push(name),
            Err(error) if matches!(error.downcast_ref(), Some(Ending::Busy(_))) => say!("{name}: in another job"),
            Err(error) if error.chain().any(|cause| cause.is::<Ending>()) => return Err(error),
            Err(error) => {
                say!("{name}: failed: {}", one_line(&error));
                failed.push(name);
            }
        }
    }
    if arguments.part.writes_tables() && !rows.is_empty() {
        let rows: Vec<(String, &Metrics)> = rows.iter().map(|(name, metrics)| (name.clone(), metrics)).collect();
        let text = table::markdown(&rows);
        run::write(&out.join("list.md"), &text)?;
        say!("\n{text}\nwritten: {}", out.join("list.md").display());
    }
    if let Some(first) = missing.first() {
        bail!(
            "{} of {} scenes have no scores yet, such as {first}: run their parts again",
            missing.len(),
            scenes.len()
        );
    }
    match failed.first() {
        Some(first) => bail!("{} of {} scenes failed, such as {first}", failed.len(), scenes.len()),
        None => Ok(()),
    }
}

/// A scene a line; empty lines and what follows `#` are left out.
fn read(path: &Path) -> Result<Vec<String>> {
    let name = path.display().to_string();
    let read = || array_files::read_bounded(path, MAX_BYTES);
    let bytes = telling(&format!("reading {name}"), read).context(name)?;
    let text = array_files::decode_text(&bytes);
    let lines = text.lines().map(|line| line.split('#').next().unwrap_or("").trim());
    let scenes: Vec<String> = lines.filter(|line| !line.is_empty()).map(str::to_owned).collect();
    ensure!(!scenes.is_empty(), "{}: no scene in it", path.display());
    Ok(scenes)
}

/// The scene's own name, numbered where another before it has the same but for upper and lower
/// case, which not every file system tells apart.
pub fn unique_name(scenes: &[String], index: usize) -> String {
    let name = |i: usize| scene_name(Some(&scenes[i]));
    let own = name(index);
    match (0..index).filter(|&i| name(i).eq_ignore_ascii_case(&own)).count() {
        0 => own,
        earlier => format!("{own}-{}", earlier + 1),
    }
}
