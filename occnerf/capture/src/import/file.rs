//! Files of estimators as values, whatever wrote them.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use array_files::npz::Npz;
use array_files::pickle::{self, Value};
use array_files::torch::{TorchFile, is_torch};
use array_files::{Error, NdArray};

use crate::files::read_text;
use crate::item::Item;
use crate::{CaptureError, json};

/// Largest text: COLMAP's images.txt has some 100 kilobytes a picture.
const MAX_TEXT: u64 = 256 << 20;

/// First parts of the names that are read of archives, which may hold much else.
#[rustfmt::skip]
const READ: [&str; 18] = [
    "results", "transl", "betas", "thetas", "body_pose", "global_orient", "intrinsic", "extrinsic", "height", "width",
    "global_t", "focal_l", "detection_all", "smpl_params_incam", "body_params_incam", "K_fullimg",
    "pred_", "mask",
];
/// Further names that are read, whole.
const ALSO: [&str; 8] =
    ["pose", "shape", "beta", "trans", "triangle_ids", "baryc_coords", "hands_meanl", "hands_meanr"];

fn is_read(name: &str) -> bool {
    READ.iter().any(|start| name.starts_with(start)) || ALSO.contains(&name)
}

/// Reads a text file.
pub(super) fn text(path: &Path) -> Result<String, CaptureError> {
    read_text(path, MAX_TEXT)
}

/// Reads a JSON file.
pub(super) fn json(path: &Path) -> Result<Value, CaptureError> {
    json::read(path, MAX_TEXT)
}

/// Reads a pickle, a JSON file, an array, or an archive of numpy or PyTorch, told apart by content;
/// what of an archive is not read is [`Value::None`]. `expected` says what file is wanted.
pub(super) fn value(path: &Path, expected: &str) -> Result<Value, CaptureError> {
    if path.exists() && !path.is_file() {
        return Err(CaptureError::invalid(path, "the file", "a plain file", "a device, pipe or folder"));
    }
    let mut file = File::open(path).map_err(CaptureError::io(path))?;
    let mut start = Vec::new();
    (&mut file).take(64).read_to_end(&mut start).map_err(CaptureError::io(path))?;
    if start.starts_with(b"PK") {
        let npz = Npz::open(path).map_err(|error| match error {
            Error::Npy { message, .. } => {
                CaptureError::invalid(path, "the file", "a whole zip archive, of PyTorch or numpy", message)
            }
            error => error.into(),
        })?;
        // Archives of PyTorch hold a pickle.
        if !npz.keys().is_empty() && !npz.keys().iter().any(|key| key.ends_with("data.pkl")) {
            return of_numpy(npz);
        }
    }
    if is_torch(&start) {
        let mut file = TorchFile::open(&path.display().to_string(), BufReader::new(file))?;
        let mut root = file.root().clone();
        let Value::Dict(entries) = &mut root else { return Ok(file.resolve("", &root)?) };
        for (key, value) in entries {
            let name = key.as_str().filter(|name| is_read(name));
            *value = name.map_or(Ok(Value::None), |name| file.resolve(name, value))?;
        }
        return Ok(root);
    }
    if matches!(start.trim_ascii_start().first(), Some(b'{' | b'[')) {
        return json(path);
    }
    // First bytes of pickles and of compressed files.
    let begins = |with: &u8| start.first() == Some(with);
    if !start.is_empty() && !b"\x80(c}]xB\x1f\xfd\x93".iter().any(begins) {
        let found = format!("a file that begins with {}", start[..start.len().min(4)].escape_ascii());
        return Err(CaptureError::invalid(path, "the file", expected, found));
    }
    Ok(pickle::read(path)?)
}

fn of_numpy(mut npz: Npz) -> Result<Value, CaptureError> {
    let keys = npz.keys().to_vec();
    let entry = |key: &String| {
        let value = match is_read(key) {
            true => npz.value(key)?,
            // The only array of an archive has any name.
            false if keys.len() == 1 => npz.value(key).unwrap_or(Value::None),
            false => Value::None,
        };
        Ok((Value::Str(key.clone()), value))
    };
    Ok(Value::Dict(keys.iter().map(entry).collect::<Result<_, Error>>()?))
}

/// The array of a file, or the only one of an `.npz` archive whose shape `fits`; `expected` says
/// which.
pub(super) fn array(path: &Path, expected: &str, fits: impl Fn(&[usize]) -> bool) -> Result<NdArray, CaptureError> {
    if path.extension().is_none_or(|e| e != "npz") {
        let array = match value(path, expected)? {
            Value::Array(array) => array,
            other => Item::new(path, &other).array()?.into_owned(),
        };
        let found = || CaptureError::invalid(path, "the file", expected, format!("shape {:?}", array.shape));
        return if fits(&array.shape) { Ok(array) } else { Err(found()) };
    }
    let mut npz = Npz::open(path)?;
    let keys = npz.keys().to_vec();
    let arrays = keys.iter().filter_map(|key| npz.array(key).ok());
    let mut fitting = arrays.filter(|array| fits(&array.shape));
    match (fitting.next(), fitting.next()) {
        (Some(array), None) => Ok(array),
        (first, _) => {
            let found = format!("{} of {}", if first.is_some() { "several" } else { "none" }, keys.join(", "));
            Err(CaptureError::invalid(path, "arrays", format!("one of {expected}"), found))
        }
    }
}
