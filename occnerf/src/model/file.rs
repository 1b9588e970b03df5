//! The safetensors files of a run directory: written whole or not at all, read with every key, type
//! and shape checked.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use array_files::read_bounded;
use array_files::tensors::{self, Number, Tensor, Tensors};

use crate::Error;

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
