//! The stack machine.

use std::borrow::Cow;
use std::collections::HashMap;

use super::globals::{Dtype, Global};
use super::reader::{Reader, Step, long, number, unescape, unquote};
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
    /// Python 2's `str`: text or data, depending on its use.
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

/// Upper bound of the bytes per item of a growing vector: it doubles, and both copies exist while
/// items move.
pub(super) const fn grown<T>() -> usize {
    3 * size_of::<T>()
}
/// Bytes of an entry of the memo: key, value and a control byte in a table that is at least three
/// eighths full.
const MEMO_ENTRY: usize = 3 * (size_of::<(u64, Id)>() + 1);
/// Memory of a pickle beside its own bytes: a multiple of them plus a constant.
const BUDGET_FACTOR: usize = 8;
const BUDGET_FLOOR: usize = 128 << 20;

/// Most arguments of a call; no allowed constructor takes more.
const MAX_ARGUMENTS: usize = 8;

pub(super) struct Machine<'a> {
    pub(super) reader: Reader<'a>,
    /// Offset of the current opcode.
    pub(super) opcode_at: usize,
    pub(super) nodes: Vec<Node<'a>>,
    pub(super) stack: Vec<Id>,
    pub(super) marks: Vec<usize>,
    pub(super) memo: HashMap<u64, Id>,
    /// Number of pickles around this one.
    pub(super) nesting: usize,
    pub(super) budget: Budget,
}

/// Bytes left to allocate. Bounds both opcodes of one byte and repeated references.
pub(super) struct Budget(usize);

impl Budget {
    pub(super) fn spend(&mut self, bytes: usize) -> Step<()> {
        self.0 = self.0.checked_sub(bytes).ok_or("takes far more memory than the file's size")?;
        Ok(())
    }
}

impl<'a> Machine<'a> {
    pub(super) fn new(bytes: &'a [u8], start: usize) -> Self {
        Self {
            reader: Reader { bytes, at: start },
            opcode_at: start,
            nodes: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
            nesting: 0,
            budget: Budget(bytes.len().saturating_mul(BUDGET_FACTOR).saturating_add(BUDGET_FLOOR)),
        }
    }

    /// Runs to STOP and converts the value on top.
    pub(super) fn run(&mut self) -> Step<Value> {
        let top = self.run_to_stop()?;
        self.value_of(top)
    }

    /// Runs to STOP and pops the node on top.
    pub(super) fn run_to_stop(&mut self) -> Step<Id> {
        loop {
            self.opcode_at = self.reader.at;
            match self.reader.take(1)?[0] {
                b'.' => return self.pop(),
                opcode => self.execute(opcode)?,
            }
        }
    }

    /// Adds a node, charged to the budget.
    pub(super) fn add(&mut self, node: Node<'a>) -> Step<Id> {
        self.budget.spend(grown::<Node<'_>>())?;
        self.nodes.push(node);
        Ok(self.nodes.len() - 1)
    }

    fn push(&mut self, node: Node<'a>) -> Step<()> {
        let id = self.add(node)?;
        self.push_id(id)
    }

    fn push_id(&mut self, id: Id) -> Step<()> {
        self.budget.spend(grown::<Id>())?;
        self.stack.push(id);
        Ok(())
    }

    /// Pops one value; never across a mark.
    fn pop(&mut self) -> Step<Id> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    fn top(&self) -> Step<Id> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let held = self.stack.get(floor..).and_then(<[Id]>::last);
        held.copied().ok_or_else(|| "empty stack".to_owned())
    }

    /// Pops everything above the last mark, and the mark.
    fn pop_mark(&mut self) -> Step<Vec<Id>> {
        let mark = self.marks.pop().ok_or("no mark")?;
        self.budget.spend(self.stack.len().saturating_sub(mark) * size_of::<Id>())?;
        Ok(self.stack.split_off(mark))
    }

    fn put(&mut self, key: u64) -> Step<()> {
        let top = self.top()?;
        if self.memo.insert(key, top).is_none() {
            self.budget.spend(MEMO_ENTRY)?;
        }
        Ok(())
    }

    fn get(&mut self, key: u64) -> Step<()> {
        let id = *self.memo.get(&key).ok_or_else(|| format!("no memo {key}"))?;
        self.push_id(id)
    }

    fn append(&mut self, items: &[Id]) -> Step<()> {
        let top = self.top()?;
        self.budget.spend(items.len() * grown::<Id>())?;
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
        self.budget.spend(items.len() * grown::<Id>())?;
        match &mut self.nodes[top] {
            Node::Dict(dict) => dict.extend(items.chunks_exact(2).map(|kv| (kv[0], kv[1]))),
            _ => return Err("set an item of something other than a dict".to_owned()),
        }
        Ok(())
    }

    /// Executes an opcode that works on the stack or the memo.
    fn execute(&mut self, opcode: u8) -> Step<()> {
        let width = width(opcode);
        match opcode {
            0x80 => match self.reader.uint(1)? {
                0..=5 => Ok(()),
                protocol => Err(format!("protocol {protocol}")),
            },
            0x95 => self.reader.uint(width).map(drop),
            b'(' => {
                self.budget.spend(grown::<usize>())?;
                self.marks.push(self.stack.len());
                Ok(())
            }
            // POP removes a mark on top.
            b'0' if self.marks.last() == Some(&self.stack.len()) => {
                self.marks.pop();
                Ok(())
            }
            b'0' => self.pop().map(drop),
            b'1' => self.pop_mark().map(drop),
            b'2' => {
                let top = self.top()?;
                self.push_id(top)
            }
            b'd' => {
                let items = self.pop_mark()?;
                self.push(Node::Dict(Vec::new()))?;
                self.set_items(&items)
            }
            b'a' => {
                let item = self.pop()?;
                self.append(&[item])
            }
            b'e' | 0x90 => {
                let items = self.pop_mark()?;
                self.append(&items)
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set_items(&[key, value])
            }
            b'u' => {
                let items = self.pop_mark()?;
                self.set_items(&items)
            }
            0x94 => self.put(self.memo.len() as u64),
            b'p' | b'q' | b'r' | b'g' | b'h' | b'j' => {
                let is_text = matches!(opcode, b'p' | b'g');
                let key = if is_text { self.reader.number::<i64>()? as u64 } else { self.reader.uint(width)? };
                if matches!(opcode, b'p' | b'q' | b'r') { self.put(key) } else { self.get(key) }
            }
            b'b' => {
                let state = self.pop()?;
                let target = self.top()?;
                self.build(target, state)
            }
            _ => {
                let node = self.node(opcode, width)?;
                self.push(node)
            }
        }
    }

    /// The node that an opcode pushes.
    fn node(&mut self, opcode: u8, width: u64) -> Step<Node<'a>> {
        let reader = &mut self.reader;
        Ok(match opcode {
            b'N' => Node::None,
            0x88 => Node::Bool(true),
            0x89 => Node::Bool(false),
            b'I' => match reader.line()? {
                "00" => Node::Bool(false),
                "01" => Node::Bool(true),
                line => Node::Int(number(line)?),
            },
            b'L' => Node::Int(number(reader.line()?.trim_end_matches('L'))?),
            b'J' => Node::Int((reader.uint(width)? as u32 as i32).into()),
            b'K' | b'M' => Node::Int(reader.uint(width)? as i64),
            0x8a | 0x8b => Node::Int(long(reader.counted(width)?)?),
            b'F' => Node::Float(reader.number()?),
            b'G' => Node::Float(f64::from_bits(reader.uint(width)?.swap_bytes())),
            b'S' => {
                let bytes = unquote(reader.line()?)?;
                self.budget.spend(bytes.len())?;
                Node::ByteString(Cow::Owned(bytes))
            }
            b'T' | b'U' => Node::ByteString(Cow::Borrowed(reader.counted(width)?)),
            b'V' => {
                let text = unescape(reader.line_bytes()?)?;
                self.budget.spend(text.len())?;
                Node::Text(Cow::Owned(text))
            }
            b'X' | 0x8c | 0x8d => {
                let text = std::str::from_utf8(reader.counted(width)?).map_err(|_| "text is not UTF-8")?;
                Node::Text(Cow::Borrowed(text))
            }
            b'B' | b'C' | 0x8e | 0x96 => Node::Bytes(Cow::Borrowed(reader.counted(width)?)),
            b']' => Node::List(Vec::new()),
            b')' => Node::Tuple(Vec::new()),
            b'}' => Node::Dict(Vec::new()),
            0x8f => Node::Set(Vec::new()),
            b'l' => Node::List(self.pop_mark()?),
            b't' => Node::Tuple(self.pop_mark()?),
            0x91 => Node::Set(self.pop_mark()?),
            0x85..=0x87 => {
                let count = usize::from(opcode - 0x84);
                self.budget.spend(count * size_of::<Id>())?;
                let mut items = (0..count).map(|_| self.pop()).collect::<Step<Vec<_>>>()?;
                items.reverse();
                Node::Tuple(items)
            }
            b'c' => Node::Global(Global::find(reader.line()?, reader.line()?)?),
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (Node::Text(module), Node::Text(name)) = (&self.nodes[module], &self.nodes[name]) else {
                    return Err("global without a name".to_owned());
                };
                Node::Global(Global::find(module, name)?)
            }
            b'Q' => Node::Object(PERSISTENT, Some(self.pop()?)),
            b'R' | 0x81 => {
                let (arguments, callable) = (self.pop()?, self.pop()?);
                match (&self.nodes[callable], &self.nodes[arguments]) {
                    (Node::Global(global), Node::Tuple(items)) if items.len() <= MAX_ARGUMENTS => {
                        let (global, items) = (*global, items.clone());
                        self.construct(global, &items)?
                    }
                    _ => return Err("call of something other than a global with a few arguments".to_owned()),
                }
            }
            _ => return Err(format!("opcode {opcode:#04x} is not supported")),
        })
    }
}

/// Bytes of the number behind an opcode: a value, a length or a key of the memo.
fn width(opcode: u8) -> u64 {
    match opcode {
        b'K' | b'U' | b'C' | b'q' | b'h' | 0x8a | 0x8c => 1,
        b'M' => 2,
        b'G' | 0x8d | 0x8e | 0x95 | 0x96 => 8,
        _ => 4,
    }
}
