//! `metadata.json` as records.

use std::path::Path;

use array_files::pickle::Value;
use serde_json::{Map, Value as Json};

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
    let frames: Map<String, Json> = serde_json::from_str(&text).map_err(|error| {
        CaptureError::invalid(path, "the file", "JSON of frames and their arrays", error.to_string())
    })?;
    let frame = |(name, mut value): (String, Json)| {
        if let Json::Object(items) = &mut value {
            items.retain(|key, _| KEYS.contains(&key.as_str()));
        }
        (Value::Str(name), crate::json::value(value))
    };
    Records::new(path, Value::Dict(frames.into_iter().map(frame).collect()))
}
