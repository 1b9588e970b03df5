//! The model's part of a checkpoint: configuration, values, counts and the field's outer end. The
//! trainer adds the state of the optimiser.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use crate::Error;
use crate::config::Config;
use crate::model::extent::Extent;
use crate::model::file::{Array, Contents, read};
use crate::model::parameters::{PARTS, Part};
use crate::model::trained::Model;

/// The file in a run directory.
pub(crate) const CHECKPOINT: &str = "checkpoint.safetensors";
const FORMAT: &str = "occnerf-checkpoint";
const VERSION: &str = "1";
/// Version of pruned models: they have a bit for each row of the table, lowest first in each byte,
/// and the rows whose bit is set.
const PRUNED: &str = "2";
const KEPT: &str = "table.kept";
/// Where `motion.shell_interval` is not 0: outer end of the field over each vertex.
const EXTENT: &str = "shell";
const COUNTS: &str = "visibility_counts";
/// Bound for forged files: far from overflow.
const MAX_STEPS: u64 = 1 << 40;

impl Model {
    /// The header of a checkpoint of the scene of that name.
    pub(crate) fn header(&self, scene: &str) -> Result<BTreeMap<&'static str, String>, Error> {
        let config = toml::to_string(&self.config).map_err(|e| Error::Scene(format!("configuration: {e}")))?;
        let version = if self.parameters.kept_rows.is_some() { PRUNED } else { VERSION };
        Ok(BTreeMap::from([
            ("format", FORMAT.to_owned()),
            ("version", version.to_owned()),
            ("steps_done", self.steps_done.to_string()),
            ("scene", scene.to_owned()),
            ("config", config),
        ]))
    }

    /// An array of a part, without the rows of the table that pruning has emptied.
    pub(crate) fn stored<'a>(&self, part: Part, array: &'a [f32]) -> Array<'a> {
        Array::Floats(match &self.parameters.kept_rows {
            Some(kept) if part == Part::Table => Cow::Owned(rows_left(array, kept)),
            _ => Cow::Borrowed(array),
        })
    }

    /// The arrays of a checkpoint that are the model's own.
    pub(crate) fn arrays(&self) -> Vec<(String, Array<'_>)> {
        let value = |&(part, name): &(Part, &str)| (name.to_owned(), self.stored(part, self.parameters.get(part)));
        let mut arrays: Vec<(String, Array<'_>)> = PARTS.iter().map(value).collect();
        if let Some(kept) = &self.parameters.kept_rows {
            let byte = |bits: &[bool]| bits.iter().rev().fold(0, |byte, &bit| byte << 1 | u8::from(bit));
            arrays.push((KEPT.to_owned(), Array::Bytes(kept.chunks(8).map(byte).collect())));
        }
        if self.config.motion.shell_interval > 0 {
            arrays.push((EXTENT.to_owned(), Array::Floats(Cow::Borrowed(&self.extent.vertices))));
        }
        arrays.push((COUNTS.to_owned(), Array::Counts(self.counts.counts())));
        arrays
    }

    /// All rows of a part that [`Model::stored`] made; dropped ones are zero.
    pub(crate) fn restored(&self, contents: &Contents<'_>, part: Part, key: &str) -> Result<Vec<f32>, Error> {
        let all = self.parameters.get(part).len();
        let values = contents.floats(key, self.parameters.count(part))?;
        Ok(match &self.parameters.kept_rows {
            Some(kept) if part == Part::Table => rows_filled(&values, kept, all),
            _ => values,
        })
    }

    /// Reads [`Model::header`] and [`Model::arrays`] from a checkpoint.
    pub(crate) fn restore(&mut self, contents: &Contents<'_>) -> Result<(), Error> {
        let steps = contents.require("steps_done")?;
        self.steps_done = steps.parse().ok().filter(|&steps| steps <= MAX_STEPS).ok_or_else(|| {
            contents.corrupt(format!("header `steps_done` is {steps:?}, expected a whole number up to {MAX_STEPS}"))
        })?;
        if contents.header("version") == Some(PRUNED) {
            let rows = self.parameters.get(Part::Table).len() / self.config.encoding.features.max(1);
            let bits = contents.bytes(KEPT, rows.div_ceil(8))?;
            let kept = (0..rows).map(|row| bits[row / 8] >> (row % 8) & 1 == 1);
            self.parameters.kept_rows = Some(kept.collect());
        }
        for (part, name) in PARTS {
            *self.parameters.get_mut(part) = self.restored(contents, part, name)?;
        }
        let vertices = self.body.canonical.vertices.len();
        self.counts = visibility::VisibilityCounts::from_counts(contents.counts(COUNTS, vertices)?);
        if self.config.motion.shell_interval > 0 {
            let ends = contents.floats(EXTENT, vertices)?;
            let whole = self.extent.farthest;
            if let Some(at) = ends.iter().position(|end| !(0.0..=whole).contains(end)) {
                let what = format!("`{EXTENT}` is {} at {at}, expected 0 to {whole}", ends[at]);
                return Err(contents.corrupt(what));
            }
            self.extent = Extent::new(&self.body, ends);
        }
        self.refresh_volume();
        Ok(())
    }
}

/// Takes a checkpoint's bytes apart.
pub(crate) fn parse<'a>(path: &Path, bytes: &'a [u8]) -> Result<Contents<'a>, Error> {
    Contents::parse(path, bytes, FORMAT, &[VERSION, PRUNED])
}

/// The configuration in a checkpoint's header.
pub(crate) fn config_of(contents: &Contents<'_>) -> Result<Config, Error> {
    let text = contents.require("config")?;
    let config: Config = toml::from_str(text).map_err(|e| contents.corrupt(format!("header `config`: {e}")))?;
    config.validate().map_err(|e| contents.corrupt(format!("header {e}")))?;
    Ok(config)
}

/// The configuration that a checkpoint was written with.
///
/// # Errors
/// [`Error::Io`] and [`Error::File`] for a file that is no checkpoint.
pub fn checkpoint_config(path: &Path) -> Result<Config, Error> {
    let bytes = read(path)?;
    config_of(&parse(path, &bytes)?)
}

/// The kept rows of `array`, one after another.
fn rows_left(array: &[f32], kept: &[bool]) -> Vec<f32> {
    let rows = array.chunks_exact((array.len() / kept.len().max(1)).max(1));
    rows.zip(kept).filter(|(_, kept)| **kept).flat_map(|(row, _)| row).copied().collect()
}

/// All rows, `all` numbers; dropped ones are zero.
fn rows_filled(values: &[f32], kept: &[bool], all: usize) -> Vec<f32> {
    let width = (all / kept.len().max(1)).max(1);
    let (mut rows, mut array) = (values.chunks_exact(width), vec![0.0; all]);
    for (row, _) in array.chunks_exact_mut(width).zip(kept).filter(|(_, kept)| **kept) {
        rows.next().into_iter().for_each(|values| row.copy_from_slice(values));
    }
    array
}
