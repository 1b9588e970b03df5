//! Collecting what a probe computed.

use std::path::Path;

use anyhow::{Result, bail, ensure};
use array_files::npz::{self, MAX_ARRAY_BYTES};
use array_files::{Data, NdArray};
use glam::Vec3;

/// Named arrays, written together at the end.
#[derive(Default)]
pub struct Output {
    arrays: Vec<(String, NdArray)>,
}

/// Number of values of an output of this shape, if it is small enough to be written; asked before
/// it is computed.
pub fn count(key: &str, shape: &[usize]) -> Result<usize> {
    // The widest values have eight bytes.
    let most = MAX_ARRAY_BYTES as usize / 8;
    let product = shape.iter().try_fold(1usize, |n, &extent| n.checked_mul(extent));
    match product {
        Some(n) if n <= most => Ok(n),
        _ => bail!("`{key}` would have shape {shape:?}, more than {most} values"),
    }
}

impl Output {
    /// Numbers that must have come out finite.
    pub fn floats(&mut self, key: &str, shape: &[usize], values: Vec<f32>) -> Result<()> {
        if let Some(i) = values.iter().position(|x| !x.is_finite()) {
            bail!("`{key}` overflows at flat index {i}: the numbers given are too large");
        }
        self.numbers(key, shape, values)
    }

    /// Numbers, possibly infinite or NaN.
    pub fn numbers(&mut self, key: &str, shape: &[usize], values: Vec<f32>) -> Result<()> {
        self.push(key, shape, Data::F32(values))
    }

    pub fn vectors(&mut self, key: &str, shape: &[usize], values: &[Vec3]) -> Result<()> {
        self.floats(key, shape, values.iter().flat_map(|v| v.to_array()).collect())
    }

    pub fn indices(&mut self, key: &str, shape: &[usize], values: impl IntoIterator<Item = u32>) -> Result<()> {
        self.push(key, shape, Data::I64(values.into_iter().map(i64::from).collect()))
    }

    pub fn booleans(&mut self, key: &str, shape: &[usize], values: Vec<bool>) -> Result<()> {
        self.push(key, shape, Data::Bool(values))
    }

    fn push(&mut self, key: &str, shape: &[usize], data: Data) -> Result<()> {
        let array = NdArray { shape: shape.to_vec(), data };
        ensure!(shape.iter().product::<usize>() == array.len(), "`{key}`: {} values for {shape:?}", array.len());
        self.arrays.push((key.to_owned(), array));
        Ok(())
    }

    pub fn write(self, path: &Path) -> Result<()> {
        Ok(npz::write(path, &self.arrays)?)
    }
}
