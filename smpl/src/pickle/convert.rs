//! What the machine has built, as values.

use super::globals::{Global, WRAPPER};
use super::machine::{Id, Machine, Node};
use super::reader::Step;
use super::value::{MAX_DEPTH, Value};

impl Machine<'_> {
    /// The owned tree below `top`, once the machine has stopped.
    pub(super) fn value_of(&mut self, top: Id) -> Step<Value> {
        let uses = self.uses();
        self.value(top, &uses, true, 0)
    }

    /// How often each node is referred to, counted up to 2. What is used once can be moved rather
    /// than copied.
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

    /// The owned tree below a node. Shared nodes are copied, against the budget; `owned` says that
    /// no other node leads here.
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
