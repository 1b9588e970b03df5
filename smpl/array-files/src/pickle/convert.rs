//! Conversion of the machine's nodes to values.

use super::globals::{Global, WRAPPER};
use super::machine::{Id, Machine, Node};
use super::numpy::latin1;
use super::reader::Step;
use super::value::Value;
use crate::array::{Data, NdArray};

/// Deepest nesting of containers.
const MAX_DEPTH: usize = 100;

impl Machine<'_> {
    /// The owned tree below `top`, once the machine has stopped.
    pub(super) fn value_of(&mut self, top: Id) -> Step<Value> {
        let uses = self.uses();
        self.value(top, &uses, true, 0)
    }

    /// Number of references to each node, counted up to 2. A node with one is moved, not copied.
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

    /// The owned tree below a node. Copies of shared nodes are charged to the budget; `owned` says
    /// that the path to this node is the only one.
    fn value(&mut self, id: Id, uses: &[u8], owned: bool, depth: usize) -> Step<Value> {
        if depth > MAX_DEPTH {
            return Err(format!("nested deeper than {MAX_DEPTH}"));
        }
        self.budget.spend(size_of::<Value>())?;
        let owned = owned && uses[id] < 2;
        let below = |machine: &mut Self, id: Id| machine.value(id, uses, owned, depth + 1);
        Ok(match &mut self.nodes[id] {
            Node::None => Value::None,
            Node::Bool(value) => Value::Bool(*value),
            Node::Int(value) => Value::Int(*value),
            Node::Float(value) => Value::Float(*value),
            Node::Text(text) => {
                self.budget.spend(text.len())?;
                Value::Str(text.to_string())
            }
            Node::ByteString(bytes) => {
                // Latin-1 beyond ASCII takes two bytes in UTF-8.
                self.budget.spend(2 * bytes.len())?;
                Value::Str(latin1(bytes))
            }
            Node::Bytes(bytes) => {
                self.budget.spend(bytes.len())?;
                Value::Bytes(bytes.to_vec())
            }
            Node::Array(array) if owned => {
                let empty = NdArray { shape: Vec::new(), data: Data::Bool(Vec::new()) };
                Value::Array(std::mem::replace(array, empty))
            }
            Node::Array(array) => {
                self.budget.spend(8 * array.len())?;
                Value::Array(array.as_ref().clone())
            }
            Node::List(items) | Node::Tuple(items) | Node::Set(items) => {
                let items = items.clone();
                let items = self.values(items, below)?;
                match self.nodes[id] {
                    Node::List(_) => Value::List(items),
                    Node::Tuple(_) => Value::Tuple(items),
                    _ => Value::Set(items),
                }
            }
            Node::Objects(objects) => {
                let (shape, items) = objects.as_ref().clone();
                match items.as_slice() {
                    &[only] if shape.is_empty() => below(self, only)?,
                    _ => Value::Objects { items: self.values(items, below)?, shape },
                }
            }
            Node::Dict(items) => {
                let items = items.clone();
                self.budget.spend(items.len() * (size_of::<(Id, Id)>() + size_of::<(Value, Value)>()))?;
                let mut out = Vec::with_capacity(items.len());
                for (key, value) in items {
                    out.push((below(self, key)?, below(self, value)?));
                }
                Value::Dict(out)
            }
            Node::Object(WRAPPER, _) | Node::Global(Global::Class(WRAPPER)) => {
                return Err("joblib array without its state".to_owned());
            }
            &mut Node::Object(class, Some(state)) => Value::Object { class, state: Box::new(below(self, state)?) },
            &mut (Node::Object(class, None) | Node::Global(Global::Class(class))) => {
                Value::Object { class, state: Box::new(Value::Dict(Vec::new())) }
            }
            Node::Global(_) => return Err("a class or function as a value".to_owned()),
            Node::Dtype(_) => return Err("a dtype as a value".to_owned()),
            Node::BlankArray => return Err("array without data".to_owned()),
        })
    }

    fn values(&mut self, ids: Vec<Id>, mut below: impl FnMut(&mut Self, Id) -> Step<Value>) -> Step<Vec<Value>> {
        self.budget.spend(ids.len() * (size_of::<Id>() + size_of::<Value>()))?;
        ids.into_iter().map(|id| below(self, id)).collect()
    }
}
