//! Values while a pickle is read: nodes of one arena, which refer to each other by index.

use std::borrow::Cow;

use super::globals::{Dtype, Global};
use super::reader::Step;
use super::value::{MAX_DEPTH, Value};
use crate::array::NdArray;

/// Index of a node. Nodes live in one arena, because a container can be referred to before it is filled.
pub(super) type Id = usize;

/// A value under construction.
pub(super) enum Node<'a> {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(Cow<'a, str>),
    Bytes(Cow<'a, [u8]>),
    /// Python 2's `str`: text or data, the use decides.
    ByteString(Cow<'a, [u8]>),
    List(Vec<Id>),
    Tuple(Vec<Id>),
    Set(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Global(Global),
    Dtype(Dtype),
    /// `numpy.ndarray` before its state is set.
    BlankArray,
    Array(NdArray),
    Objects(Vec<usize>, Vec<Id>),
    Object(&'static str, Option<Id>),
}

/// All nodes, and what may still be spent on them.
pub(super) struct Arena<'a> {
    pub(super) nodes: Vec<Node<'a>>,
    /// Bytes that may still be spent on arrays and results, so that a short file cannot ask for much memory by
    /// referring to one thing many times.
    budget: usize,
}

impl Arena<'_> {
    /// An empty arena for a file of `size` bytes.
    pub(super) fn new(size: usize) -> Self {
        Self { nodes: Vec::new(), budget: size.saturating_mul(64).saturating_add(1 << 20) }
    }

    /// Takes `bytes` from the budget.
    pub(super) fn spend(&mut self, bytes: usize) -> Step<()> {
        let rest = self.budget.checked_sub(bytes);
        self.budget = rest.ok_or("takes far more memory than the file's size")?;
        Ok(())
    }

    /// The owned tree below a node. Shared nodes are copied, against the budget.
    pub(super) fn value(&mut self, id: Id, depth: usize) -> Step<Value> {
        if depth > MAX_DEPTH {
            return Err(format!("nested deeper than {MAX_DEPTH}"));
        }
        self.spend(size_of::<Value>())?;
        let depth = depth + 1;
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
            Node::Array(array) => {
                let array = array.clone();
                self.spend(8 * array.len())?;
                Value::Array(array)
            }
            Node::List(items) => Value::List(self.values(items.clone(), depth)?),
            Node::Tuple(items) => Value::Tuple(self.values(items.clone(), depth)?),
            Node::Set(items) => Value::Set(self.values(items.clone(), depth)?),
            Node::Objects(shape, items) => {
                let (shape, items) = (shape.clone(), items.clone());
                match items.as_slice() {
                    &[only] if shape.is_empty() => self.value(only, depth)?,
                    _ => Value::Objects { items: self.values(items, depth)?, shape },
                }
            }
            Node::Dict(items) => {
                let mut out = Vec::new();
                for (key, value) in items.clone() {
                    out.push((self.value(key, depth)?, self.value(value, depth)?));
                }
                Value::Dict(out)
            }
            &Node::Object(class, state) => Value::Object {
                class,
                state: Box::new(match state {
                    Some(state) => self.value(state, depth)?,
                    None => Value::Dict(Vec::new()),
                }),
            },
            &Node::Global(Global::Class(class)) => Value::Object { class, state: Box::new(Value::Dict(Vec::new())) },
            Node::Global(_) => return Err("a class or function as a value".to_owned()),
            Node::Dtype(_) => return Err("a dtype as a value".to_owned()),
            Node::BlankArray => return Err("array without data".to_owned()),
        })
    }

    fn values(&mut self, ids: Vec<Id>, depth: usize) -> Step<Vec<Value>> {
        self.spend(8 * ids.len())?;
        ids.into_iter().map(|id| self.value(id, depth)).collect()
    }
}
