//! Calls of the allowed globals, and the states of what they construct.

use std::borrow::Cow;

use super::globals::{Dtype, Global, WRAPPER, count};
use super::machine::{Id, Machine, Node, grown};
use super::reader::Step;

/// Deepest nesting of pickles in pickles; an array of objects is one.
const MAX_NESTED: usize = 4;

impl<'a> Machine<'a> {
    /// Calls `global` with `arguments`.
    pub(super) fn construct(&mut self, global: Global, arguments: &[Id]) -> Step<Node<'a>> {
        let wrong = |what: &str| Err(format!("arguments of {what}"));
        Ok(match (global, arguments) {
            // The arguments are placeholders; BUILD sets shape, type and data.
            (Global::Reconstruct | Global::Ndarray, _) => Node::BlankArray,
            (Global::Dtype, [name, ..]) => Node::Dtype(Dtype::parse(&self.text(*name)?)?),
            (Global::Scalar, [dtype, raw]) => self.array(self.dtype(*dtype)?, Vec::new(), false, *raw)?,
            (Global::FromBuffer, [raw, dtype, shape, order]) => {
                let (dtype, shape) = (self.dtype(*dtype)?, self.shape(*shape)?);
                let fortran = self.text(*order)? == "F";
                self.array(dtype, shape, fortran, *raw)?
            }
            (Global::CopyReconstructor, [class, ..]) => match self.nodes[*class] {
                Node::Global(Global::Class(class)) => Node::Object(class, None),
                Node::Global(Global::Ndarray) => Node::BlankArray,
                _ => return wrong("_reconstructor"),
            },
            (Global::Class(class), _) => Node::Object(class, None),
            (Global::Set, []) => Node::Set(Vec::new()),
            (Global::Set, [items]) => match &self.nodes[*items] {
                Node::List(items) | Node::Tuple(items) | Node::Set(items) => {
                    self.budget.spend(8 + 8 * items.len())?;
                    Node::Set(items.clone())
                }
                _ => return wrong("set"),
            },
            (Global::Bytes, []) => Node::Bytes(Cow::Borrowed(&[])),
            (Global::Bytes, [raw]) => match &self.nodes[*raw] {
                Node::Bytes(bytes) | Node::ByteString(bytes) => {
                    self.budget.spend(bytes.len())?;
                    Node::Bytes(bytes.clone())
                }
                _ => return wrong("bytes"),
            },
            (Global::List, []) => Node::List(Vec::new()),
            (Global::Dict, []) => Node::Dict(Vec::new()),
            (Global::Dict, [argument]) => match &self.nodes[*argument] {
                Node::List(items) => {
                    self.budget.spend(16 * items.len())?;
                    let pairs = items.iter().map(|&item| match &self.nodes[item] {
                        Node::List(kv) | Node::Tuple(kv) if kv.len() == 2 => Ok((kv[0], kv[1])),
                        _ => Err("arguments of OrderedDict"),
                    });
                    Node::Dict(pairs.collect::<Result<_, _>>()?)
                }
                // The factory of a `defaultdict`.
                Node::None | Node::Global(_) => Node::Dict(Vec::new()),
                _ => return wrong("OrderedDict"),
            },
            (Global::Encode, [text, ..]) => {
                let Node::Text(text) = &self.nodes[*text] else {
                    return wrong("encode");
                };
                self.budget.spend(text.len())?;
                let bytes = text.chars().map(u8::try_from).collect::<Result<_, _>>();
                Node::Bytes(Cow::Owned(bytes.map_err(|_| "text beyond Latin-1")?))
            }
            (Global::RebuildTensor, [_, _, _, _, ..]) => {
                self.budget.spend(8 * arguments.len())?;
                let state = self.add(Node::Tuple(arguments.to_vec()))?;
                Node::Object("torch.Tensor", Some(state))
            }
            (Global::RebuildParameter, [tensor, ..]) => match self.nodes[*tensor] {
                Node::Object(class, state) => Node::Object(class, state),
                _ => return wrong("_rebuild_parameter"),
            },
            _ => return wrong("a constructor"),
        })
    }

    /// Sets the state of the object `target`.
    pub(super) fn build(&mut self, target: Id, state: Id) -> Step<()> {
        match (&self.nodes[target], &self.nodes[state]) {
            (Node::BlankArray, Node::Tuple(items)) => {
                let &[_, shape, dtype, fortran, raw] = items.as_slice() else {
                    return Err("state of an array".to_owned());
                };
                let (dtype, shape) = (self.dtype(dtype)?, self.shape(shape)?);
                let fortran = match self.nodes[fortran] {
                    Node::Bool(value) => value,
                    Node::Int(value) => value != 0,
                    _ => return Err("state of an array".to_owned()),
                };
                self.nodes[target] = self.array(dtype, shape, fortran, raw)?;
            }
            (&Node::Dtype(dtype), Node::Tuple(items)) => {
                let order = self.text(*items.get(1).ok_or("state of a dtype")?)?;
                let dtype = match dtype {
                    Dtype::Number(element) => Dtype::Number(element.with_order(&order)),
                    Dtype::WideText { size, .. } => Dtype::WideText { size, big_endian: order == ">" },
                    other => other,
                };
                self.nodes[target] = Node::Dtype(dtype);
            }
            (Node::Object(WRAPPER, _), Node::Dict(items)) => {
                let items = items.clone();
                self.nodes[target] = self.joblib_array(&items)?;
            }
            (&Node::Object(class, _), Node::Dict(_)) => self.nodes[target] = Node::Object(class, Some(state)),
            // Attributes of an `OrderedDict`, such as a state dictionary's versions, are dropped.
            (Node::Dict(_), Node::Dict(_)) => {}
            _ => return Err("state of something that has none".to_owned()),
        }
        Ok(())
    }

    /// An array from its bytes or, for objects, a list of items.
    fn array(&mut self, dtype: Dtype, shape: Vec<usize>, fortran: bool, raw: Id) -> Step<Node<'a>> {
        let Dtype::Object = dtype else {
            let (Node::Bytes(bytes) | Node::ByteString(bytes)) = &self.nodes[raw] else {
                return Err("data of an array".to_owned());
            };
            if let Cow::Owned(bytes) = bytes {
                self.budget.spend(bytes.len())?;
            }
            let bytes = bytes.clone();
            return self.raw_array(dtype, shape, fortran, &bytes);
        };
        if fortran && shape.len() > 1 {
            return Err("column-major array of objects".to_owned());
        }
        let count = count(&shape)?;
        self.budget.spend(8 * shape.len())?;
        let items = match &self.nodes[raw] {
            Node::List(items) if items.len() == count => {
                self.budget.spend(8 * count)?;
                items.clone()
            }
            Node::List(items) => return Err(mismatch(&shape, items.len())),
            // A scalar of object type holds the object itself.
            _ if shape.is_empty() => vec![raw],
            _ => return Err("data of an array".to_owned()),
        };
        Ok(Node::Objects(Box::new((shape, items))))
    }

    /// An array from the bytes of its elements, which are not objects.
    pub(super) fn raw_array(&mut self, dtype: Dtype, shape: Vec<usize>, fortran: bool, raw: &[u8]) -> Step<Node<'a>> {
        let count = count(&shape)?;
        self.budget.spend(8 * shape.len())?;
        match dtype {
            Dtype::Number(element) => {
                // Reordering holds two copies for a while.
                let copies = if fortran { 2 } else { 1 };
                let length = count.min(raw.len());
                self.budget.spend(length.saturating_mul(copies * element.size_in_memory()))?;
                let array = element.decode(raw, &shape, fortran);
                Ok(Node::Array(Box::new(array.ok_or_else(|| mismatch(&shape, raw.len()))?)))
            }
            Dtype::Object => Err("data of an array".to_owned()),
            Dtype::ByteText(_) | Dtype::WideText { .. } if fortran && shape.len() > 1 => {
                Err("column-major array of text".to_owned())
            }
            Dtype::ByteText(size) | Dtype::WideText { size, .. } => {
                if count.checked_mul(size) != Some(raw.len()) {
                    return Err(mismatch(&shape, raw.len()));
                }
                self.budget.spend(2 * raw.len() + count.saturating_mul(grown::<Id>()))?;
                let mut items = Vec::with_capacity(count);
                for item in raw.chunks_exact(size) {
                    items.push(self.add(Node::Text(Cow::Owned(padded_text(dtype, item)?)))?);
                }
                Ok(Node::Objects(Box::new((shape, items))))
            }
        }
    }

    /// The array described by a wrapper's attributes. Behind the wrapper follow the length of the
    /// padding (one byte), padding and elements; up to joblib 1.1, which lacks the attribute for
    /// the alignment, the elements alone; and for elements that are objects a pickle of the array.
    pub(super) fn joblib_array(&mut self, attributes: &[(Id, Id)]) -> Step<Node<'a>> {
        let find = |name: &str| {
            let named = |id: Id| matches!(&self.nodes[id], Node::Text(text) if text == name);
            attributes.iter().rev().find(|(key, _)| named(*key)).map(|(_, value)| *value)
        };
        let demand = |name: &str| find(name).ok_or_else(|| format!("joblib array without `{name}`"));
        let (shape, order, dtype) = (demand("shape")?, demand("order")?, demand("dtype")?);
        let aligned = find("numpy_array_alignment_bytes").is_some_and(|id| !matches!(self.nodes[id], Node::None));
        let (dtype, shape) = (self.dtype(dtype)?, self.shape(shape)?);
        let fortran = match self.text(order)?.as_ref() {
            "C" => false,
            "F" => true,
            other => return Err(format!("order {other:?} of a joblib array, expected C or F")),
        };
        let Some(length) = dtype.raw_bytes(&shape)? else { return self.nested() };
        if aligned {
            self.reader.counted(1)?;
        }
        let bytes = self.reader.take(length)?;
        self.raw_array(dtype, shape, fortran, bytes)
    }

    /// The value of the pickle that starts here, with a stack and a memo of its own.
    fn nested(&mut self) -> Step<Node<'a>> {
        if self.nesting >= MAX_NESTED {
            return Err(format!("pickles nested deeper than {MAX_NESTED}"));
        }
        let outer = (std::mem::take(&mut self.stack), std::mem::take(&mut self.marks), std::mem::take(&mut self.memo));
        self.nesting += 1;
        let top = self.run_to_stop();
        self.nesting -= 1;
        (self.stack, self.marks, self.memo) = outer;
        Ok(std::mem::replace(&mut self.nodes[top?], Node::None))
    }

    pub(super) fn dtype(&self, id: Id) -> Step<Dtype> {
        match &self.nodes[id] {
            Node::Dtype(dtype) => Ok(*dtype),
            _ => Err("array without a dtype".to_owned()),
        }
    }

    pub(super) fn shape(&self, id: Id) -> Step<Vec<usize>> {
        let extent = |id: &Id| match self.nodes[*id] {
            Node::Int(n) => usize::try_from(n).ok(),
            _ => None,
        };
        let shape = match &self.nodes[id] {
            Node::Tuple(items) if items.len() <= 64 => items.iter().map(extent).collect(),
            Node::Int(_) => extent(&id).map(|n| vec![n]),
            _ => None,
        };
        shape.ok_or_else(|| "shape of an array".to_owned())
    }

    /// A short text: the name of a type or an order.
    pub(super) fn text(&self, id: Id) -> Step<Cow<'_, str>> {
        match &self.nodes[id] {
            Node::Text(text) if text.len() <= 64 => Ok(Cow::Borrowed(text)),
            Node::ByteString(bytes) | Node::Bytes(bytes) if bytes.len() <= 64 => Ok(Cow::Owned(latin1(bytes))),
            _ => Err("expected a short text".to_owned()),
        }
    }
}

fn mismatch(shape: &[usize], found: usize) -> String {
    format!("shape {shape:?} with {found} bytes or items of data")
}

/// An item of an array of texts, without its padding.
fn padded_text(dtype: Dtype, item: &[u8]) -> Step<String> {
    let text = match dtype {
        Dtype::WideText { big_endian, .. } => wide_text(item, big_endian)?,
        _ => latin1(item),
    };
    Ok(text.trim_end_matches('\0').to_owned())
}

pub(super) fn latin1(bytes: &[u8]) -> String {
    bytes.iter().copied().map(char::from).collect()
}

fn wide_text(bytes: &[u8], big_endian: bool) -> Step<String> {
    let decode = if big_endian { u32::from_be_bytes } else { u32::from_le_bytes };
    let text: Option<String> = bytes.as_chunks().0.iter().map(|&unit| char::from_u32(decode(unit))).collect();
    text.ok_or_else(|| "text is not UTF-32".to_owned())
}
