//! One numpy array with its header: a `.npy` file, or an entry of an archive.

use std::io::Read;

use crate::Error;
use crate::array::NdArray;
use crate::element::{ElementType, byte_count};
use crate::file::read_limited;

/// Largest array that is read, in bytes of the file and of memory: 1 GiB.
pub const MAX_ARRAY_BYTES: u64 = 1 << 30;

/// First bytes of a `.npy` file.
pub(crate) const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// Longest header text; numpy's own limit is 10 000 characters.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// Description of an array that precedes its data.
pub(crate) struct NpyHeader {
    /// numpy's name of the element type, `|O` for pickled objects.
    pub(crate) descr: String,
    pub(crate) fortran: bool,
    pub(crate) shape: Vec<usize>,
}

impl NpyHeader {
    /// Reads magic, version and header text; `reader` is left at the data.
    pub(crate) fn read(file: &str, key: &str, reader: &mut impl Read) -> Result<Self, Error> {
        let malformed = |message: String| Error::npy(file, key, message);
        let mut bytes = |count: usize| {
            let mut bytes = vec![0u8; count];
            reader.read_exact(&mut bytes).map_err(|e| malformed(format!("header: {e}")))?;
            Ok::<_, Error>(bytes)
        };
        let start = bytes(8)?;
        if !start.starts_with(MAGIC) {
            return Err(malformed("no numpy magic".to_owned()));
        }
        let size = match start[6] {
            1 => 2,
            0 | 2 | 3 => 4,
            version => return Err(malformed(format!("format version {version}"))),
        };
        let length = bytes(size)?.iter().rev().fold(0, |n, &byte| n << 8 | usize::from(byte));
        if length > MAX_HEADER_BYTES {
            return Err(malformed(format!("header of {length} bytes")));
        }
        let text = String::from_utf8(bytes(length)?).map_err(|_| malformed("header is not UTF-8".to_owned()))?;
        Self::parse(&text).ok_or_else(|| malformed(format!("header {:?}", text.trim_end())))
    }

    /// Parses the dict literal `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }` with
    /// keys in any order.
    fn parse(text: &str) -> Option<Self> {
        let (mut descr, mut fortran, mut shape) = (None, None, None);
        let mut rest = text.trim().strip_prefix('{')?.strip_suffix('}')?.trim_start();
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
                    shape = Some(extents.map(|s| s.parse().ok()).collect::<Option<Vec<usize>>>()?);
                    after
                }
                _ => return None,
            };
            rest = rest.trim_start();
            rest = rest.strip_prefix(',').unwrap_or(rest).trim_start();
        }
        // numpy's limit is 64 axes.
        Some(Self { descr: descr?, fortran: fortran?, shape: shape.filter(|s| s.len() <= 64)? })
    }

    /// Reads the array's values to the end of `reader`.
    pub(crate) fn read_data(self, file: &str, key: &str, reader: impl Read) -> Result<NdArray, Error> {
        let Self { descr, fortran, shape } = self;
        let unknown = || format!("element type {descr:?}, expected booleans, integers or floats");
        let element = ElementType::parse(&descr).ok_or_else(|| Error::invalid(file, key, unknown()))?;
        let bytes_of = |size: usize| byte_count(&shape, size).unwrap_or(u128::MAX);
        let (claimed, in_memory) = (bytes_of(element.size), bytes_of(element.size_in_memory()));
        if in_memory > u128::from(MAX_ARRAY_BYTES) {
            return Err(Error::too_large(file, key, in_memory, MAX_ARRAY_BYTES));
        }
        // Reading past the end verifies the checksum of a zip entry and finds trailing bytes.
        let bytes = read_limited(reader, 0, claimed as u64).map_err(|e| Error::npy(file, key, e))?;
        let found = bytes.as_ref().map_or("more".to_owned(), |bytes| bytes.len().to_string());
        bytes.and_then(|bytes| element.decode(&bytes, &shape, fortran)).ok_or_else(|| {
            Error::npy(file, key, format!("shape {shape:?} of {descr} takes {claimed} bytes, found {found}"))
        })
    }
}

/// A string literal without escapes, and the text behind it.
fn quoted(text: &str) -> Option<(&str, &str)> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    text[1..].split_once(quote)
}

/// Reads one array of plain values to the end of `reader`.
pub(crate) fn read_array(file: &str, key: &str, mut reader: impl Read) -> Result<NdArray, Error> {
    NpyHeader::read(file, key, &mut reader)?.read_data(file, key, reader)
}

/// Header of version 1.0, padded so that the data begin at a multiple of 64 bytes.
pub(crate) fn header(descr: &str, shape: &[usize]) -> Vec<u8> {
    let extents: Vec<String> = shape.iter().map(usize::to_string).collect();
    let comma = if extents.len() == 1 { "," } else { "" };
    let text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({}{comma}), }}", extents.join(", "));
    let length = (MAGIC.len() + 4 + text.len() + 1).next_multiple_of(64) - MAGIC.len() - 4;
    let mut out = [MAGIC.as_slice(), &[1, 0], &(length as u16).to_le_bytes()].concat();
    out.extend(format!("{text:<width$}\n", width = length - 1).into_bytes());
    out
}
