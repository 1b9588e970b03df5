//! How many steps a budget pays for, by a measurement on this machine.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::time::Instant;

use crate::scene::SceneOptions;
use anyhow::{Context, Result};
use occnerf::{Config, FieldRenderer, Lpips, PreparedFrame, Preset, evaluate};
use serde::{Deserialize, Serialize};

use super::rows::{Length, Row};
use crate::methods::Method;
use xtask::process::note;
use xtask::run;
use xtask::source::Source;

const FILE: &str = "plan.json";
/// Steps before and of a measurement.
const WARM: u64 = 4;
const TIMED: u64 = 10;
/// Fewer steps than this say nothing about any method.
const FEWEST: u64 = 20;
/// Part of the budget that is planned for; the rest is for preparing scenes and for slow moments.
const SPARE: f64 = 0.85;

/// What a plan is made for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Request {
    pub preset: String,
    pub seeds: u64,
    /// Minutes; none where the number of steps is given.
    pub budget: Option<f64>,
    /// Names of the rows.
    pub rows: Vec<String>,
    /// How the capture is read.
    pub load: SceneOptions,
    /// Weights of the perceptual term, empty for the embedded one, and network of the score.
    pub perceptual_weights: String,
    pub lpips: Option<String>,
}

/// What every row of a scene is given.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    #[serde(flatten)]
    request: Request,
    /// Of a row that is not longer than the others.
    pub steps: u64,
    /// Seconds of a step and of a scored picture of each method, by its first row, measured before
    /// everything else.
    cost: BTreeMap<String, (f64, f64)>,
}

impl Plan {
    /// The plan that an earlier sitting, or another job, left under `directory` for the same
    /// request.
    pub fn read(directory: &Path, request: &Request, steps: Option<u64>) -> Result<Option<Self>> {
        let path = directory.join(FILE);
        if !path.is_file() {
            return Ok(None);
        }
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        // One that an older version wrote lacks what this one asks: it is made anew.
        let old = serde_json::from_str::<Self>(&text).ok();
        Ok(old.filter(|old| old.request == *request && steps.is_none_or(|s| s == old.steps)))
    }

    /// A new plan, which is left under `directory`.
    pub fn make(
        directory: &Path,
        source: &Source,
        rows: &[Row],
        request: Request,
        preset: Preset,
        steps: Option<u64>,
        lpips: Option<&Lpips>,
    ) -> Result<Self> {
        let (mut cost, mut pictures) = (BTreeMap::new(), 0);
        use Method::{HashPoint, Humannerf, NeuralBody, Occnerf, SelfNerf};
        for method in [Humannerf, HashPoint, NeuralBody, SelfNerf, Occnerf] {
            if let Some(row) = rows.iter().find(|row| row.method == method) {
                let mut config = row.settings(preset)?;
                config.loss.perceptual_weights.clone_from(&request.perceptual_weights);
                let (seconds, scored) = measure(source, method, config, lpips)?;
                cost.insert(method.name().to_owned(), seconds);
                pictures = scored;
            }
        }
        let (seeds, minutes) = (request.seeds, request.budget.unwrap_or_default());
        let mut plan = Self { request, steps: 1, cost };
        let (mut a_step, mut fixed) = (0.0, 0.0);
        for row in rows.iter().filter(|row| row.learns()) {
            let (mut step, picture) = plan.cost(row);
            if row.baked.is_some_and(|trained| rows.iter().any(|row| row.name == trained)) {
                step = 0.0;
            }
            a_step += row.runs(seeds) as f64 * plan.factor(row) * step;
            fixed += row.runs(seeds) as f64 * pictures as f64 * picture;
        }
        let affordable = (SPARE * 60.0 * minutes - fixed) / a_step.max(1e-9);
        plan.steps = steps.unwrap_or(affordable.clamp(FEWEST as f64, 1e6) as u64);
        if steps.is_none() && affordable < FEWEST as f64 {
            note!(
                "warning: {minutes:.0} minutes do not pay for {FEWEST} steps a run beside {:.0} minutes of scoring; \
                 fewer --seeds, a larger --eval-stride or fewer --rows would",
                fixed / 60.0
            );
        }
        run::write(&directory.join(FILE), &serde_json::to_string_pretty(&plan)?)?;
        Ok(plan)
    }

    fn cost(&self, row: &Row) -> (f64, f64) {
        self.cost.get(row.method.name()).copied().unwrap_or_default()
    }

    fn factor(&self, row: &Row) -> f64 {
        match row.length {
            Length::Times(times) => times,
            Length::Seconds => {
                let reference = self.cost.get(Method::Occnerf.name()).map_or(0.0, |c| c.0);
                let own = self.cost(row).0;
                if reference > 0.0 && own > 0.0 { reference / own } else { 1.0 }
            }
        }
    }

    /// The configuration of a run of `row`.
    ///
    /// # Errors
    /// As [`Row::settings`].
    pub fn config(&self, row: &Row, preset: Preset, seed: u64) -> Result<Config> {
        Ok(Config { seed, steps: self.steps_of(row), ..row.settings(preset)? })
    }

    /// Steps of a row.
    pub fn steps_of(&self, row: &Row) -> u64 {
        ((self.steps as f64 * self.factor(row)).round() as u64).max(1)
    }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Request { preset, seeds, budget, .. } = &self.request;
        write!(f, "plan: preset {preset}, {} steps a run, {seeds} seeds", self.steps)?;
        if let Some(budget) = budget {
            write!(f, ", sized for {budget:.0} minutes")?;
        }
        for (method, (step, picture)) in &self.cost {
            write!(f, "; {method} {step:.3} s a step, {picture:.2} s a picture")?;
        }
        Ok(())
    }
}

/// Seconds of a step and of a scored picture, and how many pictures a run is scored on.
fn measure(source: &Source, method: Method, config: Config, lpips: Option<&Lpips>) -> Result<((f64, f64), usize)> {
    let scene = source.scene(&config)?;
    let mut trainer = method.trainer(&scene, config)?;
    trainer.load_perceptual()?;
    for _ in 0..WARM {
        trainer.step()?;
    }
    let start = Instant::now();
    for _ in 0..TIMED {
        trainer.step()?;
    }
    let step = start.elapsed().as_secs_f64() / TIMED as f64;
    let scored: Vec<&PreparedFrame> = xtask::eval::scored_frames(&scene).collect();
    let first = &scored[..scored.len().min(1)];
    let mut renderer = FieldRenderer::new(trainer.model())?;
    let start = Instant::now();
    evaluate(&scene, &mut renderer, first, lpips, |_, _| {})?;
    Ok(((step, start.elapsed().as_secs_f64()), scored.len()))
}
