//! Python pickles as plain data.
//!
//! A stack machine for protocols 0 to 5 with an allow-list of constructors: numpy arrays, joblib's
//! arrays, chumpy arrays, scipy's `csc_matrix`, and descriptions of PyTorch tensors. Every other
//! global is refused by name; nothing is executed. Beside the input itself a pickle takes at most 8
//! times its size and 128 MiB; joblib's compressed files may expand 256-fold and by 64 MiB.
//! Containers nest to 100 levels. Malformed input gives [`Error::Pickle`] with the offset of the
//! opcode.

mod compressed;
mod convert;
mod globals;
mod joblib;
mod machine;
mod numpy;
mod reader;
mod value;

use std::path::Path;

use crate::Error;
use crate::file::read_file;
use crate::npy::{MAGIC, NpyHeader};
use globals::Dtype;
use machine::Machine;

pub(crate) use globals::STORAGES;
pub use value::{PERSISTENT, Value};

/// Reads a pickle, plain or compressed by joblib, or a `.npy` file of objects, texts or plain values.
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
    let bytes = compressed::unpacked(file, bytes)?;
    if !bytes.starts_with(MAGIC) {
        return parse(file, &bytes);
    }
    let mut rest = bytes.as_slice();
    let header = NpyHeader::read(file, "", &mut rest)?;
    if header.descr.trim_start_matches(['|', '<', '>', '=']).starts_with('O') {
        return parse_from(file, &bytes, bytes.len() - rest.len()).map(|(value, _)| value);
    }
    match Dtype::parse(&header.descr) {
        Ok(dtype @ (Dtype::ByteText(size) | Dtype::WideText { size, .. })) => {
            let texts = numpy::texts(dtype, size, &header, rest);
            let mut items = texts.map_err(|error| Error::npy(file, "", error))?;
            let only = if header.shape.is_empty() { items.pop() } else { None };
            Ok(only.unwrap_or(Value::Objects { shape: header.shape, items }))
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
