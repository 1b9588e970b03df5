//! From the machine's arena to an owned value, and what can be asked of one.

use super::joblib::WRAPPER;
use super::machine::{Id, Machine, Node};
use super::numpy::Global;
use super::reader::Step;
use super::{MAX_DEPTH, Value};
use crate::Error;
use crate::array::{Data, NdArray};

/// Most values of a sparse matrix made dense.
const MAX_DENSE: usize = 1 << 25;

impl Machine<'_> {
    /// The owned tree below `top`, once the machine has stopped.
    pub(super) fn value_of(&mut self, top: Id) -> Step<Value> {
        let uses = self.uses();
        self.value(top, &uses, true, 0)
    }

    /// How often each node is referred to, counted up to 2. What is used once can be moved rather than copied.
    fn uses(&self) -> Vec<u8> {
        let mut uses = vec![0u8; self.nodes.len()];
        let mut count = |id: Id| uses[id] = (uses[id] + 1).min(2);
        for node in &self.nodes {
            match node {
                Node::List(items) | Node::Tuple(items) | Node::Set(items) => items.iter().copied().for_each(&mut count),
                Node::Dict(items) => items.iter().flat_map(|&(k, v)| [k, v]).for_each(&mut count),
                Node::Objects(objects) => objects.1.iter().copied().for_each(&mut count),
                Node::Object(_, Some(state)) => count(*state),
                _ => {}
            }
        }
        uses
    }

    /// The owned tree below a node. Shared nodes are copied, against the budget; `owned` says that no other node leads
    /// here.
    fn value(&mut self, id: Id, uses: &[u8], owned: bool, depth: usize) -> Step<Value> {
        if depth > MAX_DEPTH {
            return Err(format!("nested deeper than {MAX_DEPTH}"));
        }
        self.spend(size_of::<Value>())?;
        let owned = owned && uses[id] < 2;
        let below = |machine: &mut Self, id: Id| machine.value(id, uses, owned, depth + 1);
        Ok(match &self.nodes[id] {
            Node::None => Value::None,
            Node::Bool(value) => Value::Bool(*value),
            Node::Int(value) => Value::Int(*value),
            Node::Float(value) => Value::Float(*value),
            Node::Text(text) => {
                let text = text.to_string();
                self.spend(text.len())?;
                Value::Str(text)
            }
            Node::ByteString(bytes) => {
                // Latin-1 beyond ASCII takes two bytes in UTF-8.
                let length = 2 * bytes.len();
                let text = bytes.iter().map(|&b| char::from(b)).collect();
                self.spend(length)?;
                Value::Str(text)
            }
            Node::Bytes(bytes) => {
                let bytes = bytes.to_vec();
                self.spend(bytes.len())?;
                Value::Bytes(bytes)
            }
            Node::Array(_) if owned => match std::mem::replace(&mut self.nodes[id], Node::None) {
                Node::Array(array) => Value::Array(*array),
                _ => Value::None,
            },
            Node::Array(array) => {
                self.spend(8 * array.len())?;
                match &self.nodes[id] {
                    Node::Array(array) => Value::Array(array.as_ref().clone()),
                    _ => Value::None,
                }
            }
            Node::List(items) => Value::List(self.values(items.clone(), below)?),
            Node::Tuple(items) => Value::Tuple(self.values(items.clone(), below)?),
            Node::Set(items) => Value::Set(self.values(items.clone(), below)?),
            Node::Objects(objects) => {
                let (shape, items) = objects.as_ref().clone();
                match items.as_slice() {
                    &[only] if shape.is_empty() => below(self, only)?,
                    _ => Value::Objects { items: self.values(items, below)?, shape },
                }
            }
            Node::Dict(items) => {
                let items = items.clone();
                self.spend(items.len() * (size_of::<(Id, Id)>() + size_of::<(Value, Value)>()))?;
                let mut out = Vec::with_capacity(items.len());
                for (key, value) in items {
                    out.push((below(self, key)?, below(self, value)?));
                }
                Value::Dict(out)
            }
            Node::Object(WRAPPER, _) | Node::Global(Global::Class(WRAPPER)) => {
                return Err("joblib array without its state".to_owned());
            }
            &Node::Object(class, state) => Value::Object {
                class,
                state: Box::new(match state {
                    Some(state) => below(self, state)?,
                    None => Value::Dict(Vec::new()),
                }),
            },
            &Node::Global(Global::Class(class)) => Value::Object { class, state: Box::new(Value::Dict(Vec::new())) },
            Node::Global(_) => return Err("a class or function as a value".to_owned()),
            Node::Dtype(_) => return Err("a dtype as a value".to_owned()),
            Node::BlankArray => return Err("array without data".to_owned()),
        })
    }

    fn values(&mut self, ids: Vec<Id>, mut below: impl FnMut(&mut Self, Id) -> Step<Value>) -> Step<Vec<Value>> {
        self.spend(ids.len() * (size_of::<Id>() + size_of::<Value>()))?;
        let mut out = Vec::with_capacity(ids.len());
        for id in ids {
            out.push(below(self, id)?);
        }
        Ok(out)
    }
}

impl Value {
    /// Python's name of the type.
    #[must_use]
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

    /// The value under the text `key` of a dict or of an object's attributes. `None` if there is none, and for other
    /// types.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&Self> {
        match self {
            Self::Dict(items) => {
                let found = items.iter().rev().find(|(k, _)| k.as_str() == Some(key));
                found.map(|(_, value)| value)
            }
            Self::Object { state, .. } => state.get(key),
            _ => None,
        }
    }

    /// The items of a list, tuple, set or array of objects. `None` for other types.
    #[must_use]
    pub fn items(&self) -> Option<&[Self]> {
        match self {
            Self::List(items) | Self::Tuple(items) | Self::Set(items) => Some(items),
            Self::Objects { items, .. } => Some(items),
            _ => None,
        }
    }

    /// The text of a `str`. `None` for other types.
    #[must_use]
    pub fn as_str(&self) -> Option<&str> {
        match self {
            Self::Str(text) => Some(text),
            _ => None,
        }
    }

    /// The array of numbers that this is or (chumpy) wraps. `None` for other types.
    #[must_use]
    pub fn as_array(&self) -> Option<&NdArray> {
        match self {
            Self::Array(array) => Some(array),
            Self::Object { class: "chumpy.ch.Ch", state } => match state.get("x") {
                Some(Self::Array(array)) => Some(array),
                _ => None,
            },
            _ => None,
        }
    }

    /// [`Value::as_array`], or a `csc_matrix` made dense. `Ok(None)` for other types; `file` and `key` are for errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a sparse matrix whose parts do not fit, or that would be too large.
    pub fn to_dense(&self, file: &str, key: &str) -> Result<Option<NdArray>, Error> {
        if let Some(array) = self.as_array() {
            return Ok(Some(array.clone()));
        }
        match self {
            Self::Object { class: "scipy.sparse.csc_matrix", state } => {
                dense_columns(state).map(Some).map_err(|message| Error::invalid(file, key, message))
            }
            _ => Ok(None),
        }
    }
}

/// Compressed sparse columns, made dense.
fn dense_columns(state: &Value) -> Result<NdArray, String> {
    let integers = |name: &str| match state.get(name).and_then(Value::as_array) {
        Some(NdArray { data: Data::I64(values), .. }) => Ok(values.as_slice()),
        _ => Err(format!("sparse matrix without `{name}`")),
    };
    let (starts, rows) = (integers("indptr")?, integers("indices")?);
    let data = state.get("data").and_then(Value::as_array);
    let data = data.ok_or("sparse matrix without `data`")?.to_f64();
    let shape = state.get("_shape").or_else(|| state.get("shape"));
    let extents: Option<Vec<usize>> = shape.and_then(Value::items).and_then(|items| {
        let extent = |v: &Value| match v {
            Value::Int(n) => usize::try_from(*n).ok(),
            _ => None,
        };
        items.iter().map(extent).collect()
    });
    let Some(&[height, width]) = extents.as_deref() else {
        return Err("sparse matrix without a shape of two axes".to_owned());
    };
    let count = height.checked_mul(width).filter(|&n| n <= MAX_DENSE);
    let count = count.ok_or_else(|| format!("sparse matrix of shape [{height}, {width}] is too large"))?;
    if starts.len() != width.saturating_add(1) || rows.len() != data.len() {
        return Err(format!(
            "sparse matrix of {width} columns with {} starts, {} rows, {} values",
            starts.len(),
            rows.len(),
            data.len()
        ));
    }
    let mut dense = vec![0.0; count];
    for column in 0..width {
        let (start, end) = (starts[column], starts[column + 1]);
        let range = usize::try_from(start).ok().zip(usize::try_from(end).ok());
        let range = range.filter(|&(start, end)| start <= end && end <= rows.len());
        let (start, end) = range.ok_or_else(|| format!("column {column} spans {start}..{end}"))?;
        for i in start..end {
            let row = usize::try_from(rows[i]).ok().filter(|&r| r < height);
            let row = row.ok_or_else(|| format!("row {} of {height}", rows[i]))?;
            dense[row * width + column] += data[i];
        }
    }
    Ok(NdArray { shape: vec![height, width], data: Data::F64(dense) })
}
