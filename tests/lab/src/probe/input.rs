//! Input of a probe: every array is checked, and errors name the key.

use std::ops::RangeInclusive;
use std::path::Path;

use anyhow::{Result, bail, ensure};
use array_files::npz::Npz;
use array_files::{Data, NdArray};
use glam::Vec3;

/// The arrays of an archive that has all the keys it must have, and no other.
pub struct Input {
    npz: Npz,
    file: String,
}

impl Input {
    pub fn open(path: &Path, required: &[&str], optional: &[&str]) -> Result<Self> {
        let npz = Npz::open(path)?;
        let file = npz.file().to_owned();
        let expected = || {
            let optional = optional.iter().map(|key| format!("{key} (optional)"));
            required.iter().map(|&key| key.to_owned()).chain(optional).collect::<Vec<_>>().join(", ")
        };
        for (i, key) in npz.keys().iter().enumerate() {
            if !required.contains(&key.as_str()) && !optional.contains(&key.as_str()) {
                bail!("{file}: unknown array {key:?}, expected {}", expected());
            }
            ensure!(!npz.keys()[..i].contains(key), "{file}: two arrays `{key}`");
        }
        if let Some(missing) = required.iter().find(|key| !npz.keys().iter().any(|k| k == *key)) {
            bail!("{file}: no array `{missing}`, expected {}", expected());
        }
        Ok(Self { npz, file })
    }

    pub fn has(&self, key: &str) -> bool {
        self.npz.keys().iter().any(|k| k == key)
    }

    /// What is wrong with the array `key`.
    pub fn wrong(&self, key: &str, what: &str) -> anyhow::Error {
        anyhow::anyhow!("{}: `{key}` {what}", self.file)
    }

    /// Finite numbers of shape `pattern` (`None`: any size).
    pub fn floats(&mut self, key: &str, pattern: &[Option<usize>]) -> Result<(Vec<usize>, Vec<f32>)> {
        let array = self.npz.array(key)?;
        if matches!(array.data, Data::Bool(_)) {
            return Err(self.wrong(key, "is an array of booleans, expected floats"));
        }
        let values = array.to_f32(&self.file, key, pattern)?;
        Ok((array.shape, values))
    }

    /// Finite numbers of shape `pattern` within `range`.
    pub fn floats_in(
        &mut self,
        key: &str,
        pattern: &[Option<usize>],
        range: RangeInclusive<f32>,
    ) -> Result<(Vec<usize>, Vec<f32>)> {
        let (shape, values) = self.floats(key, pattern)?;
        if let Some((i, value)) = values.iter().enumerate().find(|(_, v)| !range.contains(*v)) {
            let (low, high) = range.into_inner();
            let expected = if high == f32::MAX { format!("at least {low}") } else { format!("{low} to {high}") };
            return Err(self.wrong(key, &format!("is {value} at flat index {i}, expected {expected}")));
        }
        Ok((shape, values))
    }

    /// Points of shape (N, 3).
    pub fn points(&mut self, key: &str) -> Result<Vec<Vec3>> {
        let (_, values) = self.floats(key, &[None, Some(3)])?;
        Ok(vec3s(&values))
    }

    /// A number, of shape () or (1).
    pub fn float(&mut self, key: &str) -> Result<f32> {
        let array = self.scalar(key)?;
        if matches!(array.data, Data::Bool(_)) {
            return Err(self.wrong(key, "is a boolean, expected a float"));
        }
        Ok(array.to_f32(&self.file, key, &[])?[0])
    }

    /// A whole number of shape () or (1) within `range`.
    pub fn integer(&mut self, key: &str, range: RangeInclusive<i64>) -> Result<usize> {
        let array = self.scalar(key)?;
        let Data::I64(values) = &array.data else {
            return Err(self.wrong(key, &format!("is {}, expected an integer", type_name(&array))));
        };
        self.within(key, values[0], &range)
    }

    /// Whole numbers of shape (N) within `range`.
    pub fn integers(&mut self, key: &str, range: RangeInclusive<i64>) -> Result<Vec<usize>> {
        let array = self.npz.array(key)?;
        let Data::I64(_) = &array.data else {
            return Err(self.wrong(key, &format!("is {}, expected integers", type_name(&array))));
        };
        let values = array.to_i64(&self.file, key, &[None])?;
        values.iter().map(|&value| self.within(key, value, &range)).collect()
    }

    /// Booleans of shape (`rows`, `columns`).
    pub fn booleans(&mut self, key: &str, rows: usize, columns: usize) -> Result<Vec<bool>> {
        let array = self.npz.array(key)?;
        let Data::Bool(values) = &array.data else {
            return Err(self.wrong(key, &format!("is {}, expected booleans", type_name(&array))));
        };
        if array.shape != [rows, columns] {
            return Err(self.wrong(key, &format!("has shape {:?}, expected [{rows}, {columns}]", array.shape)));
        }
        Ok(values.clone())
    }

    /// The array `key` of one value, its shape made ().
    fn scalar(&mut self, key: &str) -> Result<NdArray> {
        let mut array = self.npz.array(key)?;
        if array.shape == [1] {
            array.shape.clear();
        }
        if !array.shape.is_empty() {
            return Err(self.wrong(key, &format!("has shape {:?}, expected a single number", array.shape)));
        }
        Ok(array)
    }

    fn within(&self, key: &str, value: i64, range: &RangeInclusive<i64>) -> Result<usize> {
        if !range.contains(&value) {
            let (low, high) = (range.start(), range.end());
            return Err(self.wrong(key, &format!("is {value}, expected {low} to {high}")));
        }
        Ok(usize::try_from(value)?)
    }
}

/// The vectors of an array whose last axis is 3.
pub fn vec3s(values: &[f32]) -> Vec<Vec3> {
    values.as_chunks::<3>().0.iter().copied().map(Vec3::from).collect()
}

fn type_name(array: &NdArray) -> &'static str {
    match array.data {
        Data::F64(_) | Data::F32(_) => "of floats",
        Data::I64(_) => "of integers",
        Data::Bool(_) => "of booleans",
    }
}
