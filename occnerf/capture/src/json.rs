//! JSON as the plain data of pickles.

use array_files::pickle::Value;
use array_files::{Data, NdArray};

/// The value of a pickle of the same: nested lists of numbers with equally long rows are arrays.
pub(super) fn value(json: serde_json::Value) -> Value {
    use serde_json::Value as Json;
    match json {
        Json::Null => Value::None,
        Json::Bool(flag) => Value::Bool(flag),
        Json::Number(number) => Value::Float(number.as_f64().unwrap_or(f64::NAN)),
        Json::String(text) => Value::Str(text),
        Json::Object(map) => Value::Dict(map.into_iter().map(|(k, v)| (Value::Str(k), value(v))).collect()),
        Json::Array(items) => {
            let items: Vec<Value> = items.into_iter().map(value).collect();
            // Numbers, or arrays of one shape.
            let part = |item: &Value| match item {
                Value::Float(x) => Some((Vec::new(), vec![*x])),
                Value::Bool(flag) => Some((Vec::new(), vec![f64::from(u8::from(*flag))])),
                Value::Array(NdArray { shape, data: Data::F64(values) }) => Some((shape.clone(), values.clone())),
                _ => None,
            };
            let parts: Option<Vec<(Vec<usize>, Vec<f64>)>> = items.iter().map(part).collect();
            match parts {
                Some(parts) if !parts.is_empty() && parts.iter().all(|p| p.0 == parts[0].0) => {
                    let shape = [vec![parts.len()], parts[0].0.clone()].concat();
                    Value::Array(NdArray { shape, data: Data::F64(parts.into_iter().flat_map(|p| p.1).collect()) })
                }
                _ => Value::List(items),
            }
        }
    }
}
