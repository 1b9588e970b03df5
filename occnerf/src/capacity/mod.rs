//! Model capacity from the scene: sizes of the encoding, the perceptron and the sampling from the
//! detail that the video shows.

mod measure;
mod prune;

use std::fmt;

use serde::{Deserialize, Serialize};

pub use self::measure::Measured;
pub use self::prune::Pruned;
use crate::Error;
use crate::config::{Config, Preset};
use crate::scene::prepared::Scene;

/// Longest side of the finest cell, in pixels of the video at the subject.
const PIXELS_A_CELL: f32 = 0.75;
/// Rows of a level's table for the shape that every body has, before any detail.
const ROWS_OF_A_BODY: f64 = 4096.0;
/// Pixel-wide places of the seen surface for each row on top of those. At 2.5 the demo loses 0.3
/// dB.
const PLACES_A_ROW: f64 = 1.0;
/// Pixel-wide places for each unit of a hidden layer.
const PLACES_A_UNIT: f64 = 400.0;
/// Least width of a hidden layer, whatever the scene: 32 loses 0.3 dB and saves a thirtieth of the
/// parameters. Widths are multiples of `UNITS`, for the kernels fill up their lanes anyway.
const MIN_WIDTH: usize = 64;
const UNITS: usize = 16;
/// Mean distance of samples along a ray, normalised metres: that of `fast` on a walking person.
const STEP: f32 = 0.007;

/// Most cells an axis, levels and log₂ of a level's table that a scene is given: the paper's.
const MOST: (u32, usize, u32) = (2048, 16, 19);
/// Pixel-wide places that the steps of `fast` and `balanced` are enough for: a person in pictures
/// of 256 × 256. More take more steps in proportion, up to [`MOST_STEPS`] times as many.
const PLACES_OF_A_RUN: f64 = 28_000.0;
const MOST_STEPS: f64 = 2.0;

/// Measurements of a scene, and the sizes that follow from them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Capacity {
    /// Detail that the video shows.
    pub measured: Measured,
    /// Sizes with their reasons.
    pub choices: Vec<Choice>,
    /// Result of pruning after training.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pruned: Option<Pruned>,
}

/// A size of the model, with its reason.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// Dotted name in [`Config`].
    pub key: String,
    /// Value in the preset.
    pub preset: f64,
    /// Value chosen for the scene.
    pub chosen: f64,
    /// The reason, in words and figures.
    pub why: String,
}

impl Capacity {
    /// Measures a scene and chooses sizes in place of those of `config`; the same for the same
    /// scene, whatever the threads.
    ///
    /// The grid and the number of steps grow beyond the preset's with what the video shows, up to
    /// the paper's grid; width and samples only shrink.
    ///
    /// # Errors
    /// A configuration that is not valid, and those of [`Measured::of`].
    pub fn measure(scene: &Scene, config: &Config) -> Result<Self, Error> {
        config.validate()?;
        Ok(Self::choose(Measured::of(scene, config)?, config))
    }

    /// The sizes that follow from measurements.
    pub fn choose(measured: Measured, config: &Config) -> Self {
        let mut choices = Vec::new();
        let mut add = |key: &str, preset: f64, chosen: f64, why: String| {
            choices.push(Choice { key: key.to_owned(), preset, chosen, why });
        };
        let cells = measured.cells.max(1) as f64;
        if config.method.has_field() {
            let grid = &config.encoding;
            let finest = (measured.extent / (PIXELS_A_CELL * measured.metres_a_pixel)).ceil() as u32;
            let n_max = finest.clamp(grid.n_min, grid.n_max.max(MOST.0).max(grid.n_min));
            let (pixel, extent) = (1e3 * measured.metres_a_pixel, measured.extent);
            let why = format!(
                "a pixel shows {pixel:.1} mm of {extent:.2} m; the finest cells are {PIXELS_A_CELL} pixel long"
            );
            add("encoding.n_max", grid.n_max.into(), n_max.into(), why);
            let (levels, growth) = levels(grid.levels, grid.n_min, grid.n_max, n_max);
            let why = format!("each is {growth:.2} times finer than the one before, as in the preset");
            add("encoding.levels", grid.levels as f64, levels as f64, why);
            let size = (ROWS_OF_A_BODY + cells / PLACES_A_ROW).log2().ceil() as u32;
            let pixels = measured.subject_pixels;
            let why = format!(
                "{pixels} pixels show {cells} places a pixel wide: {PLACES_A_ROW} to a row, and {ROWS_OF_A_BODY} rows for the shape"
            );
            let size = size.min(grid.log2_table_size.max(MOST.2));
            add("encoding.log2_table_size", grid.log2_table_size.into(), size.into(), why);
            let units = ((cells / PLACES_A_UNIT).ceil() as usize).next_multiple_of(UNITS).max(MIN_WIDTH);
            let why = format!("a unit for {PLACES_A_UNIT} such places, at least {MIN_WIDTH}");
            add("field.width", config.field.width as f64, units.min(config.field.width) as f64, why);
        }
        let samples = (measured.span / STEP).ceil() as usize;
        let why = format!("{:.2} m of a ray cross the body's box: a sample every {:.0} mm", measured.span, 1e3 * STEP);
        add("samples", config.samples as f64, samples.clamp(1, config.samples) as f64, why);
        if config.preset != Preset::Paper {
            let factor = (cells / PLACES_OF_A_RUN).clamp(1.0, MOST_STEPS);
            let why = format!("{cells} places; the preset's are enough for {PLACES_OF_A_RUN}");
            add("steps", config.steps as f64, (config.steps as f64 * factor).round(), why);
        }
        Self { measured, choices, pruned: None }
    }

    /// The sizes that exceed the preset's.
    #[must_use]
    pub fn growth(mut self) -> Self {
        self.choices.retain(|choice| choice.chosen > choice.preset);
        self
    }

    /// Puts the chosen sizes into a configuration; keys that are none of its sizes are left alone.
    pub fn apply(&self, config: &mut Config) {
        for Choice { key, chosen, .. } in &self.choices {
            let encoding = &mut config.encoding;
            match key.as_str() {
                "encoding.n_max" => encoding.n_max = *chosen as u32,
                "encoding.levels" => encoding.levels = *chosen as usize,
                "encoding.log2_table_size" => encoding.log2_table_size = *chosen as u32,
                "field.width" => config.field.width = *chosen as usize,
                "samples" => config.samples = *chosen as usize,
                "steps" => config.steps = *chosen as u64,
                _ => {}
            }
        }
    }
}

/// Levels up to `n_max` cells that keep the growth from level to level of `preset` levels up to
/// `preset_max` cells.
fn levels(preset: usize, n_min: u32, preset_max: u32, n_max: u32) -> (usize, f64) {
    let octaves = |n: u32| (f64::from(n.max(1)) / f64::from(n_min.max(1))).ln();
    if preset < 2 || preset_max <= n_min {
        return (preset, 1.0);
    }
    let growth = octaves(preset_max) / (preset - 1) as f64;
    let levels = 1 + (octaves(n_max) / growth).round().max(0.0) as usize;
    (levels.min(preset.max(MOST.1)), growth.exp())
}

impl fmt::Display for Capacity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for Choice { key, preset, chosen, why } in &self.choices {
            let change =
                if chosen == preset { format!("{chosen}, the preset's") } else { format!("{preset} → {chosen}") };
            writeln!(f, "  {key:<24} {change:<18} {why}")?;
        }
        Ok(())
    }
}
