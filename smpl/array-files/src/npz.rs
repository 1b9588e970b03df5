//! numpy's `.npy` and `.npz`: readers with limits, and a writer.
//!
//! Memory grows with the bytes that arrive, not with the sizes that headers claim, and never beyond
//! [`MAX_ARRAY_BYTES`] for one array.

use std::fmt;
use std::io::{Cursor, Write};
use std::path::Path;

use zip::read::ZipFile;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::Error;
use crate::array::NdArray;
use crate::element::{byte_count, encode};
use crate::file::{read_file, read_limited, unpacked_limit};
use crate::npy::{header, read_array};
use crate::pickle::{self, Value};

pub use crate::npy::MAX_ARRAY_BYTES;

/// Reads a `.npy` file of plain values; [`pickle::read`] reads arrays of Python objects too.
///
/// # Errors
/// [`Error::Io`], [`Error::Invalid`] and [`Error::Npy`], with an empty key.
pub fn read_npy(path: &Path) -> Result<NdArray, Error> {
    let bytes = read_file(path)?;
    read_array(&path.display().to_string(), "", bytes.as_slice())
}

/// Open `.npz` archive, held in memory as it is compressed; arrays are decoded when asked for.
///
/// ```
/// use array_files::npz::{self, Npz};
/// use array_files::{Data, NdArray, read_file};
///
/// # let path = std::env::temp_dir().join("array-files-npz.npz");
/// let faces = NdArray { shape: vec![1, 3], data: Data::I64(vec![0, 1, 2]) };
/// npz::write(&path, &[("f", faces.clone())])?;
/// let mut body = Npz::from_bytes("body.npz", read_file(&path)?)?;
/// assert_eq!(body.array("f")?, faces);
/// let error = body.array("weights").unwrap_err();
/// assert_eq!(error.to_string(), "body.npz: `weights`: missing, the file holds f");
/// # std::fs::remove_file(&path).unwrap();
/// # Ok::<(), array_files::Error>(())
/// ```
#[derive(Clone)]
pub struct Npz {
    file: String,
    archive: ZipArchive<Cursor<Vec<u8>>>,
    keys: Vec<String>,
}

impl fmt::Debug for Npz {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Npz").field("file", &self.file).field("keys", &self.keys).finish_non_exhaustive()
    }
}

impl Npz {
    /// Opens the archive at `path`.
    ///
    /// # Errors
    /// [`Error::Io`], also beyond 2 GiB; [`Error::Npy`] if it is no zip archive.
    pub fn open(path: &Path) -> Result<Self, Error> {
        Self::from_bytes(&path.display().to_string(), read_file(path)?)
    }

    /// Opens an archive in memory; `file` names it in errors.
    ///
    /// # Errors
    /// [`Error::Npy`] if it is no zip archive.
    pub fn from_bytes(file: &str, bytes: Vec<u8>) -> Result<Self, Error> {
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|e| Error::npy(file, "", e))?;
        let mut keys = Vec::with_capacity(archive.len());
        for name in archive.file_names() {
            let name = name.map_err(|e| Error::npy(file, "", e))?;
            keys.push(name.strip_suffix(".npy").unwrap_or(&name).to_owned());
        }
        Ok(Self { file: file.to_owned(), archive, keys })
    }

    /// The file's name in errors.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// Names of the arrays, in the archive's order.
    pub fn keys(&self) -> &[String] {
        &self.keys
    }

    /// Reads the array `key` of booleans, integers or floats.
    ///
    /// # Errors
    /// [`Error::Invalid`] if it is missing, too large or of another element type, [`Error::Npy`].
    pub fn array(&mut self, key: &str) -> Result<NdArray, Error> {
        let file = self.file.clone();
        read_array(&file, key, self.entry(key)?)
    }

    /// Reads `key`, an array of plain values or of pickled objects.
    ///
    /// # Errors
    /// Those of [`Npz::array`]; [`Error::Pickle`]; [`Error::Invalid`] for an entry that expands by
    /// more than a factor of 256 and 64 MiB.
    pub fn value(&mut self, key: &str) -> Result<Value, Error> {
        let file = format!("{}: `{key}`", self.file);
        let entry = self.entry(key)?;
        let limit = unpacked_limit(entry.compressed_size());
        let bytes = read_limited(entry, 0, limit).map_err(|e| Error::npy(&file, "", e))?;
        let bytes = bytes.ok_or_else(|| Error::too_large(&file, key, u128::from(limit) + 1, limit))?;
        pickle::from_bytes(&file, bytes)
    }

    fn entry(&mut self, key: &str) -> Result<ZipFile<'_, Cursor<Vec<u8>>>, Error> {
        let index = self.keys.iter().position(|k| k == key);
        let index = index.ok_or_else(|| Error::missing(&self.file, key, &self.keys))?;
        self.archive.by_index(index).map_err(|e| Error::npy(&self.file, key, e))
    }

    /// Shape and finite row-major values of the array `key`, if the shape fits `pattern` (`None`:
    /// any extent).
    ///
    /// # Errors
    /// Those of [`Npz::array`] and [`NdArray::to_f32`].
    pub fn f32(&mut self, key: &str, pattern: &[Option<usize>]) -> Result<(Vec<usize>, Vec<f32>), Error> {
        let array = self.array(key)?;
        let values = array.to_f32(&self.file, key, pattern)?;
        Ok((array.shape, values))
    }

    /// Shape and row-major values of the integer array `key`, if the shape fits `pattern` (`None`:
    /// any extent).
    ///
    /// # Errors
    /// Those of [`Npz::array`] and [`NdArray::to_i64`].
    pub fn i64(&mut self, key: &str, pattern: &[Option<usize>]) -> Result<(Vec<usize>, Vec<i64>), Error> {
        let array = self.array(key)?;
        let values = array.to_i64(&self.file, key, pattern)?;
        Ok((array.shape, values))
    }
}

/// Writes an uncompressed `.npz` of named arrays, as numpy's `savez`. Equal arrays give equal
/// bytes.
///
/// # Errors
/// [`Error::Io`]; [`Error::Invalid`] for a shape that does not match the number of values;
/// [`Error::Npy`] for a duplicate name.
pub fn write<K: AsRef<str>>(path: &Path, arrays: &[(K, NdArray)]) -> Result<(), Error> {
    write_with_text(path, arrays, &[])
}

/// [`write()`] with scalar strings (numpy's `str_`) behind the arrays.
///
/// # Errors
/// Those of [`write()`].
pub fn write_with_text<K: AsRef<str>>(
    path: &Path,
    arrays: &[(K, NdArray)],
    texts: &[(&str, &str)],
) -> Result<(), Error> {
    let file = path.display().to_string();
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let mut put = |key: &str, descr: &str, shape: &[usize], data: &[u8]| {
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        archive.start_file(format!("{key}.npy"), options).map_err(|e| Error::npy(&file, key, e))?;
        archive.write_all(&header(descr, shape)).and_then(|()| archive.write_all(data)).map_err(Error::io(path))
    };
    for (key, array) in arrays {
        let (key, shape) = (key.as_ref(), &array.shape);
        if byte_count(shape, 1) != Some(array.len() as u128) {
            return Err(Error::invalid(&file, key, format!("{} values for shape {shape:?}", array.len())));
        }
        let (descr, data) = encode(&array.data);
        put(key, descr, shape, &data)?;
    }
    for (key, text) in texts {
        let letters: Vec<u8> = text.chars().flat_map(|c| u32::from(c).to_le_bytes()).collect();
        put(key, &format!("<U{}", letters.len() / 4), &[], &letters)?;
    }
    let bytes = archive.finish().map_err(|e| Error::npy(&file, "", e))?.into_inner();
    crate::replace_file(path, |to| to.write_all(&bytes)).map_err(Error::io(path))
}
