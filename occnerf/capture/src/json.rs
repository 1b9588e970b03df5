//! JSON files as values of pickles.

use std::cell::Cell;
use std::fmt;
use std::path::Path;

use array_files::pickle::Value;
use array_files::{Data, NdArray};
use serde::de::{DeserializeSeed, Deserializer, Error, MapAccess, SeqAccess, Visitor};

use super::CaptureError;
use super::files::read_text;

/// Most values outside of arrays, each of some hundred bytes.
const MAX_VALUES: usize = 1 << 21;

/// Reads a file of at most `most` bytes. Nested lists of numbers with equally long rows are arrays,
/// gathered while they are read: memory is bounded by [`MAX_VALUES`] and a few times the file's
/// size, nesting by the parser.
pub(super) fn read(path: &Path, most: u64) -> Result<Value, CaptureError> {
    let (text, kept) = (read_text(path, most)?, Cell::new(0));
    let mut parser = serde_json::Deserializer::from_str(&text);
    let parsed = Json(&kept).deserialize(&mut parser).and_then(|value| parser.end().map(|()| value));
    parsed.map_err(|error| CaptureError::invalid(path, "the file", "JSON", error.to_string()))
}

/// Parses a value; holds the number of values kept outside of arrays.
#[derive(Clone, Copy)]
struct Json<'a>(&'a Cell<usize>);

impl Json<'_> {
    fn keep<E: Error>(self, count: usize) -> Result<(), E> {
        self.0.set(self.0.get() + count);
        let fits = self.0.get() <= MAX_VALUES;
        fits.then_some(()).ok_or_else(|| E::custom(format!("more than {MAX_VALUES} values outside of arrays")))
    }
}

impl<'de> DeserializeSeed<'de> for Json<'_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Json<'_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("JSON")
    }

    fn visit_unit<E: Error>(self) -> Result<Value, E> {
        Ok(Value::None)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value, E> {
        self.visit_f64(f64::from(u8::from(value)))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Value, E> {
        self.visit_f64(value as f64)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Value, E> {
        self.visit_f64(value as f64)
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Float(value))
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Value, E> {
        Ok(Value::Str(text.to_owned()))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Value, A::Error> {
        let mut items = Vec::new();
        while let Some(key) = map.next_key::<String>()? {
            // The innermost two names, such as frame and key, prefix an error.
            let named = |error: String| match error.matches(": ").count() {
                0 | 1 => A::Error::custom(format!("{key}: {error}")),
                _ => A::Error::custom(error),
            };
            self.keep(1)?;
            let value = map.next_value_seed(self).map_err(|error| named(error.to_string()))?;
            items.push((Value::Str(key), value));
        }
        Ok(Value::Dict(items))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Value, A::Error> {
        let (mut stack, mut items) = (Stack::default(), Vec::new());
        while let Some(item) = seq.next_element_seed(self)? {
            if !items.is_empty() || !stack.push(&item) {
                self.keep(stack.count + 1)?;
                items.extend(std::mem::take(&mut stack).into_items());
                items.push(item);
            }
        }
        Ok(if stack.count > 0 { stack.into_array() } else { Value::List(items) })
    }
}

/// Numbers, or arrays of one shape.
#[derive(Default)]
struct Stack {
    shape: Vec<usize>,
    count: usize,
    values: Vec<f64>,
}

impl Stack {
    /// Adds an item; false for one of another kind or shape.
    fn push(&mut self, item: &Value) -> bool {
        let (shape, values) = match item {
            Value::Float(number) => (&[][..], std::slice::from_ref(number)),
            Value::Array(NdArray { shape, data: Data::F64(values) }) => (&shape[..], &values[..]),
            _ => return false,
        };
        if self.count == 0 {
            self.shape = shape.to_vec();
        }
        let fits = self.shape == shape;
        if fits {
            self.count += 1;
            self.values.extend(values);
        }
        fits
    }

    fn into_array(mut self) -> Value {
        self.shape.insert(0, self.count);
        Value::Array(NdArray { shape: self.shape, data: Data::F64(self.values) })
    }

    fn into_items(self) -> Vec<Value> {
        let each = self.shape.iter().product::<usize>();
        let item = |i: usize| match (&self.values[i * each..(i + 1) * each], self.shape.as_slice()) {
            (&[number], []) => Value::Float(number),
            (values, shape) => Value::Array(NdArray { shape: shape.to_vec(), data: Data::F64(values.to_vec()) }),
        };
        (0..self.count).map(item).collect()
    }
}
