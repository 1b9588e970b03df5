//! `train --compare`: every method on one scene, both pixel rules, one table.

use anyhow::Result;
use occnerf::{Config, Method, OccludedRule};

use crate::network::load_lpips;
use crate::process::say;
use crate::run::{Metrics, RunConfig, use_threads};
use crate::train::{TrainArguments, run_unless_finished, scene_name};
use crate::{run, source, table};

const RUNS: [(Method, OccludedRule); 7] = [
    (Method::Prior, OccludedRule::Unknown),
    (Method::Humannerf, OccludedRule::Background),
    (Method::Humannerf, OccludedRule::Unknown),
    (Method::HashPoint, OccludedRule::Background),
    (Method::HashPoint, OccludedRule::Unknown),
    (Method::Occnerf, OccludedRule::Background),
    (Method::Occnerf, OccludedRule::Unknown),
];

/// Trains what is missing under OUT/METHOD-RULE and prints all; a finished run is not trained
/// again.
pub fn compare(arguments: &TrainArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    anyhow::ensure!(arguments.settings.method.is_none(), "--compare trains every method: leave --method out");
    let default = format!("runs/{}-compare", scene_name(arguments.scene.as_deref()));
    let out = arguments.out.clone().unwrap_or_else(|| default.into());
    let source = source::load(arguments.scene.as_deref(), arguments.body.as_deref(), &arguments.load.options()?)?;
    let interval = arguments.saving.interval()?;
    let mut rows: Vec<(String, Metrics)> = Vec::new();
    for (method, occluded) in RUNS {
        let mut settings = arguments.settings.clone();
        settings.method = Some(method);
        let config = Config { occluded, ..settings.config()? };
        let name = match config.method {
            Method::Prior => config.method.name().to_owned(),
            _ => format!("{}-{}", config.method.name(), occluded.name()),
        };
        let directory = out.join(&name);
        let run = RunConfig {
            scene: source.scene.clone(),
            body: source.body.clone(),
            load: source.load.clone(),
            train: config,
        };
        rows.push((
            run.train.method.name().to_owned(),
            run_unless_finished(&directory, &name, &run, &source, lpips.as_ref(), interval)?,
        ));
    }
    let rows: Vec<(String, &Metrics)> = rows.iter().map(|(name, metrics)| (name.clone(), metrics)).collect();
    let text = table::markdown(&rows);
    run::write(&out.join("comparison.md"), &text)?;
    let title = rows.first().map_or("scores", |(_, metrics)| metrics.splits.title());
    say!("\n{}, {title}:\n{text}", source.scene);
    say!("written: {}", out.join("comparison.md").display());
    Ok(())
}
