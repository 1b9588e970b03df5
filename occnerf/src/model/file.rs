//! The safetensors files of a run directory: written whole or not at all, read with every key, type
//! and shape checked.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::io::Write;
use std::path::{Path, PathBuf};

use array_files::{read_bounded, replace_file};
use safetensors::tensor::{Dtype, SafeTensors};

use crate::Error;

/// Larger files are not ours: the paper's table with both moments has 0.3 GB.
const MAX_BYTES: u64 = 4 << 30;

/// One array of a file.
pub(crate) enum Array<'a> {
    Floats(Cow<'a, [f32]>),
    Counts(&'a [u64]),
    Bytes(Vec<u8>),
}

impl Array<'_> {
    fn dtype(&self) -> Dtype {
        match self {
            Self::Floats(_) => Dtype::F32,
            Self::Counts(_) => Dtype::U64,
            Self::Bytes(_) => Dtype::U8,
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Floats(values) => values.len(),
            Self::Counts(counts) => counts.len(),
            Self::Bytes(bytes) => bytes.len(),
        }
    }

    fn write(&self, to: &mut impl Write) -> std::io::Result<()> {
        match self {
            Self::Floats(values) => values.iter().try_for_each(|v| to.write_all(&v.to_le_bytes())),
            Self::Counts(counts) => counts.iter().try_for_each(|c| to.write_all(&c.to_le_bytes())),
            Self::Bytes(bytes) => to.write_all(bytes),
        }
    }
}

/// An array's entry in a safetensors header, its keys in order.
#[derive(serde::Serialize)]
struct Entry {
    data_offsets: [usize; 2],
    dtype: Dtype,
    shape: [usize; 1],
}

/// Writes a file array by array, keys in order, so that equal contents are equal files. The old file
/// stays until the new one is complete and on the disk.
pub(crate) fn write(
    path: &Path,
    header: &BTreeMap<&str, String>,
    mut arrays: Vec<(String, Array<'_>)>,
) -> Result<(), Error> {
    // The widest first: all are aligned.
    arrays.sort_by(|(a_name, a), (b_name, b)| b.dtype().cmp(&a.dtype()).then(a_name.cmp(b_name)));
    let write = |to: &mut std::io::BufWriter<std::fs::File>| {
        let mut keys = BTreeMap::from([("__metadata__", serde_json::to_value(header)?)]);
        let mut end = 0;
        for (name, array) in &arrays {
            let start = end;
            end += array.len() * array.dtype().bitsize() / 8;
            let entry = Entry { data_offsets: [start, end], dtype: array.dtype(), shape: [array.len()] };
            keys.insert(name, serde_json::to_value(entry)?);
        }
        let mut text = serde_json::to_vec(&keys)?;
        text.resize(text.len().next_multiple_of(8), b' ');
        to.write_all(&(text.len() as u64).to_le_bytes())?;
        to.write_all(&text)?;
        arrays.iter().try_for_each(|(_, array)| array.write(to))
    };
    replace_file(path, write).map_err(|source| Error::Io { path: path.to_owned(), source })
}

/// The bytes of a file that is not too large to be ours.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, Error> {
    if path.exists() && !path.is_file() {
        return Err(corrupt(path, "is no plain file".to_owned()));
    }
    read_bounded(path, MAX_BYTES).map_err(|source| Error::Io { path: path.to_owned(), source })
}

/// A parsed file.
pub(crate) struct Contents<'a> {
    path: PathBuf,
    header: HashMap<String, String>,
    tensors: SafeTensors<'a>,
}

impl<'a> Contents<'a> {
    /// Takes `bytes` of `path` apart, whose header is to name `format` in one of `versions`.
    pub fn parse(path: &Path, bytes: &'a [u8], format: &str, versions: &[&str]) -> Result<Self, Error> {
        let not_ours = |e: safetensors::SafeTensorError| corrupt(path, format!("is not a whole safetensors file: {e}"));
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(not_ours)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(not_ours)?;
        let header = metadata.metadata().clone().unwrap_or_default();
        let found = |key: &str| header.get(key).map_or("nothing", String::as_str);
        if found("format") != format || !versions.contains(&found("version")) {
            let (is, version, wanted) = (found("format"), found("version"), versions.join(" or "));
            return Err(corrupt(path, format!("is {is} version {version}, expected {format} version {wanted}")));
        }
        Ok(Self { path: path.to_owned(), header, tensors })
    }

    /// An error that names the file.
    pub fn corrupt(&self, what: impl Into<String>) -> Error {
        corrupt(&self.path, what.into())
    }

    /// A key of the header that may be missing.
    pub fn header(&self, key: &str) -> Option<&str> {
        self.header.get(key).map(String::as_str)
    }

    /// A key of the header that has to be there.
    pub fn require(&self, key: &str) -> Result<&str, Error> {
        self.header(key).ok_or_else(|| self.corrupt(format!("header lacks `{key}`")))
    }

    /// Number of entries of an array; 0 where there is none.
    pub fn len(&self, key: &str) -> usize {
        self.tensors.tensor(key).map_or(0, |view| view.shape().iter().product())
    }

    fn bytes_of(&self, key: &str, dtype: Dtype, len: usize) -> Result<&[u8], Error> {
        let view = self.tensors.tensor(key).map_err(|_| self.corrupt(format!("lacks `{key}`")))?;
        if view.dtype() != dtype || view.shape() != [len] {
            let (found, shape) = (view.dtype(), view.shape());
            return Err(self.corrupt(format!("`{key}` is {found:?} {shape:?}, expected {dtype:?} [{len}]")));
        }
        Ok(view.data())
    }

    /// `len` bytes.
    pub fn bytes(&self, key: &str, len: usize) -> Result<&[u8], Error> {
        self.bytes_of(key, Dtype::U8, len)
    }

    /// `len` finite numbers.
    pub fn floats(&self, key: &str, len: usize) -> Result<Vec<f32>, Error> {
        let bytes = self.bytes_of(key, Dtype::F32, len)?;
        let values: Vec<f32> = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        match values.iter().position(|v| !v.is_finite()) {
            Some(at) => Err(self.corrupt(format!("`{key}` is {} at {at}, expected finite numbers", values[at]))),
            None => Ok(values),
        }
    }

    /// `len` counts.
    pub fn counts(&self, key: &str, len: usize) -> Result<Vec<u64>, Error> {
        let bytes = self.bytes_of(key, Dtype::U64, len)?.chunks_exact(8);
        Ok(bytes.map(|b| b.iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte))).collect())
    }
}

fn corrupt(path: &Path, what: String) -> Error {
    Error::File { path: path.to_owned(), what }
}
