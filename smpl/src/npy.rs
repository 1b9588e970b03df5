//! Reading one array: a `.npy` file, or an entry of an archive.

use std::io::Read;
use std::path::Path;

use crate::Error;
use crate::array::{ElementType, NdArray, element_count};

/// Largest array that is read, in bytes of the file and of memory: 1 GiB.
pub const MAX_ARRAY_BYTES: u64 = 1 << 30;

/// Largest file that is read, in bytes: 2 GiB.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 31;

/// Longest header text that is read. numpy's own limit is 10 000 characters.
const MAX_HEADER_BYTES: usize = 1 << 16;

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
