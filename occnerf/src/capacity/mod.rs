//! How much model a scene needs: sizes of the encoding, the perceptron and the sampling from what its video shows.

mod measure;
mod prune;

use std::fmt;

use serde::{Deserialize, Serialize};

pub use self::measure::Measured;
pub use self::prune::Pruned;
use crate::Error;
use crate::config::{Config, Method};
use crate::scene::Scene;

/// Width of the finest cell, in pixels of the video at the subject.
const PIXELS_A_CELL: f32 = 0.5;
/// Pixel-sized cells of the seen surface that share a row of a level's table.
const CELLS_A_ROW: f64 = 4.0;
/// log₂ of the smallest table.
const MIN_LOG2_TABLE_SIZE: u32 = 8;
/// Pixel-sized cells of the seen surface for each unit of a hidden layer.
const CELLS_A_UNIT: f64 = 256.0;
/// Widths are multiples of it: narrower ones are padded to it.
const UNITS: usize = 16;
/// Samples that are alive on a mean ray.
const ALIVE_SAMPLES: f32 = 10.0;

/// What was measured of a scene, and the sizes that follow from it, none above those it started from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Capacity {
    /// What the video shows.
    pub measured: Measured,
    /// Sizes with their reasons.
    pub choices: Vec<Choice>,
    /// What pruning took away after training.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pruned: Option<Pruned>,
}

/// One size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// Dotted name in [`Config`].
    pub key: String,
    /// Value before.
    pub preset: u64,
    /// Value that the scene needs, at most `preset`.
    pub chosen: u64,
    /// Why.
    pub why: String,
}

impl Capacity {
    /// Measures a scene and chooses sizes at most those of `config`; the same for the same scene, whatever the threads.
    ///
    /// Of the encodings the hash grids have sizes to choose; `humannerf` keeps its perceptron, which holds the whole person.
    ///
    /// # Errors
    /// A configuration that is not valid, and those of [`Measured::of`].
    pub fn measure(scene: &Scene, config: &Config) -> Result<Self, Error> {
        config.validate()?;
        Ok(Self::choose(Measured::of(scene, config)?, config))
    }

    /// The sizes that follow from what was measured.
    pub fn choose(measured: Measured, config: &Config) -> Self {
        let mut choices = Vec::new();
        let mut add = |key: &str, preset: u64, chosen: u64, why: String| {
            choices.push(Choice { key: key.to_owned(), preset, chosen: chosen.min(preset), why });
        };
        let cells = measured.cells.max(1);
        let millimetres = 1e3 * measured.metres_a_pixel;
        if matches!(config.method, Method::Occnerf | Method::HashPoint) {
            let grid = &config.encoding;
            let wanted = measured.extent / (PIXELS_A_CELL * measured.metres_a_pixel);
            let n_max = (wanted.round() as u32).clamp(grid.n_min, grid.n_max.max(grid.n_min));
            let why =
                format!("a pixel is {millimetres:.1} mm of {:.2} m: cells of {PIXELS_A_CELL} pixel", measured.extent);
            add("encoding.n_max", grid.n_max.into(), n_max.into(), why);
            let (levels, growth) = levels(grid.levels, grid.n_min, grid.n_max, n_max);
            let why = format!("each level {growth:.2} times finer than the one before, as in the preset");
            add("encoding.levels", grid.levels as u64, levels as u64, why);
            let rows = (cells as f64 / CELLS_A_ROW).max(1.0);
            let size = (rows.log2().ceil() as u32).max(MIN_LOG2_TABLE_SIZE);
            let why = format!(
                "{} pixels show {cells} cells as wide as a pixel, {CELLS_A_ROW} for each row",
                measured.subject_pixels
            );
            add("encoding.log2_table_size", grid.log2_table_size.into(), size.into(), why);
            let units = (cells as f64 / CELLS_A_UNIT).ceil() as usize;
            let why = format!("{cells} cells, {CELLS_A_UNIT} for each unit, a multiple of {UNITS}");
            add("field.width", config.field.width as u64, units.next_multiple_of(UNITS) as u64, why);
        }
        let samples = (ALIVE_SAMPLES / measured.alive.max(1e-3)).ceil() as u64;
        let why = format!(
            "{:.0} % of the {:.2} m of a ray are near the body: {ALIVE_SAMPLES} samples there",
            100.0 * measured.alive,
            measured.span
        );
        add("samples", config.samples as u64, samples.max(1), why);
        Self { measured, choices, pruned: None }
    }

    /// Puts the chosen sizes into a configuration; keys that are none of its sizes are left alone.
    pub fn apply(&self, config: &mut Config) {
        for choice in &self.choices {
            let small = u32::try_from(choice.chosen).unwrap_or(u32::MAX);
            match choice.key.as_str() {
                "encoding.n_max" => config.encoding.n_max = small,
                "encoding.levels" => config.encoding.levels = small as usize,
                "encoding.log2_table_size" => config.encoding.log2_table_size = small,
                "field.width" => config.field.width = small as usize,
                "samples" => config.samples = small as usize,
                _ => {}
            }
        }
    }
}

/// Levels up to `n_max` cells that keep the growth from level to level of `most` levels up to `preset_max` cells.
fn levels(most: usize, n_min: u32, preset_max: u32, n_max: u32) -> (usize, f64) {
    let octaves = |n: u32| (f64::from(n.max(1)) / f64::from(n_min.max(1))).ln();
    if most < 2 || preset_max <= n_min {
        return (most, 1.0);
    }
    let growth = octaves(preset_max) / (most - 1) as f64;
    let levels = 1 + (octaves(n_max) / growth - 1e-9).ceil().max(0.0) as usize;
    (levels.min(most), growth.exp())
}

impl fmt::Display for Capacity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Choice { key, preset, chosen, why } in &self.choices {
            let change =
                if chosen == preset { format!("{chosen}, the preset's") } else { format!("{chosen} of {preset}") };
            writeln!(f, "  {key:<24} {change:<18} {why}")?;
        }
        Ok(())
    }
}
