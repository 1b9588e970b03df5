//! Files that PyTorch's `torch.save` has written: zip archives, and the form from before version
//! 1.6.
//!
//! A file is a pickle in which tensors are described, and storages, the bytes that tensors are
//! views of. Opening one reads the descriptions; the numbers of a tensor are read when they are
//! asked for. Nothing is executed.

use std::collections::HashMap;
use std::io::{Read, Seek, SeekFrom};

use zip::result::ZipError;
use zip::{CompressionMethod, ZipArchive};

use crate::array::{ElementType, element_count};
use crate::pickle::{self, Value};
use crate::{Data, Error, NdArray};

/// How the older form starts: a pickled number of ten bytes.
const LEGACY: &[u8] = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.";
/// Longest description of the tensors. That of VGG16 has five kilobytes.
const MAX_PICKLE: u64 = 16 << 20;
/// Most axes of a tensor, as in numpy.
const MAX_AXES: usize = 64;

/// An open file and what it describes.
pub struct TorchFile<R> {
    name: String,
    length: u64,
    root: Value,
    storages: Storages<R>,
    /// Bytes of numbers that may still be read: a tensor may repeat its storage without end.
    budget: u64,
}

enum Storages<R> {
    /// The archive, and what its entries' names start with.
    Zip(Box<ZipArchive<R>>, String),
    /// The file, and where each storage starts and how many bytes it has.
    Legacy(R, HashMap<String, (u64, u64)>),
}

/// A tensor whose numbers have not been read.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Type of the elements as PyTorch names it, such as `float32`.
    pub dtype: &'static str,
    /// Extent of every axis.
    pub shape: Vec<usize>,
    strides: Vec<usize>,
    offset: usize,
    storage: String,
}

impl Tensor {
    /// Whether the elements are floats of 16, 32 or 64 bits.
    #[must_use]
    pub fn is_float(&self) -> bool {
        matches!(self.dtype, "float16" | "bfloat16" | "float32" | "float64")
    }
}

/// Whether a file that starts so may be one of PyTorch's: a zip archive, or the older form.
#[must_use]
pub fn is_torch(start: &[u8]) -> bool {
    start.starts_with(b"PK\x03\x04") || start.starts_with(LEGACY)
}

impl<R: Read + Seek> TorchFile<R> {
    /// Reads what a file describes. `name` names it in errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for what cannot be read or is malformed; [`Error::Pickle`].
    pub fn open(name: &str, mut file: R) -> Result<Self, Error> {
        let fault = |what: String| Error::invalid(name, "torch.save", what);
        let length = file.seek(SeekFrom::End(0)).map_err(|e| fault(e.to_string()))?;
        let mut start = Vec::new();
        file.rewind().map_err(|e| fault(e.to_string()))?;
        (&mut file).take(LEGACY.len() as u64).read_to_end(&mut start).map_err(|e| fault(e.to_string()))?;
        let (root, storages) = if start == LEGACY { legacy(name, file, length)? } else { archive(name, file)? };
        let budget = length.saturating_mul(16).saturating_add(64 << 20);
        Ok(Self { name: name.to_owned(), length, root, storages, budget })
    }

    /// What was saved; tensors in it are objects that [`TorchFile::tensor`] understands.
    #[must_use]
    pub fn root(&self) -> &Value {
        &self.root
    }

    /// The tensor that a value of the file stands for; `None` where it is something else. `key` is
    /// for errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for extents, strides or a storage that make no sense.
    pub fn tensor(&self, key: &str, value: &Value) -> Result<Option<Tensor>, Error> {
        let Some((id, offset, shape, strides)) = parts(value) else { return Ok(None) };
        let malformed = |what: String| Error::invalid(&self.name, key, what);
        let (class, storage) = storage(id).ok_or_else(|| malformed("a storage of unknown type".to_owned()))?;
        let (dtype, _) = element(class).ok_or_else(|| malformed(format!("a storage of type {class}")))?;
        let parts = whole(offset).zip(list(shape)).zip(list(strides));
        let ((offset, shape), strides) =
            parts.ok_or_else(|| malformed("extents that are no whole numbers".to_owned()))?;
        if shape.len() != strides.len() || shape.len() > MAX_AXES {
            return Err(malformed(format!("strides {strides:?} of shape {shape:?}")));
        }
        Ok(Some(Tensor { dtype, shape, strides, offset, storage: storage.to_owned() }))
    }

    /// The numbers of a tensor, row-major whatever its strides are. Expanded tensors (stride 0) and
    /// other views are written out; all that is read of one file may take 16 times its size and 64
    /// MiB.
    ///
    /// # Errors
    /// [`Error::Invalid`] where the tensor leaves its storage or the storage is damaged,
    /// [`Error::TooLarge`].
    pub fn read(&mut self, key: &str, tensor: &Tensor) -> Result<NdArray, Error> {
        let malformed = |what: String| Error::invalid(&self.name, key, what);
        let Tensor { shape, strides, offset, .. } = tensor;
        let (brain, element) = match tensor.dtype {
            "bfloat16" => (true, ElementType::parse("<u2")),
            _ => (false, NAMES.iter().find(|(_, name, _)| *name == tensor.dtype).and_then(|t| ElementType::parse(t.2))),
        };
        let element = element.ok_or_else(|| malformed(format!("elements of type {}", tensor.dtype)))?;
        let count = element_count(shape).unwrap_or(u128::MAX);
        // The elements' bytes and what they become.
        let claimed = count.saturating_mul((element.size() + element.size_in_memory()) as u128);
        if claimed > u128::from(self.budget) {
            let (file, key) = (self.name.clone(), key.to_owned());
            return Err(Error::TooLarge { file, key, claimed, limit: self.budget });
        }
        self.budget -= claimed as u64;
        let outside = |found: usize| {
            let size = element.size();
            let what = format!("shape {shape:?} with strides {strides:?} from {offset} on");
            Error::invalid(&self.name, key, format!("{what} in a storage of {found} bytes, {size} an element"))
        };
        // The furthest element; saturation lands outside every storage.
        let last = shape
            .iter()
            .zip(strides)
            .fold(*offset, |at, (&extent, &stride)| at.saturating_add(stride.saturating_mul(extent.saturating_sub(1))));
        let bytes = match count {
            0 => Vec::new(),
            _ => {
                let end = last.saturating_add(1).saturating_mul(element.size());
                let storage = self.storages.read(&self.name, key, &tensor.storage, self.length)?;
                if end > storage.len() {
                    return Err(outside(storage.len()));
                }
                gather(&storage, element.size(), shape, strides, *offset)
            }
        };
        let array = element.decode(&bytes, shape, false).ok_or_else(|| outside(bytes.len()))?;
        Ok(match array.data {
            Data::I64(words) if brain => {
                let value = |&word: &i64| f32::from_bits((word as u32) << 16);
                NdArray { shape: array.shape, data: Data::F32(words.iter().map(value).collect()) }
            }
            data => NdArray { shape: array.shape, data },
        })
    }

    /// A value of the file with every tensor in it replaced by its array.
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
    /// The bytes of a whole storage, of a file of `length` bytes.
    fn read(&mut self, name: &str, key: &str, storage: &str, length: u64) -> Result<Vec<u8>, Error> {
        let malformed = |what: String| Error::invalid(name, key, what);
        let mut bytes = Vec::new();
        match self {
            Self::Zip(archive, root) => {
                let entry = archive.by_name(&format!("{root}data/{storage}"));
                let entry = entry.ok().filter(|entry| entry.compression() == CompressionMethod::Stored);
                let entry = entry.ok_or_else(|| malformed(format!("no uncompressed storage {storage:?}")))?;
                // The checksum is looked at when the end is met.
                entry.take(length).read_to_end(&mut bytes).map_err(|e| malformed(e.to_string()))?;
            }
            Self::Legacy(file, places) => {
                let place = places.get(storage).ok_or_else(|| malformed(format!("no storage {storage:?}")))?;
                file.seek(SeekFrom::Start(place.0)).map_err(|e| malformed(e.to_string()))?;
                file.take(place.1).read_to_end(&mut bytes).map_err(|e| malformed(e.to_string()))?;
            }
        }
        Ok(bytes)
    }
}

/// Elements of `size` bytes in row-major order; all of them lie within the storage.
fn gather(storage: &[u8], size: usize, shape: &[usize], strides: &[usize], offset: usize) -> Vec<u8> {
    let count: usize = shape.iter().product();
    let mut expected = 1;
    let ordered = shape.iter().zip(strides).rev().all(|(&extent, &stride)| {
        let fits = extent == 1 || stride == expected;
        expected *= extent;
        fits
    });
    if ordered {
        return storage[offset * size..][..count * size].to_vec();
    }
    // Along an axis of one element nothing moves, whatever the stride says.
    let strides: Vec<usize> = shape.iter().zip(strides).map(|(&n, &stride)| if n > 1 { stride } else { 0 }).collect();
    let mut out = Vec::with_capacity(count * size);
    let mut index = vec![0usize; shape.len()];
    let mut at = offset;
    for _ in 0..count {
        out.extend_from_slice(&storage[at * size..][..size]);
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            at += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            at -= strides[axis] * shape[axis];
            index[axis] = 0;
        }
    }
    out
}

/// What an archive holds: `NAME/data.pkl` describes the tensors, `NAME/data/KEY` are their bytes.
fn archive<R: Read + Seek>(name: &str, file: R) -> Result<(Value, Storages<R>), Error> {
    let fault = |what: String| Error::invalid(name, "torch.save", what);
    let mut zip = ZipArchive::new(file).map_err(|e| fault(format!("is not a whole zip archive: {e}")))?;
    let names = zip.file_names().filter_map(Result::ok);
    let Some(root) = names.filter_map(|n| n.strip_suffix("data.pkl").map(str::to_owned)).next() else {
        return Err(fault("is a zip archive without data.pkl, expected one that torch.save has written".to_owned()));
    };
    let mut order = String::new();
    if let Ok(entry) = zip.by_name(&format!("{root}byteorder")) {
        entry.take(16).read_to_string(&mut order).map_err(|e| fault(format!("byteorder: {e}")))?;
    }
    if order == "big" {
        return Err(fault("holds big-endian numbers, expected little-endian ones".to_owned()));
    }
    let malformed = |e: ZipError| fault(format!("data.pkl: {e}"));
    let mut bytes = Vec::new();
    let entry = zip.by_name(&format!("{root}data.pkl")).map_err(malformed)?;
    entry.take(MAX_PICKLE + 1).read_to_end(&mut bytes).map_err(|e| fault(format!("data.pkl: {e}")))?;
    if bytes.len() as u64 > MAX_PICKLE {
        return Err(fault(format!("data.pkl has more than {MAX_PICKLE} bytes")));
    }
    let value = pickle::parse(name, &bytes)?;
    Ok((value, Storages::Zip(Box::new(zip), root)))
}

/// What a file of the older form holds: pickles of a version, of the system, of the tensors and of
/// the storages' keys, then each storage with its length before it.
fn legacy<R: Read + Seek>(name: &str, mut file: R, length: u64) -> Result<(Value, Storages<R>), Error> {
    let fault = |what: String| Error::invalid(name, "torch.save", what);
    let mut bytes = Vec::new();
    file.rewind().map_err(|e| fault(e.to_string()))?;
    (&mut file).take(MAX_PICKLE).read_to_end(&mut bytes).map_err(|e| fault(e.to_string()))?;
    let mut at = LEGACY.len();
    let mut next = || {
        let (value, end) = pickle::parse_from(name, &bytes, at)?;
        at = end;
        Ok::<_, Error>(value)
    };
    let (version, system, value, keys) = (next()?, next()?, next()?, next()?);
    if version != Value::Int(1001) || system.get("little_endian") == Some(&Value::Bool(false)) {
        return Err(fault(format!("is of version {version:?}, expected 1001 with little-endian numbers")));
    }
    let mut sizes = HashMap::new();
    storage_sizes(&value, &mut sizes);
    let (mut storages, mut at) = (HashMap::new(), at as u64);
    for key in keys.items().unwrap_or_default() {
        let key = key.as_str().unwrap_or_default();
        let mut count = [0; 8];
        file.seek(SeekFrom::Start(at))
            .and_then(|_| file.read_exact(&mut count))
            .map_err(|e| fault(format!("storage {key:?} at byte {at}: {e}")))?;
        let size = sizes.get(key).copied().unwrap_or(1);
        let size = u64::from_le_bytes(count).checked_mul(size).filter(|&n| n <= length.saturating_sub(at + 8));
        let size = size.ok_or_else(|| fault(format!("is cut: storage {key:?} at byte {at} ends beyond it")))?;
        storages.insert(key.to_owned(), (at + 8, size));
        at += 8 + size;
    }
    Ok((value, Storages::Legacy(file, storages)))
}

/// Bytes an element of each storage below `value`. Pickles bound the depth.
fn storage_sizes(value: &Value, sizes: &mut HashMap<String, u64>) {
    if let Some((id, ..)) = parts(value) {
        if let Some((class, key)) = storage(id)
            && let Some((_, size)) = element(class)
        {
            sizes.insert(key.to_owned(), size);
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

/// Type and key of a storage.
fn storage(id: &[Value]) -> Option<(&'static str, &str)> {
    let [Value::Str(kind), Value::Object { class, .. }, key, ..] = id else { return None };
    // A seventh item describes a view, which no version writes today.
    (kind == "storage" && !matches!(id.get(5), Some(Value::Tuple(_)))).then_some((*class, key.as_str()?))
}

/// Classes of storages, PyTorch's names of their elements, and numpy's.
const NAMES: [(&str, &str, &str); 10] = [
    ("torch.FloatStorage", "float32", "<f4"),
    ("torch.DoubleStorage", "float64", "<f8"),
    ("torch.HalfStorage", "float16", "<f2"),
    ("torch.BFloat16Storage", "bfloat16", "<u2"),
    ("torch.LongStorage", "int64", "<i8"),
    ("torch.IntStorage", "int32", "<i4"),
    ("torch.ShortStorage", "int16", "<i2"),
    ("torch.CharStorage", "int8", "|i1"),
    ("torch.ByteStorage", "uint8", "|u1"),
    ("torch.BoolStorage", "bool", "|b1"),
];

/// PyTorch's name of a storage's elements, and their bytes.
fn element(class: &str) -> Option<(&'static str, u64)> {
    let (_, name, numpy) = NAMES.iter().find(|(storage, ..)| *storage == class)?;
    Some((name, ElementType::parse(numpy)?.size() as u64))
}

fn whole(value: &Value) -> Option<usize> {
    match value {
        Value::Int(n) => usize::try_from(*n).ok(),
        _ => None,
    }
}

fn list(value: &Value) -> Option<Vec<usize>> {
    value.items()?.iter().map(whole).collect()
}
