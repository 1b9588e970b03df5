//! The safetensors files of a run directory, written whole or not at all, read with every key, type
//! and shape checked; and the model's part of a checkpoint: configuration, values, counts and the
//! field's outer end. The trainer adds the state of the optimiser.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use array_files::read_bounded;
use array_files::tensors::{self, Number, Tensor, Tensors};

use crate::Error;
use crate::config::Config;
use crate::model::extent::Extent;
use crate::model::field::PARTS;
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

/// Larger files are not ours: the paper's table with both moments has 0.3 GB.
const MAX_BYTES: u64 = 4 << 30;

/// The bytes of a file that is not too large to be ours.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, Error> {
    if path.exists() && !path.is_file() {
        return Err(corrupt(path, "is no plain file".to_owned()));
    }
    read_bounded(path, MAX_BYTES).map_err(|source| Error::Io { path: path.to_owned(), source })
}

/// A named array of one axis.
pub(crate) fn array<'a, T: Number + 'a>(name: impl Into<String>, values: impl Into<Cow<'a, [T]>>) -> Tensor<'a> {
    let values = values.into();
    Tensor::new(name, &[values.len()], values)
}

/// Writes a file; equal contents are equal files. The old file stays until the new one is complete
/// and on the disk.
pub(crate) fn write(path: &Path, header: &BTreeMap<&str, String>, tensors: Vec<Tensor<'_>>) -> Result<(), Error> {
    tensors::write(path, header, tensors).map_err(|source| Error::Io { path: path.to_owned(), source })
}

/// A parsed file.
pub(crate) struct Contents<'a> {
    path: PathBuf,
    tensors: Tensors<'a>,
}

impl<'a> Contents<'a> {
    /// Takes `bytes` of `path` apart, whose header is to name `format` in one of `versions`.
    pub fn parse(path: &Path, bytes: &'a [u8], format: &str, versions: &[&str]) -> Result<Self, Error> {
        let tensors = Tensors::parse(&path.display().to_string(), bytes)?;
        let [is, version] = ["format", "version"].map(|key| tensors.header(key).unwrap_or("nothing"));
        if is != format || !versions.contains(&version) {
            let wanted = versions.join(" or ");
            return Err(corrupt(path, format!("is {is} version {version}, expected {format} version {wanted}")));
        }
        Ok(Self { path: path.to_owned(), tensors })
    }

    /// An error that names the file.
    pub fn corrupt(&self, what: impl Into<String>) -> Error {
        corrupt(&self.path, what.into())
    }

    /// A key of the header that may be missing.
    pub fn header(&self, key: &str) -> Option<&str> {
        self.tensors.header(key)
    }

    /// A key of the header that has to be there.
    pub fn require(&self, key: &str) -> Result<&str, Error> {
        self.header(key).ok_or_else(|| self.corrupt(format!("header lacks `{key}`")))
    }

    /// Number of entries of an array; 0 where there is none.
    pub fn len(&self, key: &str) -> usize {
        self.tensors.shape(key).map_or(0, |shape| shape.iter().product())
    }

    /// `len` values.
    pub fn values<T: Number>(&self, key: &str, len: usize) -> Result<Vec<T>, Error> {
        Ok(self.tensors.read(key, &[Some(len)])?)
    }

    /// `len` finite numbers.
    pub fn floats(&self, key: &str, len: usize) -> Result<Vec<f32>, Error> {
        let values: Vec<f32> = self.values(key, len)?;
        match values.iter().position(|v| !v.is_finite()) {
            Some(at) => Err(self.corrupt(format!("`{key}` is {} at {at}, expected finite numbers", values[at]))),
            None => Ok(values),
        }
    }
}

fn corrupt(path: &Path, what: String) -> Error {
    Error::File { path: path.to_owned(), what }
}
