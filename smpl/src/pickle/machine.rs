//! The stack machine.

use std::borrow::Cow;
use std::collections::HashMap;

use super::globals::{Dtype, Global};
use super::reader::{Reader, Step, long, unescape, unquote};
use super::value::{PERSISTENT, Value};
use crate::array::NdArray;

/// Index of a node. Nodes live in one arena, because a container can be referred to before it is
/// filled.
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
    Array(Box<NdArray>),
    Objects(Box<(Vec<usize>, Vec<Id>)>),
    Object(&'static str, Option<Id>),
}

/// Bytes that one item of a vector takes at most: vectors double as they grow, and are there twice
/// while they move.
pub(super) const fn grown<T>() -> usize {
    3 * size_of::<T>()
}
/// Bytes of an entry of the memo: key, value and a control byte in a table that is at least three
/// eighths full.
const MEMO_ENTRY: usize = 3 * (size_of::<(u64, Id)>() + 1);
/// Bytes that a pickle may take beside its own: so many for each of its bytes, and so many in any
/// case.
const BUDGET_FACTOR: usize = 8;
const BUDGET_FLOOR: usize = 128 << 20;

/// No allowed constructor takes more.
const MAX_ARGUMENTS: usize = 8;

pub(super) struct Machine<'a> {
    pub(super) reader: Reader<'a>,
    /// Where the current opcode starts.
    opcode_at: usize,
    pub(super) nodes: Vec<Node<'a>>,
    pub(super) stack: Vec<Id>,
    pub(super) marks: Vec<usize>,
    pub(super) memo: HashMap<u64, Id>,
    /// How many pickles this one is within.
    pub(super) nesting: usize,
    /// Bytes that may still be spent, so that a file can ask for no more memory than a multiple of
    /// its size, whether by opcodes that take one byte each or by referring to one thing many
    /// times.
    budget: usize,
}

impl<'a> Machine<'a> {
    pub(super) fn new(bytes: &'a [u8], start: usize) -> Self {
        Self {
            reader: Reader::new(bytes, start),
            opcode_at: start,
            nodes: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
            nesting: 0,
            budget: bytes.len().saturating_mul(BUDGET_FACTOR).saturating_add(BUDGET_FLOOR),
        }
    }

    pub(super) fn offset(&self) -> usize {
        self.opcode_at
    }

    /// Runs to STOP and gives the value on top.
    pub(super) fn run(&mut self) -> Step<Value> {
        let top = self.run_to_stop()?;
        self.value_of(top)
    }

    /// Runs to STOP and gives the node on top.
    pub(super) fn run_to_stop(&mut self) -> Step<Id> {
        loop {
            self.opcode_at = self.reader.offset();
            let opcode = self.reader.u8()?;
            if opcode == b'.' {
                return self.pop();
            }
            self.execute(opcode)?;
        }
    }

    /// Takes `bytes` from the budget.
    pub(super) fn spend(&mut self, bytes: usize) -> Step<()> {
        let rest = self.budget.checked_sub(bytes);
        self.budget = rest.ok_or("takes far more memory than the file's size")?;
        Ok(())
    }

    /// Adds a node, paid for.
    pub(super) fn add(&mut self, node: Node<'a>) -> Step<Id> {
        self.spend(grown::<Node<'_>>())?;
        self.nodes.push(node);
        Ok(self.nodes.len() - 1)
    }

    fn push(&mut self, node: Node<'a>) -> Step<()> {
        let id = self.add(node)?;
        self.push_id(id)
    }

    fn push_id(&mut self, id: Id) -> Step<()> {
        self.spend(grown::<Id>())?;
        self.stack.push(id);
        Ok(())
    }

    /// Pushes text or bytes that are not the file's own.
    fn push_made(&mut self, length: usize, node: Node<'a>) -> Step<()> {
        self.spend(length)?;
        self.push(node)
    }

    /// Pops one value; never across a mark.
    fn pop(&mut self) -> Step<Id> {
        self.top()?;
        self.stack.pop().ok_or_else(|| "empty stack".to_owned())
    }

    fn top(&self) -> Step<Id> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let held = self.stack.get(floor..).and_then(<[Id]>::last);
        held.copied().ok_or_else(|| "empty stack".to_owned())
    }

    /// Pops everything above the last mark, and the mark.
    fn pop_mark(&mut self) -> Step<Vec<Id>> {
        let mark = self.marks.pop().ok_or("no mark")?;
        self.spend(self.stack.len().saturating_sub(mark) * size_of::<Id>())?;
        Ok(self.stack.split_off(mark))
    }

    /// The last `n` values as a tuple.
    fn tuple(&mut self, n: usize) -> Step<()> {
        let mut items = Vec::with_capacity(n);
        for _ in 0..n {
            items.push(self.pop()?);
        }
        items.reverse();
        self.spend(n * size_of::<Id>())?;
        self.push(Node::Tuple(items))
    }

    fn put(&mut self, key: u64) -> Step<()> {
        let top = self.top()?;
        if self.memo.insert(key, top).is_none() {
            self.spend(MEMO_ENTRY)?;
        }
        Ok(())
    }

    fn get(&mut self, key: u64) -> Step<()> {
        let id = *self.memo.get(&key).ok_or_else(|| format!("no memo {key}"))?;
        self.push_id(id)
    }

    fn append(&mut self, items: Vec<Id>) -> Step<()> {
        let top = self.top()?;
        self.spend(items.len() * grown::<Id>())?;
        match &mut self.nodes[top] {
            Node::List(list) | Node::Set(list) => list.extend(items),
            _ => return Err("append to something other than a list or set".to_owned()),
        }
        Ok(())
    }

    fn set_items(&mut self, items: &[Id]) -> Step<()> {
        let top = self.top()?;
        if !items.len().is_multiple_of(2) {
            return Err("key without a value".to_owned());
        }
        self.spend(items.len() * grown::<Id>())?;
        match &mut self.nodes[top] {
            Node::Dict(dict) => dict.extend(items.chunks_exact(2).map(|kv| (kv[0], kv[1]))),
            _ => return Err("set an item of something other than a dict".to_owned()),
        }
        Ok(())
    }

    fn execute(&mut self, opcode: u8) -> Step<()> {
        let number = |line: &str| line.trim().parse().map_err(|_| format!("number {line:?}"));
        match opcode {
            0x80 => {
                let protocol = self.reader.u8()?;
                if protocol > 5 {
                    return Err(format!("protocol {protocol}"));
                }
            }
            0x95 => {
                self.reader.uint(8)?;
            }
            b'(' => {
                self.spend(grown::<usize>())?;
                self.marks.push(self.stack.len());
            }
            b'0' => {
                // POP takes a mark if that is what is on top.
                if self.marks.last() == Some(&self.stack.len()) {
                    self.marks.pop();
                } else {
                    self.pop()?;
                }
            }
            b'1' => drop(self.pop_mark()?),
            b'2' => {
                let top = self.top()?;
                self.push_id(top)?;
            }
            b'N' => self.push(Node::None)?,
            0x88 => self.push(Node::Bool(true))?,
            0x89 => self.push(Node::Bool(false))?,
            b'I' => {
                let node = match self.reader.line()? {
                    "00" => Node::Bool(false),
                    "01" => Node::Bool(true),
                    line => Node::Int(number(line)?),
                };
                self.push(node)?;
            }
            b'L' => {
                let line = self.reader.line()?;
                let value = number(line.trim_end_matches('L'))?;
                self.push(Node::Int(value))?;
            }
            b'J' => {
                let value = self.reader.uint(4)? as u32 as i32;
                self.push(Node::Int(value.into()))?;
            }
            b'K' => {
                let value = self.reader.uint(1)?;
                self.push(Node::Int(value as i64))?;
            }
            b'M' => {
                let value = self.reader.uint(2)?;
                self.push(Node::Int(value as i64))?;
            }
            0x8a | 0x8b => {
                let bytes = self.reader.counted(if opcode == 0x8a { 1 } else { 4 })?;
                self.push(Node::Int(long(bytes)?))?;
            }
            b'F' => {
                let line = self.reader.line()?;
                let value = line.trim().parse();
                self.push(Node::Float(value.map_err(|_| format!("number {line:?}"))?))?;
            }
            b'G' => {
                let bits = self.reader.uint(8)?.swap_bytes();
                self.push(Node::Float(f64::from_bits(bits)))?;
            }
            b'S' => {
                let bytes = unquote(self.reader.line()?)?;
                self.push_made(bytes.len(), Node::ByteString(Cow::Owned(bytes)))?;
            }
            b'T' | b'U' => {
                let bytes = self.reader.counted(if opcode == b'T' { 4 } else { 1 })?;
                self.push(Node::ByteString(Cow::Borrowed(bytes)))?;
            }
            b'V' => {
                let text = unescape(self.reader.line_bytes()?)?;
                self.push_made(text.len(), Node::Text(Cow::Owned(text)))?;
            }
            b'X' | 0x8c | 0x8d => {
                let size = match opcode {
                    b'X' => 4,
                    0x8c => 1,
                    _ => 8,
                };
                let text = self.reader.counted_text(size)?;
                self.push(Node::Text(text))?;
            }
            b'B' | b'C' | 0x8e | 0x96 => {
                let size = match opcode {
                    b'B' => 4,
                    b'C' => 1,
                    _ => 8,
                };
                let bytes = self.reader.counted(size)?;
                self.push(Node::Bytes(Cow::Borrowed(bytes)))?;
            }
            b']' => self.push(Node::List(Vec::new()))?,
            b')' => self.push(Node::Tuple(Vec::new()))?,
            b'}' => self.push(Node::Dict(Vec::new()))?,
            0x8f => self.push(Node::Set(Vec::new()))?,
            b'l' => {
                let items = self.pop_mark()?;
                self.push(Node::List(items))?;
            }
            b't' => {
                let items = self.pop_mark()?;
                self.push(Node::Tuple(items))?;
            }
            b'd' => {
                let items = self.pop_mark()?;
                self.push(Node::Dict(Vec::new()))?;
                self.set_items(&items)?;
            }
            0x91 => {
                let items = self.pop_mark()?;
                self.push(Node::Set(items))?;
            }
            0x85..=0x87 => self.tuple(usize::from(opcode - 0x84))?,
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])?;
            }
            b'e' | 0x90 => {
                let items = self.pop_mark()?;
                self.append(items)?;
            }
            b's' => {
                let value = self.pop()?;
                let key = self.pop()?;
                self.set_items(&[key, value])?;
            }
            b'u' => {
                let items = self.pop_mark()?;
                self.set_items(&items)?;
            }
            b'p' => {
                let key = number(self.reader.line()?)?;
                self.put(key as u64)?;
            }
            b'q' | b'r' => {
                let key = self.reader.uint(if opcode == b'q' { 1 } else { 4 })?;
                self.put(key)?;
            }
            0x94 => self.put(self.memo.len() as u64)?,
            b'g' => {
                let key = number(self.reader.line()?)?;
                self.get(key as u64)?;
            }
            b'h' | b'j' => {
                let key = self.reader.uint(if opcode == b'h' { 1 } else { 4 })?;
                self.get(key)?;
            }
            b'c' => {
                let module = self.reader.line()?;
                let name = self.reader.line()?;
                self.push(Node::Global(Global::find(module, name)?))?;
            }
            0x93 => {
                let name = self.pop()?;
                let module = self.pop()?;
                let global = match (&self.nodes[module], &self.nodes[name]) {
                    (Node::Text(module), Node::Text(name)) => Global::find(module, name)?,
                    _ => return Err("global without a name".to_owned()),
                };
                self.push(Node::Global(global))?;
            }
            b'Q' => {
                let id = self.pop()?;
                self.push(Node::Object(PERSISTENT, Some(id)))?;
            }
            b'R' | 0x81 => {
                let arguments = self.pop()?;
                let callable = self.pop()?;
                let node = match (&self.nodes[callable], &self.nodes[arguments]) {
                    (Node::Global(global), Node::Tuple(items)) if items.len() <= MAX_ARGUMENTS => {
                        let (global, items) = (*global, items.clone());
                        self.construct(global, &items)?
                    }
                    _ => {
                        return Err("call of something other than a global with a few arguments".to_owned());
                    }
                };
                self.push(node)?;
            }
            b'b' => {
                let state = self.pop()?;
                let target = self.top()?;
                self.build(target, state)?;
            }
            _ => return Err(format!("opcode {opcode:#04x} is not supported")),
        }
        Ok(())
    }
}
