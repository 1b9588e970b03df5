//! Files that PyTorch's `torch.save` has written: zip archives, and the form from before version 1.6.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use safetensors::tensor::Dtype;
use smpl::pickle::{self, Value};
use zip::{CompressionMethod, ZipArchive};

use super::tensor::{Tensor, fault, io};
use crate::Error;

/// How the older form starts: a pickled number of ten bytes.
pub(super) const LEGACY: &[u8] = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.";
/// Longest description of the tensors. That of VGG16 has five kilobytes.
const MAX_PICKLE: u64 = 16 << 20;

/// Where a storage's bytes start, and how many there are.
struct Storage {
    entry: Option<String>,
    at: u64,
    bytes: u64,
}

/// What an archive holds: `NAME/data.pkl` describes the tensors, `NAME/data/KEY` are their bytes.
pub(super) fn archive(path: &Path, file: &File) -> Result<BTreeMap<String, Tensor>, Error> {
    let mut zip = open(path, file)?;
    let names = zip.file_names().filter_map(Result::ok);
    let Some(root) = names.filter_map(|n| n.strip_suffix("data.pkl").map(str::to_owned)).next() else {
        return Err(fault(path, "is a zip archive without data.pkl, expected one that torch.save has written"));
    };
    let mut order = String::new();
    if let Ok(entry) = zip.by_name(&format!("{root}byteorder")) {
        entry.take(16).read_to_string(&mut order).map_err(io(path))?;
    }
    if order == "big" {
        return Err(fault(path, "holds big-endian numbers, expected little-endian ones"));
    }
    let malformed = |e: zip::result::ZipError| fault(path, format!("data.pkl: {e}"));
    let mut bytes = Vec::new();
    let entry = zip.by_name(&format!("{root}data.pkl")).map_err(malformed)?;
    entry.take(MAX_PICKLE + 1).read_to_end(&mut bytes).map_err(|e| fault(path, format!("data.pkl: {e}")))?;
    check_length(path, bytes.len())?;
    let value = pickle::parse(&path.display().to_string(), &bytes)?;
    tensors(path, &value, |key| {
        let name = format!("{root}data/{key}");
        let entry = zip.by_name(&name).ok()?;
        let stored = entry.compression() == CompressionMethod::Stored;
        stored.then(|| Storage { bytes: entry.size(), entry: Some(name), at: 0 })
    })
}

/// Fills `bytes` from an entry of the archive, from byte `at` on.
pub(super) fn read_entry(path: &Path, file: &File, name: &str, at: u64, bytes: &mut [u8]) -> Result<(), Error> {
    let malformed = |what: String| fault(path, format!("`{name}`: {what}"));
    let mut zip = open(path, file)?;
    let mut entry = zip.by_name(name).map_err(|e| malformed(e.to_string()))?;
    std::io::copy(&mut (&mut entry).take(at), &mut std::io::sink()).map_err(|e| malformed(e.to_string()))?;
    entry.read_exact(bytes).map_err(|e| malformed(e.to_string()))?;
    // The checksum is looked at when the end is met.
    entry.read(&mut [0]).map_err(|e| malformed(e.to_string()))?;
    Ok(())
}

fn open<'a>(path: &Path, file: &'a File) -> Result<ZipArchive<BufReader<&'a File>>, Error> {
    ZipArchive::new(BufReader::new(file)).map_err(|e| fault(path, format!("is not a whole zip archive: {e}")))
}

/// What a file of the older form holds: pickles of a version, of the system, of the tensors and of the storages' keys, then
/// each storage with its length before it.
pub(super) fn legacy(path: &Path, file: &mut File) -> Result<BTreeMap<String, Tensor>, Error> {
    let length = file.metadata().map_err(io(path))?.len();
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(0)).map_err(io(path))?;
    file.take(MAX_PICKLE).read_to_end(&mut bytes).map_err(io(path))?;
    let (name, mut at) = (path.display().to_string(), LEGACY.len());
    let mut next = || {
        let (value, end) = pickle::parse_from(&name, &bytes, at)?;
        at = end;
        Ok::<_, Error>(value)
    };
    let (version, system, value, keys) = (next()?, next()?, next()?, next()?);
    if version != Value::Int(1001) || system.get("little_endian") == Some(&Value::Bool(false)) {
        return Err(fault(path, format!("is of version {version:?}, expected 1001 with little-endian numbers")));
    }
    let sizes = storage_sizes(&value);
    let mut storages = HashMap::new();
    let mut at = at as u64;
    for key in keys.items().unwrap_or_default() {
        let key = key.as_str().unwrap_or_default();
        let mut count = [0; 8];
        file.seek(SeekFrom::Start(at))
            .and_then(|_| file.read_exact(&mut count))
            .map_err(|e| fault(path, format!("storage {key:?} at byte {at}: {e}")))?;
        let size = sizes.get(key).copied().unwrap_or(1);
        let size = u64::from_le_bytes(count).checked_mul(size).filter(|&n| n <= length.saturating_sub(at + 8));
        let size = size.ok_or_else(|| fault(path, format!("is cut: storage {key:?} at byte {at} ends beyond it")))?;
        storages.insert(key.to_owned(), (at + 8, size));
        at += 8 + size;
    }
    tensors(path, &value, |key| storages.get(key).map(|&(at, bytes)| Storage { entry: None, at, bytes }))
}

fn check_length(path: &Path, length: usize) -> Result<(), Error> {
    if length as u64 > MAX_PICKLE {
        return Err(fault(path, format!("data.pkl has more than {MAX_PICKLE} bytes")));
    }
    Ok(())
}

/// The named values of a state dictionary, alone or as `state_dict` of a training checkpoint.
fn items(value: &Value) -> &[(Value, Value)] {
    match value.get("state_dict").unwrap_or(value) {
        Value::Dict(items) => items,
        _ => &[],
    }
}

/// Storage, offset, extents and strides of a tensor.
fn parts(value: &Value) -> Option<(&[Value], &Value, &Value, &Value)> {
    let Value::Object { class: "torch.Tensor", state } = value else { return None };
    let [Value::Object { class: pickle::PERSISTENT, state: storage }, offset, shape, strides, ..] = state.items()?
    else {
        return None;
    };
    Some((storage.items()?, offset, shape, strides))
}

/// Type and key of a storage.
fn storage(id: &[Value]) -> Option<(Dtype, &str)> {
    let [Value::Str(kind), Value::Object { class, .. }, key, ..] = id else { return None };
    let dtype = match *class {
        "torch.FloatStorage" => Dtype::F32,
        "torch.DoubleStorage" => Dtype::F64,
        "torch.HalfStorage" => Dtype::F16,
        "torch.BFloat16Storage" => Dtype::BF16,
        "torch.LongStorage" => Dtype::I64,
        "torch.IntStorage" => Dtype::I32,
        "torch.ShortStorage" => Dtype::I16,
        "torch.CharStorage" => Dtype::I8,
        "torch.ByteStorage" => Dtype::U8,
        "torch.BoolStorage" => Dtype::BOOL,
        _ => return None,
    };
    // A seventh item describes a view, which no version writes today.
    (kind == "storage" && !matches!(id.get(5), Some(Value::Tuple(_)))).then_some((dtype, key.as_str()?))
}

/// Bytes a value of each storage.
fn storage_sizes(value: &Value) -> HashMap<String, u64> {
    let found = items(value).iter().filter_map(|(_, tensor)| storage(parts(tensor)?.0));
    found.map(|(dtype, key)| (key.to_owned(), dtype.bitsize() as u64 / 8)).collect()
}

/// The tensors of a state dictionary, each checked against its storage.
fn tensors(
    path: &Path,
    value: &Value,
    mut find: impl FnMut(&str) -> Option<Storage>,
) -> Result<BTreeMap<String, Tensor>, Error> {
    let whole = |value: &Value| match value {
        Value::Int(n) => usize::try_from(*n).ok(),
        _ => None,
    };
    let list = |value: &Value| value.items()?.iter().map(whole).collect::<Option<Vec<usize>>>();
    let mut tensors = BTreeMap::new();
    for (name, value) in items(value) {
        let (Some(name), Some((id, offset, shape, strides))) = (name.as_str(), parts(value)) else { continue };
        let malformed = |what: &str| fault(path, format!("`{name}`: {what}"));
        let (dtype, key) = storage(id).ok_or_else(|| malformed("a storage of unknown type"))?;
        let parts = whole(offset).zip(list(shape)).zip(list(strides));
        let ((offset, shape), strides) = parts.ok_or_else(|| malformed("extents that are no whole numbers"))?;
        let mut expected = 1usize;
        for (&extent, &stride) in shape.iter().zip(&strides).rev() {
            if extent != 1 && stride != expected {
                return Err(malformed(&format!("strides {strides:?} of shape {shape:?}, expected row-major order")));
            }
            expected = expected.checked_mul(extent).ok_or_else(|| malformed(&format!("shape {shape:?}")))?;
        }
        let found = find(key).ok_or_else(|| malformed(&format!("no uncompressed storage {key:?}")))?;
        let size = dtype.bitsize() / 8;
        let start = offset.checked_mul(size).map(|n| n as u64);
        let end = expected.checked_mul(size).and_then(|n| start?.checked_add(n as u64));
        let (Some(start), true) = (start, end.is_some_and(|end| end <= found.bytes)) else {
            let bytes = found.bytes;
            return Err(malformed(&format!("shape {shape:?} from {offset} on in a storage of {bytes} bytes")));
        };
        tensors.insert(name.to_owned(), Tensor { dtype, shape, at: found.at + start, entry: found.entry });
    }
    Ok(tensors)
}
