//! `metadata.json` as records.

use std::fmt;
use std::marker::PhantomData;
use std::path::Path;

use array_files::pickle::Value;
use array_files::{Data, NdArray};
use serde::de::{Deserialize, Deserializer, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};

use crate::CaptureError;
use crate::files::read_text;
use crate::records::Records;

/// Largest file: tens of thousands of frames.
const MAX_BYTES: u64 = 64 << 20;
/// Keys of a frame; others are ignored.
const KEYS: [&str; 6] = ["poses", "betas", "cam_intrinsics", "cam_extrinsics", "distortions", "keypoints"];

/// Reads the file; memory is bounded by a few times its size, nesting by the parser.
pub(super) fn read(path: &Path) -> Result<Records, CaptureError> {
    let text = read_text(path, MAX_BYTES)?;
    let Keyed(frames) = serde_json::from_str::<Keyed<Keyed<Numbers>>>(&text).map_err(|error| {
        CaptureError::invalid(path, "the file", "JSON of frames and their arrays", error.to_string())
    })?;
    let key = |key: String| Value::Str(key);
    let frame = |Keyed(items): Keyed<Numbers>| {
        Value::Dict(items.into_iter().map(|(k, numbers)| (key(k), Value::Array(numbers.into_array()))).collect())
    };
    Records::new(path, Value::Dict(frames.into_iter().map(|(k, items)| (key(k), frame(items))).collect()))
}

/// A JSON object whose keys prefix the errors of their values.
struct Keyed<T>(Vec<(String, T)>);

/// A value of an object.
trait Item: for<'de> Deserialize<'de> {
    /// Whether a value under `key` is read.
    fn is_read(key: &str) -> bool;
}

impl Item for Keyed<Numbers> {
    fn is_read(_: &str) -> bool {
        true
    }
}

impl Item for Numbers {
    fn is_read(key: &str) -> bool {
        KEYS.contains(&key)
    }
}

impl<'de, T: Item> Deserialize<'de> for Keyed<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(KeyedVisitor(PhantomData))
    }
}

struct KeyedVisitor<T>(PhantomData<T>);

impl<'de, T: Item> Visitor<'de> for KeyedVisitor<T> {
    type Value = Keyed<T>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Keyed<T>, A::Error> {
        let mut items = Vec::new();
        while let Some(key) = map.next_key::<String>()? {
            if T::is_read(&key) {
                let value = map.next_value().map_err(|error| A::Error::custom(format!("{key}: {error}")))?;
                items.push((key, value));
            } else {
                map.next_value::<IgnoredAny>()?;
            }
        }
        Ok(Keyed(items))
    }
}

/// A number, or nested lists of them with equally long rows.
enum Numbers {
    Scalar(f64),
    Array(Vec<usize>, Vec<f64>),
}

impl Numbers {
    fn into_array(self) -> NdArray {
        let (shape, values) = match self {
            Self::Scalar(value) => (Vec::new(), vec![value]),
            Self::Array(shape, values) => (shape, values),
        };
        NdArray { shape, data: Data::F64(values) }
    }
}

impl<'de> Deserialize<'de> for Numbers {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NumbersVisitor)
    }
}

struct NumbersVisitor;

impl<'de> Visitor<'de> for NumbersVisitor {
    type Value = Numbers;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("numbers")
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Numbers, E> {
        Ok(Numbers::Scalar(value))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Numbers, E> {
        Ok(Numbers::Scalar(value as f64))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Numbers, E> {
        Ok(Numbers::Scalar(value as f64))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Numbers, A::Error> {
        let (mut count, mut row, mut values) = (0, Vec::new(), Vec::new());
        while let Some(item) = seq.next_element::<Numbers>()? {
            let shape = match item {
                Numbers::Scalar(value) => {
                    values.push(value);
                    Vec::new()
                }
                Numbers::Array(shape, more) => {
                    values.extend(more);
                    shape
                }
            };
            if count == 0 {
                row = shape;
            } else if row != shape {
                return Err(A::Error::custom(format!("item {count} of shape {shape:?} after {row:?}")));
            }
            count += 1;
        }
        row.insert(0, count);
        Ok(Numbers::Array(row, values))
    }
}
