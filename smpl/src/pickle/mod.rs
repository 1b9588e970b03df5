//! Python pickles as plain data.
//!
//! A small stack machine reads protocols 0 to 5 and understands the few constructors that numpy arrays, chumpy
//! arrays and scipy's `csc_matrix` need. Every other global is refused by name and nothing is ever executed.
//! Memory is bounded by a multiple of the input's size, nesting by [`MAX_DEPTH`]; malformed input gives
//! [`Error::Pickle`] with the offset of the opcode.

mod machine;
mod numpy;
mod reader;
mod value;

use std::path::Path;

use crate::Error;
use crate::array::NdArray;
use crate::npz::{read_array, read_file, read_header};
use machine::Machine;

/// Deepest nesting of containers in a [`Value`].
pub const MAX_DEPTH: usize = 100;

/// A Python value.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Value {
    /// `None`.
    None,
    /// `bool`.
    Bool(bool),
    /// `int` that fits 64 bits.
    Int(i64),
    /// `float`.
    Float(f64),
    /// `str`; Python 2's byte strings are read as Latin-1.
    Str(String),
    /// `bytes` or `bytearray`.
    Bytes(Vec<u8>),
    /// `list`.
    List(Vec<Value>),
    /// `tuple`.
    Tuple(Vec<Value>),
    /// `set` or `frozenset`, in the file's order.
    Set(Vec<Value>),
    /// `dict` or `OrderedDict`, in the file's order; of equal keys the last counts.
    Dict(Vec<(Value, Value)>),
    /// numpy array of booleans, integers or floats. A numpy scalar has an empty shape.
    Array(NdArray),
    /// numpy array of objects or strings, row-major. One of no axes is replaced by its only item.
    Objects {
        /// Extent of every axis.
        shape: Vec<usize>,
        /// The items, last axis fastest.
        items: Vec<Value>,
    },
    /// Instance of one of the allowed classes: `chumpy.ch.Ch` or `scipy.sparse.csc_matrix`.
    Object {
        /// Full name of the class.
        class: &'static str,
        /// Its attributes, a [`Value::Dict`].
        state: Box<Value>,
    },
}

/// Reads a pickle file, or a `.npy` file of either objects or plain values.
///
/// # Errors
/// [`Error::Io`], [`Error::TooLarge`] beyond 2 GiB, [`Error::Pickle`], [`Error::Npy`].
pub fn read(path: &Path) -> Result<Value, Error> {
    let file = path.display().to_string();
    let bytes = read_file(path)?;
    if bytes.starts_with(b"\x93NUMPY") {
        let mut rest = bytes.as_slice();
        let header = read_header(&file, "", &mut rest)?;
        if !header.descr.trim_start_matches(['|', '<', '>', '=']).starts_with('O') {
            return read_array(&file, "", bytes.as_slice()).map(Value::Array);
        }
        let start = bytes.len() - rest.len();
        return parse_at(&file, &bytes, start);
    }
    parse_at(&file, &bytes, 0)
}

/// Reads a pickle in memory; `file` names it in errors. What follows its end is not looked at.
///
/// # Errors
/// [`Error::Pickle`].
pub fn parse(file: &str, bytes: &[u8]) -> Result<Value, Error> {
    parse_at(file, bytes, 0)
}

fn parse_at(file: &str, bytes: &[u8], start: usize) -> Result<Value, Error> {
    let mut machine = Machine::new(bytes, start);
    machine.run().map_err(|message| Error::Pickle { file: file.to_owned(), offset: machine.offset(), message })
}
