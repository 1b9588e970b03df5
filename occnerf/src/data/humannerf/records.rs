//! Pickled dictionaries of arrays, with errors that name file, frame and key.

use std::path::{Path, PathBuf};

use glam::Vec3;
use smpl::pickle::{self, Value};

use crate::data::DataError;

/// A pickle whose root is a dictionary.
pub(super) struct Records {
    path: PathBuf,
    root: Value,
}

/// One dictionary of arrays.
pub(super) struct Record<'a> {
    /// The pickle.
    pub path: &'a Path,
    /// The frame, with a dot behind it; empty for the pickle as a whole.
    prefix: String,
    value: &'a Value,
}

impl Records {
    pub fn load(path: &Path) -> Result<Self, DataError> {
        if !path.is_file() {
            return Err(DataError::missing(path, "file"));
        }
        let root = pickle::read(path)?;
        if !matches!(root, Value::Dict(_)) {
            let expected = "a dictionary";
            return Err(DataError::invalid(path, "the pickle", expected, root.type_name()));
        }
        Ok(Self { path: path.to_owned(), root })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The pickle itself as a record.
    pub fn whole(&self) -> Record<'_> {
        Record { path: &self.path, prefix: String::new(), value: &self.root }
    }

    /// Names of the frames, sorted; at least one.
    pub fn names(&self) -> Result<Vec<&str>, DataError> {
        let Value::Dict(items) = &self.root else {
            return Ok(Vec::new());
        };
        let mut names = Vec::with_capacity(items.len());
        for (key, _) in items {
            names.push(
                key.as_str()
                    .ok_or_else(|| DataError::invalid(&self.path, "a key", "a frame's name", key.type_name()))?,
            );
        }
        names.sort_unstable();
        names.dedup();
        if names.is_empty() {
            return Err(DataError::invalid(&self.path, "the pickle", "a frame", "an empty dictionary"));
        }
        Ok(names)
    }

    /// The dictionary of frame `name`.
    pub fn record(&self, name: &str) -> Result<Record<'_>, DataError> {
        let error = |actual: &str| DataError::invalid(&self.path, name, "a dictionary for this frame", actual);
        let value = self.root.get(name).ok_or_else(|| error("no such key"))?;
        if !matches!(value, Value::Dict(_)) {
            return Err(error(value.type_name()));
        }
        Ok(Record { path: &self.path, prefix: format!("{name}."), value })
    }
}

impl Record<'_> {
    /// `key` with its frame, for errors.
    pub fn full(&self, key: &str) -> String {
        format!("{}{key}", self.prefix)
    }

    pub fn invalid(&self, key: &str, expected: impl Into<String>, actual: impl Into<String>) -> DataError {
        DataError::invalid(self.path, self.full(key), expected, actual)
    }

    pub fn has(&self, key: &str) -> bool {
        !matches!(self.value.get(key), None | Some(Value::None))
    }

    /// Finite values, row-major, and the shape. Axes of length 1 in front are dropped: raw files store vectors as
    /// (1, N).
    pub fn array(&self, key: &str) -> Result<(Vec<usize>, Vec<f32>), DataError> {
        let file = self.path.display().to_string();
        let full = self.full(key);
        let value = self.value.get(key).ok_or_else(|| {
            let held: Vec<&str> = match self.value {
                Value::Dict(items) => items.iter().filter_map(|(k, _)| k.as_str()).collect(),
                _ => Vec::new(),
            };
            self.invalid(key, "an array", format!("no such key (it has {})", held.join(", ")))
        })?;
        let array = value.to_dense(&file, &full)?.ok_or_else(|| self.invalid(key, "an array", value.type_name()))?;
        let any = vec![None; array.shape.len()];
        let values = array.to_f32(&file, &full, &any)?;
        let mut shape = array.shape;
        while shape.len() > 1 && shape[0] == 1 {
            shape.remove(0);
        }
        Ok((shape, values))
    }

    /// [`Record::array`] of exactly this shape; `what` says why the shape is expected.
    pub fn shaped(&self, key: &str, shape: &[usize], what: &str) -> Result<Vec<f32>, DataError> {
        let (actual, values) = self.array(key)?;
        if actual != shape {
            return Err(self.invalid(key, format!("shape {shape:?}{what}"), format!("shape {actual:?}")));
        }
        Ok(values)
    }

    pub fn vec3(&self, key: &str) -> Result<Vec3, DataError> {
        Ok(Vec3::from_slice(&self.shaped(key, &[3], "")?))
    }
}

/// Groups of three numbers.
pub(super) fn triples(values: &[f32]) -> Vec<Vec3> {
    values.chunks_exact(3).map(Vec3::from_slice).collect()
}
