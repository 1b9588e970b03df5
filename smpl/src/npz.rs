//! Numpy's `.npy` and `.npz`: reading, with limits and errors that name the file and the array, and
//! writing.
//!
//! Headers are not believed: memory grows with the bytes that really arrive, and never beyond
//! [`MAX_ARRAY_BYTES`] for one array.

use std::io::{Cursor, Read, Write};
use std::path::Path;

use zip::read::ZipFile;
use zip::result::ZipError;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::Error;
use crate::array::{NdArray, element_count};
use crate::npy::{read_array, read_file};
use crate::pickle::{self, Value, unpacked_limit};

pub use crate::npy::{MAX_ARRAY_BYTES, read_npy};

/// An open `.npz` archive, held in memory in its compressed form.
pub struct Npz {
    file: String,
    archive: ZipArchive<Cursor<Vec<u8>>>,
    keys: Vec<String>,
}

impl Npz {
    /// Opens the archive at `path`.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::TooLarge`] beyond 2 GiB, and [`Error::Npy`] if it is no zip archive.
    pub fn open(path: &Path) -> Result<Self, Error> {
        Self::from_bytes(&path.display().to_string(), read_file(path)?)
    }

    /// Opens an archive in memory; `file` names them in errors.
    ///
    /// # Errors
    /// [`Error::Npy`] if they are no zip archive.
    pub fn from_bytes(file: &str, bytes: Vec<u8>) -> Result<Self, Error> {
        let malformed = |message: String| Error::Npy { file: file.to_owned(), key: String::new(), message };
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| malformed(e.to_string()))?;
        let mut keys = Vec::with_capacity(archive.len());
        for name in archive.file_names() {
            let name = name.map_err(|e| malformed(e.to_string()))?;
            keys.push(name.strip_suffix(".npy").unwrap_or(&name).to_owned());
        }
        Ok(Self { file: file.to_owned(), archive, keys })
    }

    /// The name used in errors.
    #[must_use]
    pub fn file(&self) -> &str {
        &self.file
    }

    /// Names of the arrays, in the archive's order.
    #[must_use]
    pub fn keys(&self) -> &[String] {
        &self.keys
    }

    /// Reads the array `key`.
    ///
    /// # Errors
    /// [`Error::MissingKey`], [`Error::TooLarge`], [`Error::Type`] for element types other than
    /// booleans, integers and floats, and [`Error::Npy`] for anything malformed.
    pub fn array(&mut self, key: &str) -> Result<NdArray, Error> {
        let file = self.file.clone();
        read_array(&file, key, self.entry(key)?)
    }

    /// Reads `key` whatever its elements are: numbers, text, or pickled Python objects
    /// ([`crate::pickle`]).
    ///
    /// # Errors
    /// Those of [`Npz::array`]; [`Error::Pickle`]; [`Error::TooLarge`] for what compression makes
    /// more than 256 times as large and 64 MiB.
    pub fn value(&mut self, key: &str) -> Result<Value, Error> {
        let file = format!("{}: `{key}`", self.file);
        let entry = self.entry(key)?;
        let limit = unpacked_limit(entry.compressed_size());
        let malformed =
            |e: std::io::Error| Error::Npy { file: file.clone(), key: String::new(), message: e.to_string() };
        let mut bytes = Vec::new();
        entry.take(limit + 1).read_to_end(&mut bytes).map_err(malformed)?;
        if bytes.len() as u64 > limit {
            return Err(Error::TooLarge { file, key: key.to_owned(), claimed: bytes.len() as u128, limit });
        }
        pickle::from_bytes(&file, bytes)
    }

    fn entry(&mut self, key: &str) -> Result<ZipFile<'_, Cursor<Vec<u8>>>, Error> {
        let Some(index) = self.keys.iter().position(|k| k == key) else {
            return Err(Error::MissingKey {
                file: self.file.clone(),
                key: key.to_owned(),
                available: self.keys.clone(),
            });
        };
        let malformed =
            |e: ZipError| Error::Npy { file: self.file.clone(), key: key.to_owned(), message: e.to_string() };
        self.archive.by_index(index).map_err(malformed)
    }

    /// Reads the array `key` as finite `f32` of shape `pattern` (`None`: any size): its shape and
    /// its values, row-major.
    ///
    /// # Errors
    /// Those of [`Npz::array`] and [`NdArray::to_f32`].
    pub fn f32(&mut self, key: &str, pattern: &[Option<usize>]) -> Result<(Vec<usize>, Vec<f32>), Error> {
        let array = self.array(key)?;
        let values = array.to_f32(&self.file, key, pattern)?;
        Ok((array.shape, values))
    }

    /// Reads the array `key` as integers of shape `pattern` (`None`: any size): its shape and its
    /// values, row-major.
    ///
    /// # Errors
    /// Those of [`Npz::array`] and [`NdArray::to_i64`].
    pub fn i64(&mut self, key: &str, pattern: &[Option<usize>]) -> Result<(Vec<usize>, Vec<i64>), Error> {
        let array = self.array(key)?;
        let values = array.to_i64(&self.file, key, pattern)?;
        Ok((array.shape, values))
    }
}

/// Writes an uncompressed `.npz` of named arrays, as numpy's `savez` does. The same arrays give the
/// same bytes.
///
/// # Errors
/// [`Error::Io`]; [`Error::Invalid`] for an array whose shape does not fit its values;
/// [`Error::Npy`] for two of one name.
pub fn write<K: AsRef<str>>(path: &Path, arrays: &[(K, NdArray)]) -> Result<(), Error> {
    write_with_text(path, arrays, &[])
}

/// [`write()`] with scalar strings besides, as numpy's `str_`.
///
/// # Errors
/// As [`write()`].
pub fn write_with_text<K: AsRef<str>>(
    path: &Path,
    arrays: &[(K, NdArray)],
    texts: &[(&str, &str)],
) -> Result<(), Error> {
    let file = path.display().to_string();
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (key, array) in arrays {
        let key = key.as_ref();
        if element_count(&array.shape) != Some(array.len() as u128) {
            let message = format!("{} values for shape {:?}", array.len(), array.shape);
            return Err(Error::invalid(&file, key, message));
        }
        let malformed = |message: String| Error::Npy { file: file.clone(), key: key.to_owned(), message };
        archive.start_file(format!("{key}.npy"), options).map_err(|e| malformed(e.to_string()))?;
        let io = |source| Error::Io { path: path.to_owned(), source };
        let head = header(array.data.descr(), &array.shape);
        archive.write_all(&head).and_then(|()| array.data.write(&mut archive)).map_err(io)?;
    }
    for &(key, text) in texts {
        let malformed = |message: String| Error::Npy { file: file.clone(), key: key.to_owned(), message };
        archive.start_file(format!("{key}.npy"), options).map_err(|e| malformed(e.to_string()))?;
        let letters: Vec<u8> = text.chars().flat_map(|c| u32::from(c).to_le_bytes()).collect();
        let head = header(&format!("<U{}", letters.len() / 4), &[]);
        let io = |source| Error::Io { path: path.to_owned(), source };
        archive.write_all(&head).and_then(|()| archive.write_all(&letters)).map_err(io)?;
    }
    let whole = |e: ZipError| Error::Npy { file: file.clone(), key: String::new(), message: e.to_string() };
    let bytes = archive.finish().map_err(whole)?.into_inner();
    std::fs::write(path, bytes).map_err(|source| Error::Io { path: path.to_owned(), source })
}

/// Magic, version 1.0 and the dict literal, padded so that the data begin at a multiple of 64
/// bytes.
fn header(descr: &str, shape: &[usize]) -> Vec<u8> {
    let extents: Vec<String> = shape.iter().map(usize::to_string).collect();
    // A tuple of one needs its comma.
    let comma = if extents.len() == 1 { "," } else { "" };
    let text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({}{comma}), }}", extents.join(", "));
    let length = (10 + text.len() + 1).next_multiple_of(64) - 10;
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((length as u16).to_le_bytes());
    out.extend(format!("{text:<width$}\n", width = length - 1).into_bytes());
    out
}
