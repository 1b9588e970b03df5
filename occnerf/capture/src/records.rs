//! Pickled dictionaries of arrays; errors name file, frame and key.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use array_files::pickle::{self, Value};
use array_files::{Data, NdArray};
use glam::Vec3;

use super::CaptureError;
use super::names::FrameName;

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
    pub fn load(path: &Path) -> Result<Self, CaptureError> {
        if !path.is_file() {
            return Err(CaptureError::missing(path, "file"));
        }
        Self::new(path, pickle::read(path)?)
    }

    /// A dictionary that came from `path`.
    pub fn new(path: &Path, root: Value) -> Result<Self, CaptureError> {
        if !matches!(root, Value::Dict(_)) {
            let expected = "a dictionary";
            return Err(CaptureError::invalid(path, "the pickle", expected, root.type_name()));
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

    /// The frames in the order of their names; at least one.
    pub fn frames(&self) -> Result<BTreeMap<FrameName<'_>, Record<'_>>, CaptureError> {
        let mut frames = BTreeMap::new();
        if let Value::Dict(items) = &self.root {
            for (key, value) in items {
                let name = key
                    .as_str()
                    .ok_or_else(|| CaptureError::invalid(&self.path, "a key", "a frame's name", key.type_name()))?;
                frames.insert(FrameName(name), self.dictionary(name, value)?);
            }
        }
        if frames.is_empty() {
            return Err(CaptureError::invalid(&self.path, "all frames", "a frame", "an empty dictionary"));
        }
        Ok(frames)
    }

    /// The dictionary under `key`.
    pub fn record(&self, key: &str) -> Result<Record<'_>, CaptureError> {
        let value = self.whole().value(key)?;
        self.dictionary(key, value)
    }

    fn dictionary<'a>(&'a self, key: &str, value: &'a Value) -> Result<Record<'a>, CaptureError> {
        if !matches!(value, Value::Dict(_)) {
            return Err(CaptureError::invalid(&self.path, key, "a dictionary", value.type_name()));
        }
        Ok(Record { path: &self.path, prefix: format!("{key}."), value })
    }
}

impl<'a> Record<'a> {
    /// The value under `key`.
    pub fn value(&self, key: &str) -> Result<&'a Value, CaptureError> {
        self.value.get(key).ok_or_else(|| {
            let held: Vec<&str> = match self.value {
                Value::Dict(items) => items.iter().filter_map(|(k, _)| k.as_str()).take(20).collect(),
                _ => Vec::new(),
            };
            self.invalid(key, "this key", format!("no such key (it has {})", held.join(", ")))
        })
    }

    /// `key` with its frame, for errors.
    pub fn full(&self, key: &str) -> String {
        format!("{}{key}", self.prefix)
    }

    pub fn invalid(&self, key: &str, expected: impl Into<String>, actual: impl Into<String>) -> CaptureError {
        CaptureError::invalid(self.path, self.full(key), expected, actual)
    }

    pub fn has(&self, key: &str) -> bool {
        !matches!(self.value.get(key), None | Some(Value::None))
    }

    /// Finite values, row-major, and the shape, of an array or of nested lists. Axes of length 1 in
    /// front are dropped: raw files store vectors as (1, N).
    pub fn array(&self, key: &str) -> Result<(Vec<usize>, Vec<f32>), CaptureError> {
        let (mut shape, values) = self.stacked(key)?;
        while shape.len() > 1 && shape[0] == 1 {
            shape.remove(0);
        }
        Ok((shape, values))
    }

    /// [`Record::array`] with all its axes.
    pub fn stacked(&self, key: &str) -> Result<(Vec<usize>, Vec<f32>), CaptureError> {
        let file = self.path.display().to_string();
        let full = self.full(key);
        let array = stack(self.value(key)?, &file, &full)
            .and_then(|array| array.map_err(|actual| self.invalid(key, "an array", actual)))?;
        let any = vec![None; array.shape.len()];
        let values = array.to_f32(&file, &full, &any)?;
        Ok((array.shape, values))
    }

    /// [`Record::array`] of exactly this shape; `what` is the reason in the error.
    pub fn shaped(&self, key: &str, shape: &[usize], what: &str) -> Result<Vec<f32>, CaptureError> {
        let (actual, values) = self.array(key)?;
        if actual != shape {
            return Err(self.invalid(key, format!("shape {shape:?}{what}"), format!("shape {actual:?}")));
        }
        Ok(values)
    }

    pub fn vec3(&self, key: &str) -> Result<Vec3, CaptureError> {
        Ok(Vec3::from_slice(&self.shaped(key, &[3], "")?))
    }
}

/// An array, or nested lists of arrays stacked; the inner error is the actual type. Pickles bound the
/// depth.
fn stack(value: &Value, file: &str, key: &str) -> Result<Result<NdArray, String>, CaptureError> {
    if let Some(array) = value.to_dense(file, key)? {
        return Ok(Ok(array));
    }
    let scalar = |number| Ok(Ok(NdArray { shape: Vec::new(), data: Data::F64(vec![number]) }));
    let items = match value {
        Value::Int(number) => return scalar(*number as f64),
        Value::Float(number) => return scalar(*number),
        _ => value.items(),
    };
    let Some(items) = items else { return Ok(Err(value.type_name().to_owned())) };
    let (mut shape, mut values) = (None, Vec::new());
    for (i, item) in items.iter().enumerate() {
        let array = match stack(item, file, key)? {
            Ok(array) => array,
            Err(inner) => return Ok(Err(format!("{inner} in a {}", value.type_name()))),
        };
        let first = shape.get_or_insert_with(|| array.shape.clone());
        if *first != array.shape {
            return Ok(Err(format!("item {i} of shape {:?} after {first:?}", array.shape)));
        }
        values.extend(array.to_f64());
    }
    let mut whole = vec![items.len()];
    whole.extend(shape.unwrap_or_default());
    Ok(Ok(NdArray { shape: whole, data: Data::F64(values) }))
}

/// Groups of three numbers.
pub(super) fn triples(values: &[f32]) -> Vec<Vec3> {
    values.chunks_exact(3).map(Vec3::from_slice).collect()
}
