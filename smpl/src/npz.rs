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
use crate::array::{ElementType, NdArray, element_count};
use crate::pickle::{self, Value, unpacked_limit};

/// Largest array that is read, in bytes of the file and of memory: 1 GiB.
pub const MAX_ARRAY_BYTES: u64 = 1 << 30;

/// Largest file that is read, in bytes: 2 GiB.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 31;

/// Longest header text that is read. numpy's own limit is 10 000 characters.
const MAX_HEADER_BYTES: usize = 1 << 16;

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

    /// Reads `key` whatever its elements are: numbers, text, or pickled Python objects ([`crate::pickle`]).
    ///
    /// # Errors
    /// Those of [`Npz::array`]; [`Error::Pickle`]; [`Error::TooLarge`] for what compression makes more than 256 times as
    /// large and 64 MiB.
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

/// Reads a `.npy` file of plain values. For arrays of Python objects see [`crate::pickle::read`].
///
/// # Errors
/// [`Error::Io`], [`Error::TooLarge`], [`Error::Type`] and [`Error::Npy`]; the key in them is
/// empty.
pub fn read_npy(path: &Path) -> Result<NdArray, Error> {
    let bytes = read_file(path)?;
    read_array(&path.display().to_string(), "", bytes.as_slice())
}

/// The whole file, if it is not too large. Devices and pipes, which have no length, are read up to
/// the limit.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>, Error> {
    let io = |source| Error::Io { path: path.to_owned(), source };
    let file = std::fs::File::open(path).map_err(io)?;
    let mut length = file.metadata().map_err(io)?.len();
    let mut bytes = Vec::new();
    if length <= MAX_FILE_BYTES {
        bytes.reserve_exact(length as usize);
        length = file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes).map_err(io)? as u64;
    }
    if length > MAX_FILE_BYTES {
        return Err(Error::TooLarge {
            file: path.display().to_string(),
            key: String::new(),
            claimed: u128::from(length),
            limit: MAX_FILE_BYTES,
        });
    }
    Ok(bytes)
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

/// [`write`] with scalar strings besides, as numpy's `str_`.
///
/// # Errors
/// As [`write`].
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

/// Type, order and shape that precede the data of a `.npy` file.
pub(crate) struct NpyHeader {
    /// numpy's type string, `|O` for pickled objects.
    pub(crate) descr: String,
    pub(crate) fortran: bool,
    pub(crate) shape: Vec<usize>,
}

/// Reads magic, version and header text, leaving `reader` at the data.
pub(crate) fn read_header(file: &str, key: &str, reader: &mut impl Read) -> Result<NpyHeader, Error> {
    let malformed = |message: String| Error::Npy { file: file.to_owned(), key: key.to_owned(), message };
    let truncated = |e: std::io::Error| malformed(format!("header: {e}"));
    let mut start = [0u8; 8];
    reader.read_exact(&mut start).map_err(truncated)?;
    if start[..6] != *b"\x93NUMPY" {
        return Err(malformed("no numpy magic".to_owned()));
    }
    let length = if start[6] == 1 {
        let mut length = [0u8; 2];
        reader.read_exact(&mut length).map_err(truncated)?;
        usize::from(u16::from_le_bytes(length))
    } else if start[6] <= 3 {
        let mut length = [0u8; 4];
        reader.read_exact(&mut length).map_err(truncated)?;
        u32::from_le_bytes(length) as usize
    } else {
        return Err(malformed(format!("format version {}", start[6])));
    };
    if length > MAX_HEADER_BYTES {
        return Err(malformed(format!("header of {length} bytes")));
    }
    let mut text = vec![0u8; length];
    reader.read_exact(&mut text).map_err(truncated)?;
    let text = String::from_utf8(text).map_err(|_| malformed("header is not UTF-8".to_owned()))?;
    parse_header(&text).ok_or_else(|| malformed(format!("header {:?}", text.trim_end())))
}

/// The dict literal `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }`, keys in any
/// order.
fn parse_header(text: &str) -> Option<NpyHeader> {
    let body = text.trim().strip_prefix('{')?.strip_suffix('}')?;
    let (mut descr, mut fortran, mut shape) = (None, None, None);
    let mut rest = body.trim_start();
    while !rest.is_empty() {
        let (key, after) = quoted(rest)?;
        let after = after.trim_start().strip_prefix(':')?.trim_start();
        rest = match key {
            "descr" => {
                let (value, after) = quoted(after)?;
                descr = Some(value.to_owned());
                after
            }
            "fortran_order" => {
                let value = after.starts_with("True");
                fortran = Some(value);
                after.strip_prefix(if value { "True" } else { "False" })?
            }
            "shape" => {
                let (inside, after) = after.strip_prefix('(')?.split_once(')')?;
                let extents = inside.split(',').map(str::trim).filter(|s| !s.is_empty());
                shape = Some(extents.map(|s| s.parse().ok()).collect::<Option<Vec<_>>>()?);
                after
            }
            _ => return None,
        };
        rest = rest.trim_start();
        rest = rest.strip_prefix(',').unwrap_or(rest).trim_start();
    }
    // numpy itself has no more than 64 axes.
    let shape: Vec<usize> = shape.filter(|s: &Vec<usize>| s.len() <= 64)?;
    Some(NpyHeader { descr: descr?, fortran: fortran?, shape })
}

/// A string literal without escapes, and what follows it.
fn quoted(text: &str) -> Option<(&str, &str)> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    text[1..].split_once(quote)
}

/// Reads one array of plain values to the end of `reader`.
pub(crate) fn read_array(file: &str, key: &str, mut reader: impl Read) -> Result<NdArray, Error> {
    let malformed = |message: String| Error::Npy { file: file.to_owned(), key: key.to_owned(), message };
    let header = read_header(file, key, &mut reader)?;
    let Some(element) = ElementType::parse(&header.descr) else {
        return Err(Error::Type {
            file: file.to_owned(),
            key: key.to_owned(),
            expected: "booleans, integers or floats",
            actual: format!("of element type {:?}", header.descr),
        });
    };
    let bytes_of = |size: usize| element_count(&header.shape).and_then(|n| n.checked_mul(size as u128));
    let claimed = bytes_of(element.size()).unwrap_or(u128::MAX);
    let in_memory = bytes_of(element.size_in_memory()).unwrap_or(u128::MAX);
    if in_memory > u128::from(MAX_ARRAY_BYTES) {
        let (file, key) = (file.to_owned(), key.to_owned());
        return Err(Error::TooLarge { file, key, claimed: in_memory, limit: MAX_ARRAY_BYTES });
    }
    // One byte more than claimed, so that trailing bytes are noticed and a zip entry's checksum is
    // verified.
    let mut bytes = Vec::new();
    (reader.take(claimed as u64 + 1).read_to_end(&mut bytes)).map_err(|e| malformed(e.to_string()))?;
    element.decode(&bytes, &header.shape, header.fortran).ok_or_else(|| {
        malformed(format!(
            "shape {:?} of {} takes {claimed} bytes, found {}{}",
            header.shape,
            header.descr,
            if bytes.len() as u128 > claimed { "at least " } else { "" },
            bytes.len()
        ))
    })
}
