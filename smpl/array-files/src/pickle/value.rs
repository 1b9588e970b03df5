//! Python values as plain data.

use super::globals::{CHUMPY, COO, CSC, CSR};
use crate::Error;
use crate::array::{Data, NdArray};

/// Most values of a sparse matrix made dense.
const MAX_DENSE: usize = 1 << 25;

/// Class of a [`Value::Object`] that refers to something outside the pickle; its state is the
/// reference.
pub const PERSISTENT: &str = "persistent id";

/// A Python value.
///
/// ```
/// use array_files::pickle::{self, Value};
///
/// let people = pickle::parse("people.pkl", b"}(S'ann'\nK\x07S'bob'\n]u.")?; // {"ann": 7, "bob": []}
/// assert_eq!(people.get("ann"), Some(&Value::Int(7)));
/// assert_eq!(people.get("bob").and_then(Value::items), Some(&[][..]));
/// assert_eq!(people.get("eve"), None);
/// # Ok::<(), array_files::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Value {
    /// `None`.
    None,
    /// `bool`.
    Bool(bool),
    /// `int` of 64 bits.
    Int(i64),
    /// `float`.
    Float(f64),
    /// `str`; byte strings of Python 2 are read as Latin-1.
    Str(String),
    /// `bytes` or `bytearray`.
    Bytes(Vec<u8>),
    /// `list`.
    List(Vec<Value>),
    /// `tuple`.
    Tuple(Vec<Value>),
    /// `set` or `frozenset`, in the file's order.
    Set(Vec<Value>),
    /// `dict`, `OrderedDict` or `defaultdict`, in the file's order; the last of equal keys counts.
    Dict(Vec<(Value, Value)>),
    /// numpy array of booleans, integers or floats. A numpy scalar has an empty shape.
    Array(NdArray),
    /// numpy array of objects or strings, row-major. An array of no axes is replaced by its item.
    Objects {
        /// Extent of every axis.
        shape: Vec<usize>,
        /// The items, last axis fastest.
        items: Vec<Value>,
    },
    /// Instance of an allowed class (`chumpy.ch.Ch`, scipy's sparse matrices, `torch.Tensor`,
    /// [`PERSISTENT`]), or, without attributes, such a class or a storage class of PyTorch.
    Object {
        /// Full name of the class.
        class: &'static str,
        /// Attributes, a [`Value::Dict`]; for `torch.Tensor` its arguments.
        state: Box<Value>,
    },
}

impl Value {
    /// Python's name of the type.
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::None => "None",
            Self::Bool(_) => "bool",
            Self::Int(_) => "int",
            Self::Float(_) => "float",
            Self::Str(_) => "str",
            Self::Bytes(_) => "bytes",
            Self::List(_) => "list",
            Self::Tuple(_) => "tuple",
            Self::Set(_) => "set",
            Self::Dict(_) => "dict",
            Self::Array(_) => "numpy array",
            Self::Objects { .. } => "numpy array of objects",
            Self::Object { class, .. } => class,
        }
    }

    /// The value under the text `key`, or the byte string of that text, of a dict or of an object's
    /// attributes. `None` if there is none, and for other types.
    pub fn get(&self, key: &str) -> Option<&Self> {
        match self {
            Self::Dict(items) => items.iter().rev().find(|(k, _)| k.is_text(key)).map(|(_, value)| value),
            Self::Object { state, .. } => state.get(key),
            _ => None,
        }
    }

    /// Whether this is the text `key`, or the byte string of it.
    fn is_text(&self, key: &str) -> bool {
        match self {
            Self::Str(text) => text == key,
            Self::Bytes(bytes) => bytes == key.as_bytes(),
            _ => false,
        }
    }

    /// The items of a list, tuple, set or array of objects. `None` for other types.
    pub fn items(&self) -> Option<&[Self]> {
        match self {
            Self::List(items) | Self::Tuple(items) | Self::Set(items) => Some(items),
            Self::Objects { items, .. } => Some(items),
            _ => None,
        }
    }

    /// The text of a `str`. `None` for other types.
    pub fn as_str(&self) -> Option<&str> {
        match self {
            Self::Str(text) => Some(text),
            _ => None,
        }
    }

    /// This array of numbers, or the one that a chumpy object wraps. `None` for other types.
    pub fn as_array(&self) -> Option<&NdArray> {
        match self {
            Self::Array(array) => Some(array),
            Self::Object { class: CHUMPY, state } => match state.get("x") {
                Some(Self::Array(array)) => Some(array),
                _ => None,
            },
            _ => None,
        }
    }

    /// [`Value::as_array`], or a sparse matrix (CSC, CSR, COO) made dense. `Ok(None)` for other
    /// types; `file` and `key` name it in errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a sparse matrix whose parts disagree, or of more than 2²⁵ values.
    pub fn to_dense(&self, file: &str, key: &str) -> Result<Option<NdArray>, Error> {
        match self {
            Self::Object { class: class @ (CSC | CSR | COO), state } => {
                dense(class, state).map(Some).map_err(|message| Error::invalid(file, key, message))
            }
            _ => Ok(self.as_array().cloned()),
        }
    }

    /// A sequence of whole numbers, such as a shape.
    pub(crate) fn as_extents(&self) -> Option<Vec<usize>> {
        self.items()?.iter().map(Self::as_extent).collect()
    }

    pub(crate) fn as_extent(&self) -> Option<usize> {
        match self {
            Self::Int(n) => usize::try_from(*n).ok(),
            _ => None,
        }
    }
}

/// A sparse matrix, made dense.
fn dense(class: &str, state: &Value) -> Result<NdArray, String> {
    let integers = |name: &str| match state.get(name).and_then(Value::as_array) {
        Some(NdArray { data: Data::I64(values), .. }) => Ok(values.as_slice()),
        _ => Err(format!("sparse matrix without `{name}`")),
    };
    let data = state.get("data").and_then(Value::as_array);
    let data = data.ok_or("sparse matrix without `data`")?.to_f64();
    let shape = state.get("_shape").or_else(|| state.get("shape")).and_then(Value::as_extents);
    let Some(&[height, width]) = shape.as_deref() else {
        return Err("sparse matrix without a shape of two axes".to_owned());
    };
    let count = height.checked_mul(width).filter(|&n| n <= MAX_DENSE);
    let count = count.ok_or_else(|| format!("sparse matrix of shape [{height}, {width}] is too large"))?;
    // The second index of each value, and the first.
    let (inner, outer) = if class == COO {
        // Newer versions of scipy keep a tuple.
        let axis = |i: usize, name: &str| match state.get("coords").and_then(Value::items).and_then(|c| c.get(i)) {
            Some(Value::Array(NdArray { data: Data::I64(values), .. })) => Ok(values.clone()),
            _ => integers(name).map(<[i64]>::to_vec),
        };
        (axis(1, "col")?, axis(0, "row")?)
    } else {
        let (starts, inner) = (integers("indptr")?, integers("indices")?.to_vec());
        let lines = if class == CSR { height } else { width };
        let (first, last) = (starts.first().copied(), starts.last().copied());
        let whole = first == Some(0) && last.and_then(|n| usize::try_from(n).ok()) == Some(inner.len());
        if starts.len() != lines.saturating_add(1) || !whole || starts.windows(2).any(|pair| pair[0] > pair[1]) {
            let (starts, values) = (starts.len(), inner.len());
            return Err(format!(
                "sparse matrix of {lines} lines with {starts} starts up to {last:?} of {values} values"
            ));
        }
        let spans = starts.windows(2).enumerate();
        let outer = spans.flat_map(|(line, span)| std::iter::repeat_n(line as i64, (span[1] - span[0]) as usize));
        (inner, outer.collect())
    };
    let (rows, columns) = if class == CSC { (inner, outer) } else { (outer, inner) };
    if rows.len() != data.len() || columns.len() != data.len() {
        let (rows, columns, values) = (rows.len(), columns.len(), data.len());
        return Err(format!("sparse matrix of {rows} rows, {columns} columns and {values} values"));
    }
    let mut dense = vec![0.0; count];
    for ((row, column), value) in rows.iter().zip(&columns).zip(data) {
        let within = |i: i64, end: usize| usize::try_from(i).ok().filter(|i| *i < end);
        let place = within(*row, height).zip(within(*column, width));
        let (row, column) = place.ok_or_else(|| format!("row {row}, column {column} of [{height}, {width}]"))?;
        dense[row * width + column] += value;
    }
    Ok(NdArray { shape: vec![height, width], data: Data::F64(dense) })
}
