//! Arrays of `joblib.dump`: a describing object, and behind its state the array's bytes.

use super::machine::{Id, Machine, Node};
use super::reader::Step;

/// Deepest nesting of pickles in pickles; an array of objects is one.
const MAX_NESTED: usize = 4;

impl<'a> Machine<'a> {
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
}
