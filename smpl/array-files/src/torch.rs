//! Files of PyTorch's `torch.save`: zip archives, and the form from before version 1.6.
//!
//! A file is a pickle that describes tensors, and storages: the bytes that tensors are views of.
//! [`TorchFile::open`] reads the descriptions; values are read tensor by tensor.

use std::collections::HashMap;
use std::fmt;
use std::io::{Read, Seek, SeekFrom};

use zip::{CompressionMethod, ZipArchive};

use crate::Error;
use crate::array::NdArray;
use crate::element::{ElementType, byte_count, gather};
use crate::file::read_limited;
use crate::pickle::{self, Value};

/// First bytes of the older form: a pickled number of ten bytes.
const LEGACY: &[u8] = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.";
/// Longest description of the tensors. That of VGG16 has five kilobytes.
const MAX_PICKLE: u64 = 16 << 20;
/// Most axes of a tensor, as in numpy.
const MAX_AXES: usize = 64;

/// Open file and its description.
///
/// ```
/// use array_files::torch::TorchFile;
/// # let bytes = [
/// #     b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.M\xe9\x03.}.}(S'bias'\nctorch._utils\n_rebuild_tensor_v2\n(".as_slice(),
/// #     b"(S'storage'\nctorch\nFloatStorage\nS'0'\nS'cpu'\nK\x02NtQK\0(K\x02t(K\x01ttRu.](S'0'\ne.",
/// #     b"\x02\0\0\0\0\0\0\0\0\0\x80\x3f\0\0\0\x40",
/// # ]
/// # .concat();
/// // bytes: torch.save({"bias": torch.tensor([1.0, 2.0])})
/// let mut weights = TorchFile::open("weights.pth", std::io::Cursor::new(bytes))?;
/// let value = weights.root().get("bias").unwrap();
/// let bias = weights.tensor("bias", value)?.unwrap();
/// assert_eq!(weights.read("bias", &bias)?.to_f64(), [1.0, 2.0]);
/// # Ok::<(), array_files::Error>(())
/// ```
pub struct TorchFile<R> {
    name: String,
    length: u64,
    root: Value,
    storages: Storages<R>,
    /// Bytes of values that may still be read: a tensor may repeat its storage without end.
    budget: u64,
}

enum Storages<R> {
    /// The archive, and the prefix of its entries' names.
    Zip(Box<ZipArchive<R>>, String),
    /// The file, and start and length of each storage.
    Legacy(R, HashMap<String, (u64, u64)>),
}

impl<R> fmt::Debug for TorchFile<R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TorchFile").field("name", &self.name).field("root", &self.root).finish_non_exhaustive()
    }
}

/// Description of a tensor whose values have not been read, from [`TorchFile::tensor`].
///
/// ```
/// use array_files::torch::TorchFile;
/// # let bytes = [
/// #     b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.M\xe9\x03.}.}(S'ids'\nctorch._utils\n_rebuild_tensor_v2\n(".as_slice(),
/// #     b"(S'storage'\nctorch\nLongStorage\nS'0'\nS'cpu'\nK\x01NtQK\0(K\x01K\x01t(K\x01K\x01ttRu.](S'0'\ne.",
/// #     b"\x01\0\0\0\0\0\0\0\x07\0\0\0\0\0\0\0",
/// # ]
/// # .concat();
/// // bytes: torch.save({"ids": torch.tensor([[7]])})
/// let file = TorchFile::open("ids.pt", std::io::Cursor::new(bytes))?;
/// let ids = file.tensor("ids", file.root().get("ids").unwrap())?.unwrap();
/// assert_eq!((ids.dtype, ids.shape.as_slice(), ids.is_float()), ("int64", &[1, 1][..], false));
/// assert_eq!(file.tensor("root", file.root())?, None); // a dictionary
/// # Ok::<(), array_files::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// PyTorch's name of the element type, such as `float32`.
    pub dtype: &'static str,
    /// Extent of every axis.
    pub shape: Vec<usize>,
    element: ElementType,
    strides: Vec<usize>,
    offset: usize,
    storage: String,
}

impl Tensor {
    /// Whether the elements are floats of 16, 32 or 64 bits.
    pub fn is_float(&self) -> bool {
        matches!(self.dtype, "float16" | "bfloat16" | "float32" | "float64")
    }
}

/// Whether a file's first bytes are those of a zip archive or of PyTorch's older form.
pub fn is_torch(start: &[u8]) -> bool {
    start.starts_with(b"PK\x03\x04") || start.starts_with(LEGACY)
}

impl<R: Read + Seek> TorchFile<R> {
    /// Reads a file's description. `name` names the file in errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a file that cannot be read or is malformed; [`Error::Pickle`].
    pub fn open(name: &str, mut file: R) -> Result<Self, Error> {
        let mut start = Vec::new();
        let length = file.seek(SeekFrom::End(0)).and_then(|length| {
            file.rewind()?;
            (&mut file).take(LEGACY.len() as u64).read_to_end(&mut start)?;
            Ok(length)
        });
        let length = length.map_err(|e| fault(name, e))?;
        let (root, storages) = if start == LEGACY { legacy(name, file, length)? } else { archive(name, file)? };
        let budget = length.saturating_mul(16).saturating_add(64 << 20);
        Ok(Self { name: name.to_owned(), length, root, storages, budget })
    }

    /// The saved value; tensors in it are objects for [`TorchFile::tensor`].
    pub fn root(&self) -> &Value {
        &self.root
    }

    /// The tensor that a value of the file describes; `None` for other values. `key` names it in
    /// errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for malformed extents, strides or storages.
    pub fn tensor(&self, key: &str, value: &Value) -> Result<Option<Tensor>, Error> {
        let Some((id, offset, shape, strides)) = parts(value) else { return Ok(None) };
        let malformed = |what: String| Error::invalid(&self.name, key, what);
        let (class, storage) = storage(id).ok_or_else(|| malformed("a storage of unknown type".to_owned()))?;
        let (dtype, element) = element(class).ok_or_else(|| malformed(format!("a storage of type {class}")))?;
        let (Some(offset), Some(shape), Some(strides)) = (offset.as_extent(), shape.as_extents(), strides.as_extents())
        else {
            return Err(malformed("extents that are no whole numbers".to_owned()));
        };
        if shape.len() != strides.len() || shape.len() > MAX_AXES {
            return Err(malformed(format!("strides {strides:?} of shape {shape:?}")));
        }
        Ok(Some(Tensor { dtype, shape, element, strides, offset, storage: storage.to_owned() }))
    }

    /// The values of a tensor, row-major. Expanded tensors (stride 0) and other views are written
    /// out; all values read from one file may take 16 times its size and 64 MiB.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a tensor outside its storage, a damaged storage, or too many values.
    pub fn read(&mut self, key: &str, tensor: &Tensor) -> Result<NdArray, Error> {
        let Tensor { element, shape, strides, offset, .. } = tensor;
        // Bytes in the file and once widened.
        let size = element.size;
        let claimed = byte_count(shape, size + element.size_in_memory()).unwrap_or(u128::MAX);
        if claimed > u128::from(self.budget) {
            return Err(Error::too_large(&self.name, key, claimed, self.budget));
        }
        self.budget -= claimed as u64;
        // The furthest element; saturation lands outside every storage.
        let last = shape
            .iter()
            .zip(strides)
            .fold(*offset, |at, (&extent, &stride)| at.saturating_add(stride.saturating_mul(extent.saturating_sub(1))));
        let mut bytes = Vec::new();
        let mut found = 0;
        if claimed > 0 {
            let storage = self.storages.read(&self.name, key, &tensor.storage, self.length)?;
            found = storage.len();
            if last.saturating_add(1).saturating_mul(size) <= found {
                bytes = gather(&storage, size, shape, strides, *offset);
            }
        }
        element.decode(&bytes, shape, false).ok_or_else(|| {
            let what = format!("shape {shape:?} with strides {strides:?} from {offset} on");
            Error::invalid(&self.name, key, format!("{what} in a storage of {found} bytes, {size} an element"))
        })
    }

    /// A value of the file, every tensor in it replaced by its array.
    ///
    /// # Errors
    /// Those of [`TorchFile::tensor`] and [`TorchFile::read`].
    pub fn resolve(&mut self, key: &str, value: &Value) -> Result<Value, Error> {
        if let Some(tensor) = self.tensor(key, value)? {
            return self.read(key, &tensor).map(Value::Array);
        }
        Ok(match value {
            Value::Dict(items) => {
                let mut out = Vec::with_capacity(items.len());
                for (name, value) in items {
                    let key = name.as_str().map_or_else(|| key.to_owned(), |name| format!("{key}.{name}"));
                    out.push((name.clone(), self.resolve(&key, value)?));
                }
                Value::Dict(out)
            }
            Value::List(items) | Value::Tuple(items) => {
                let items: Result<_, Error> = items.iter().map(|item| self.resolve(key, item)).collect();
                Value::List(items?)
            }
            other => other.clone(),
        })
    }
}

impl<R: Read + Seek> Storages<R> {
    /// The bytes of a whole storage; `length` is that of the file.
    fn read(&mut self, name: &str, key: &str, storage: &str, length: u64) -> Result<Vec<u8>, Error> {
        let malformed = |what: String| Error::invalid(name, key, what);
        let mut bytes = Vec::new();
        let read = match self {
            Self::Zip(archive, root) => {
                let entry = archive.by_name(&format!("{root}data/{storage}"));
                let entry = entry.ok().filter(|entry| entry.compression() == CompressionMethod::Stored);
                let entry = entry.ok_or_else(|| malformed(format!("no uncompressed storage {storage:?}")))?;
                // Reading to the end verifies the checksum.
                entry.take(length).read_to_end(&mut bytes)
            }
            Self::Legacy(file, places) => {
                let place = places.get(storage).ok_or_else(|| malformed(format!("no storage {storage:?}")))?;
                file.seek(SeekFrom::Start(place.0)).and_then(|_| file.take(place.1).read_to_end(&mut bytes))
            }
        };
        read.map(|_| bytes).map_err(|e| malformed(e.to_string()))
    }
}

fn fault(name: &str, what: impl ToString) -> Error {
    Error::invalid(name, "torch.save", what)
}

/// Description and storages of an archive: `NAME/data.pkl` describes the tensors, `NAME/data/KEY`
/// are their bytes.
fn archive<R: Read + Seek>(name: &str, file: R) -> Result<(Value, Storages<R>), Error> {
    let mut zip = ZipArchive::new(file).map_err(|e| fault(name, format!("is not a whole zip archive: {e}")))?;
    let root = zip.file_names().filter_map(Result::ok).find_map(|n| n.strip_suffix("data.pkl").map(str::to_owned));
    let root =
        root.ok_or_else(|| fault(name, "is a zip archive without data.pkl, expected one that torch.save has written"))?;
    let mut order = String::new();
    if let Ok(entry) = zip.by_name(&format!("{root}byteorder")) {
        entry.take(16).read_to_string(&mut order).map_err(|e| fault(name, format!("byteorder: {e}")))?;
    }
    if order == "big" {
        return Err(fault(name, "holds big-endian numbers, expected little-endian ones"));
    }
    let entry = zip.by_name(&format!("{root}data.pkl")).map_err(|e| fault(name, format!("data.pkl: {e}")))?;
    let bytes = read_limited(entry, 0, MAX_PICKLE).map_err(|e| fault(name, format!("data.pkl: {e}")))?;
    let bytes = bytes.ok_or_else(|| fault(name, format!("data.pkl has more than {MAX_PICKLE} bytes")))?;
    Ok((pickle::parse(name, &bytes)?, Storages::Zip(Box::new(zip), root)))
}

/// Description and storages of the older form: pickles of a version, of the system, of the tensors
/// and of the storages' keys, then the storages, each preceded by its length.
fn legacy<R: Read + Seek>(name: &str, mut file: R, length: u64) -> Result<(Value, Storages<R>), Error> {
    let mut bytes = Vec::new();
    let read = file.rewind().and_then(|()| (&mut file).take(MAX_PICKLE).read_to_end(&mut bytes));
    read.map_err(|e| fault(name, e))?;
    let mut at = LEGACY.len();
    let mut next = || {
        let (value, end) = pickle::parse_from(name, &bytes, at)?;
        at = end;
        Ok::<_, Error>(value)
    };
    let (version, system, value, keys) = (next()?, next()?, next()?, next()?);
    if version != Value::Int(1001) || system.get("little_endian") == Some(&Value::Bool(false)) {
        return Err(fault(name, format!("is of version {version:?}, expected 1001 with little-endian numbers")));
    }
    let mut sizes = HashMap::new();
    storage_sizes(&value, &mut sizes);
    let (mut storages, mut at) = (HashMap::new(), at as u64);
    for key in keys.items().unwrap_or_default() {
        let key = key.as_str().unwrap_or_default();
        let mut count = [0; 8];
        file.seek(SeekFrom::Start(at))
            .and_then(|_| file.read_exact(&mut count))
            .map_err(|e| fault(name, format!("storage {key:?} at byte {at}: {e}")))?;
        let size = sizes.get(key).copied().unwrap_or(1);
        let size = u64::from_le_bytes(count).checked_mul(size).filter(|&n| n <= length.saturating_sub(at + 8));
        let size = size.ok_or_else(|| fault(name, format!("is cut: storage {key:?} at byte {at} ends beyond it")))?;
        storages.insert(key.to_owned(), (at + 8, size));
        at += 8 + size;
    }
    Ok((value, Storages::Legacy(file, storages)))
}

/// Bytes per element of each storage below `value`. Pickles bound the depth.
fn storage_sizes(value: &Value, sizes: &mut HashMap<String, u64>) {
    if let Some((id, ..)) = parts(value) {
        if let Some((class, key)) = storage(id)
            && let Some((_, element)) = element(class)
        {
            sizes.insert(key.to_owned(), element.size as u64);
        }
        return;
    }
    match value {
        Value::Dict(items) => items.iter().for_each(|(_, value)| storage_sizes(value, sizes)),
        _ => value.items().unwrap_or_default().iter().for_each(|value| storage_sizes(value, sizes)),
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

/// Class and key of a storage.
fn storage(id: &[Value]) -> Option<(&'static str, &str)> {
    let [Value::Str(kind), Value::Object { class, .. }, key, ..] = id else { return None };
    // A seventh item describes a view; no version writes it today.
    (kind == "storage" && !matches!(id.get(5), Some(Value::Tuple(_)))).then_some((*class, key.as_str()?))
}

/// PyTorch's name of a storage's elements, and their type.
fn element(class: &str) -> Option<(&'static str, ElementType)> {
    pickle::STORAGES.iter().find(|(storage, ..)| *storage == class).map(|&(_, name, element)| (name, element))
}
