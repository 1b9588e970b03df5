//! The model's part of a checkpoint: configuration, values, counts and the field's outer end. The
//! trainer adds the state of the optimiser.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::tensors::Tensor;

use crate::Error;
use crate::config::Config;
use crate::model::extent::Extent;
use crate::model::file::{Contents, array, read};
use crate::model::parameters::PARTS;
use crate::model::trained::Model;

/// The file in a run directory.
pub(crate) const CHECKPOINT: &str = "checkpoint.safetensors";
const FORMAT: &str = "occnerf-checkpoint";
const VERSION: &str = "1";
/// Where `motion.shell_interval` is not 0: outer end of the field over each vertex.
const EXTENT: &str = "shell";
const COUNTS: &str = "visibility_counts";
/// Bound for forged files: far from overflow.
const MAX_STEPS: u64 = 1 << 40;

impl Model {
    /// The header of a checkpoint of the scene of that name.
    pub(crate) fn header(&self, scene: &str) -> Result<BTreeMap<&'static str, String>, Error> {
        let config = toml::to_string(&self.config).map_err(|e| Error::Scene(format!("configuration: {e}")))?;
        Ok(BTreeMap::from([
            ("format", FORMAT.to_owned()),
            ("version", VERSION.to_owned()),
            ("steps_done", self.steps_done.to_string()),
            ("scene", scene.to_owned()),
            ("config", config),
        ]))
    }

    /// The arrays of a checkpoint that are the model's own.
    pub(crate) fn arrays(&self) -> Vec<Tensor<'_>> {
        let mut arrays: Vec<Tensor<'_>> =
            PARTS.iter().map(|&(part, name)| array(name, self.parameters.get(part))).collect();
        if self.config.motion.shell_interval > 0 {
            arrays.push(array(EXTENT, &self.extent.vertices));
        }
        arrays.push(array(COUNTS, self.counts.counts()));
        arrays
    }

    /// Reads [`Model::header`] and [`Model::arrays`] from a checkpoint.
    pub(crate) fn restore(&mut self, contents: &Contents<'_>) -> Result<(), Error> {
        let steps = contents.require("steps_done")?;
        self.steps_done = steps.parse().ok().filter(|&steps| steps <= MAX_STEPS).ok_or_else(|| {
            contents.corrupt(format!("header `steps_done` is {steps:?}, expected a whole number up to {MAX_STEPS}"))
        })?;
        for (part, name) in PARTS {
            let values = self.parameters.get_mut(part);
            *values = contents.floats(name, values.len())?;
        }
        let vertices = self.body.canonical.vertices.len();
        self.counts = visibility::VisibilityCounts::from_counts(contents.values(COUNTS, vertices)?);
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
    Contents::parse(path, bytes, FORMAT, &[VERSION])
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
