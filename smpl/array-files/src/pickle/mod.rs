//! Python pickles as plain data.
//!
//! A stack machine for protocols 0 to 5 with an allow-list of constructors: numpy arrays, joblib's
//! arrays, chumpy arrays, scipy's `csc_matrix`, and descriptions of PyTorch tensors. Every other
//! global is refused by name; nothing is executed. Beside the input itself a pickle takes at most 8
//! times its size and 128 MiB; joblib's compressed files may expand 256-fold and by 64 MiB.
//! Containers nest to 100 levels. Malformed input gives [`Error::Pickle`] with the offset of the
//! opcode.

mod convert;
mod globals;
mod machine;
mod numpy;
mod reader;
mod value;

use std::io::Read;
use std::path::Path;

use crate::Error;
use crate::file::{read_file, read_limited, unpacked_limit};
use crate::npy::{MAGIC, NpyHeader};
use globals::Dtype;
use machine::Machine;

pub(crate) use globals::STORAGES;
pub use value::{PERSISTENT, Value};

/// Memory limit of the LZMA decoders in KiB: twice the dictionary of `xz -9`.
const LZMA_KIBIBYTES: u32 = 128 << 10;

/// Reads a pickle, plain or compressed by joblib, or a `.npy` file of objects, texts or plain
/// values.
///
/// # Errors
/// [`Error::Io`], also beyond 2 GiB; [`Error::Pickle`], [`Error::Npy`].
pub fn read(path: &Path) -> Result<Value, Error> {
    from_bytes(&path.display().to_string(), read_file(path)?)
}

/// [`read`] for a file in memory; `file` names it in errors.
///
/// # Errors
/// [`Error::Invalid`] for a bomb, [`Error::Pickle`], [`Error::Npy`].
pub fn from_bytes(file: &str, bytes: Vec<u8>) -> Result<Value, Error> {
    let bytes = unpacked(file, bytes)?;
    if !bytes.starts_with(MAGIC) {
        return parse(file, &bytes);
    }
    let mut rest = bytes.as_slice();
    let header = NpyHeader::read(file, "", &mut rest)?;
    if header.descr.trim_start_matches(['|', '<', '>', '=']).starts_with('O') {
        return parse_from(file, &bytes, bytes.len() - rest.len()).map(|(value, _)| value);
    }
    match Dtype::parse(&header.descr) {
        Ok(dtype @ (Dtype::ByteText(_) | Dtype::WideText { .. })) => {
            let mut machine = Machine::new(&bytes, 0);
            let array = machine.raw_array(dtype, header.shape, header.fortran, rest);
            let texts = array.and_then(|array| machine.add(array)).and_then(|top| machine.value_of(top));
            texts.map_err(|error| Error::npy(file, "", error))
        }
        _ => header.read_data(file, "", rest).map(Value::Array),
    }
}

/// Reads an uncompressed pickle in memory; `file` names it in errors. Bytes behind its end are
/// ignored.
///
/// # Errors
/// [`Error::Pickle`].
pub fn parse(file: &str, bytes: &[u8]) -> Result<Value, Error> {
    parse_from(file, bytes, 0).map(|(value, _)| value)
}

/// The pickle that starts at byte `start`, and the offset behind it.
pub(crate) fn parse_from(file: &str, bytes: &[u8], start: usize) -> Result<(Value, usize), Error> {
    let mut machine = Machine::new(bytes, start.min(bytes.len()));
    match machine.run() {
        Ok(value) => Ok((value, machine.opcode_at + 1)),
        Err(message) => Err(Error::Pickle { file: file.to_owned(), offset: machine.opcode_at, message }),
    }
}

/// `bytes` unpacked if they start as zlib, gzip, bzip2, LZMA or xz do; else themselves. No pickle
/// starts like any of these.
fn unpacked(file: &str, bytes: Vec<u8>) -> Result<Vec<u8>, Error> {
    let source = bytes.as_slice();
    let malformed = |message: String| Error::Pickle { file: file.to_owned(), offset: 0, message };
    let (name, reader): (&str, Box<dyn Read + '_>) = match source {
        // The two bytes of a zlib header are a multiple of 31.
        [0x78, flags, ..] if (0x7800 + u16::from(*flags)).is_multiple_of(31) => {
            ("zlib", Box::new(flate2::read::ZlibDecoder::new(source)))
        }
        [0x1f, 0x8b, ..] => ("gzip", Box::new(flate2::read::MultiGzDecoder::new(source))),
        [b'B', b'Z', b'h', ..] => ("bzip2", Box::new(bzip2::read::BzDecoder::new(source))),
        [0x5d, 0, 0, ..] => {
            let reader = lzma_rust2::LzmaReader::new_mem_limit(source, LZMA_KIBIBYTES, None);
            ("lzma", Box::new(reader.map_err(|e| malformed(format!("lzma: {e}")))?))
        }
        [0xfd, b'7', b'z', b'X', b'Z', 0, ..] => {
            ("xz", Box::new(lzma_rust2::XzReader::new_mem_limit(source, true, LZMA_KIBIBYTES)))
        }
        [4, 0x22, 0x4d, 0x18, ..] => {
            let expected = "expected zlib, gzip, bz2, lzma or none";
            return Err(malformed(format!("is compressed by LZ4, {expected} (joblib.dump's `compress`)")));
        }
        _ => return Ok(bytes),
    };
    let limit = unpacked_limit(bytes.len() as u64);
    let out = read_limited(reader, 0, limit).map_err(|e| malformed(format!("{name}: {e}")))?;
    out.ok_or_else(|| Error::too_large(file, name, u128::from(limit) + 1, limit))
}
