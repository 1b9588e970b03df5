//! Python pickles as plain data.
//!
//! A small stack machine reads protocols 0 to 5 and understands the few constructors that numpy
//! arrays, joblib's arrays, chumpy arrays, scipy's `csc_matrix` and descriptions of PyTorch tensors
//! need. Every other global is refused by name and nothing is ever executed. Beside the input
//! itself a pickle takes at most 8 times its size and 128 MiB; what joblib has compressed may grow
//! 256-fold and by 64 MiB. Nesting is bounded by [`MAX_DEPTH`]; malformed input gives
//! [`Error::Pickle`] with the offset of the opcode.

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
use crate::npy::{read_array, read_file, read_header};
use machine::Machine;

pub(crate) use compressed::unpacked_limit;
pub use value::{MAX_DEPTH, PERSISTENT, Value};

/// Reads a pickle file, compressed as joblib compresses or not, or a `.npy` file of either objects
/// or plain values.
///
/// # Errors
/// [`Error::Io`], [`Error::TooLarge`] beyond 2 GiB, [`Error::Pickle`], [`Error::Npy`].
pub fn read(path: &Path) -> Result<Value, Error> {
    from_bytes(&path.display().to_string(), read_file(path)?)
}

/// [`read`] for a file in memory; `file` names it in errors.
///
/// # Errors
/// [`Error::TooLarge`], [`Error::Pickle`], [`Error::Npy`].
pub fn from_bytes(file: &str, bytes: Vec<u8>) -> Result<Value, Error> {
    let bytes = compressed::unpacked(file, bytes)?;
    if bytes.starts_with(b"\x93NUMPY") {
        let mut rest = bytes.as_slice();
        let header = read_header(file, "", &mut rest)?;
        if !header.descr.trim_start_matches(['|', '<', '>', '=']).starts_with('O') {
            return read_array(file, "", bytes.as_slice()).map(Value::Array);
        }
        let start = bytes.len() - rest.len();
        return parse_at(file, &bytes, start);
    }
    parse_at(file, &bytes, 0)
}

/// Reads a pickle in memory; `file` names it in errors. What follows its end is not looked at.
///
/// # Errors
/// [`Error::Pickle`].
pub fn parse(file: &str, bytes: &[u8]) -> Result<Value, Error> {
    parse_at(file, bytes, 0)
}

/// Reads the pickle that starts at byte `start` and says where it ends, for files of several;
/// `file` names them in errors.
///
/// # Errors
/// [`Error::Pickle`].
pub fn parse_from(file: &str, bytes: &[u8], start: usize) -> Result<(Value, usize), Error> {
    let mut machine = Machine::new(bytes, start.min(bytes.len()));
    match machine.run() {
        Ok(value) => Ok((value, machine.offset() + 1)),
        Err(message) => Err(Error::Pickle { file: file.to_owned(), offset: machine.offset(), message }),
    }
}

fn parse_at(file: &str, bytes: &[u8], start: usize) -> Result<Value, Error> {
    parse_from(file, bytes, start).map(|(value, _)| value)
}
