//! Files of weights: which tensors there are, and reading those that are asked for.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use array_files::Data;
use array_files::pickle::Value;
use array_files::torch::{self, TorchFile};
use safetensors::tensor::{Dtype, Metadata};

use super::trunk::Trunk;
use crate::Error;

/// Longest header of a safetensors file, as in the format's own library.
const MAX_HEADER: u64 = 100_000_000;
/// Files of a directory that are looked into.
const MAX_FILES: usize = 256;

/// A tensor of a file.
#[derive(Clone, Debug)]
struct Tensor {
    shape: Vec<usize>,
    place: Place,
}

#[derive(Clone, Debug)]
enum Place {
    /// Type, and where the bytes start in a safetensors file.
    Bytes(Dtype, u64),
    Torch(torch::Tensor),
}

/// An open file and what it holds.
pub(super) struct Weights {
    path: PathBuf,
    source: Source,
    tensors: BTreeMap<String, Tensor>,
}

enum Source {
    Safetensors(File),
    Torch(TorchFile<BufReader<File>>),
}

pub(super) fn fault(path: &Path, what: impl Into<String>) -> Error {
    Error::File { path: path.to_owned(), what: what.into() }
}

pub(super) fn io(path: &Path) -> impl Fn(std::io::Error) -> Error {
    move |source| Error::Io { path: path.to_owned(), source }
}

/// A trunk with its linear layers, in one file or two.
pub(super) struct Found {
    pub trunk: Trunk,
    weights: Weights,
    lin: Option<Weights>,
}

impl Found {
    /// Reads a tensor of exactly `shape`, axes of one beside.
    pub fn read(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, Error> {
        match &mut self.lin {
            Some(lin) if name.starts_with("lin") => lin.read(name, shape),
            _ => self.weights.read(name, shape),
        }
    }

    /// `error` with the file's name.
    pub fn blame(&self, error: Error) -> Error {
        match error {
            Error::Lpips(what) => fault(&self.weights.path, what),
            other => other,
        }
    }
}

/// The weights at `path`, as [`Lpips::load`](super::Lpips::load) looks for them.
pub(super) fn find(path: &Path) -> Result<Found, Error> {
    if !std::fs::metadata(path).map_err(io(path))?.is_dir() {
        let weights = Weights::open(path)?;
        let trunk = weights.trunk().ok_or_else(|| {
            let names: Vec<&str> = weights.tensors.keys().take(4).map(String::as_str).collect();
            let expected = "expected `features.0.weight` and the other layers of SqueezeNet 1.1, VGG16 or AlexNet";
            fault(path, format!("holds no trunk: {expected}; it starts with {}", names.join(", ")))
        })?;
        if weights.has_lin(trunk) {
            return Ok(Found { trunk, weights, lin: None });
        }
        let beside = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let (others, damaged) = open_all(&files(beside)?);
        let lin = others.into_iter().find(|other| other.has_lin(trunk));
        let lin = lin.ok_or_else(|| damaged.unwrap_or_else(|| no_lin(path, trunk)))?;
        return Ok(Found { trunk, weights, lin: Some(lin) });
    }
    let (mut open, damaged) = open_all(&files(path)?);
    let mut lonely = None;
    for i in 0..open.len() {
        let Some(trunk) = open[i].trunk() else { continue };
        if open[i].has_lin(trunk) {
            return Ok(Found { trunk, weights: open.swap_remove(i), lin: None });
        }
        if let Some(other) = (0..open.len()).find(|&other| open[other].has_lin(trunk)) {
            let weights = open.swap_remove(i);
            // The last file has moved to the place that became free.
            let other = if other == open.len() { i } else { other };
            return Ok(Found { trunk, weights, lin: Some(open.swap_remove(other)) });
        }
        lonely = lonely.or_else(|| Some(no_lin(&open[i].path, trunk)));
    }
    Err(damaged.or(lonely).unwrap_or_else(|| fault(path, "has no .safetensors, .pth or .pt file with a trunk in it")))
}

/// The files that can be read, and what is wrong with the first that cannot: it matters where what
/// is needed is in none of the others.
fn open_all(paths: &[PathBuf]) -> (Vec<Weights>, Option<Error>) {
    let (mut open, mut damaged) = (Vec::new(), None);
    for path in paths {
        match Weights::open(path) {
            Ok(weights) => open.push(weights),
            Err(error) => damaged = damaged.or(Some(error)),
        }
    }
    (open, damaged)
}

fn no_lin(path: &Path, trunk: Trunk) -> Error {
    let name = trunk.name();
    fault(
        path,
        format!("is {name} without LPIPS's linear layers: no `lin0.weight` of {name} in it or in a file beside it"),
    )
}

/// Files of weights in a directory, by name.
fn files(directory: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(io(directory))? {
        let path = entry.map_err(io(directory))?.path();
        if path.extension().is_some_and(|e| e == "safetensors" || e == "pth" || e == "pt") && path.is_file() {
            found.push(path);
        }
    }
    found.sort();
    found.truncate(MAX_FILES);
    Ok(found)
}

impl Weights {
    /// Finds out what a file holds, without reading more than that.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let mut file = File::open(path).map_err(io(path))?;
        let mut start = Vec::new();
        (&mut file).take(64).read_to_end(&mut start).map_err(io(path))?;
        let (source, tensors) = if torch::is_torch(&start) {
            let file = TorchFile::open(&path.display().to_string(), BufReader::new(file))?;
            let tensors = torch_tensors(&file)?;
            (Source::Torch(file), tensors)
        } else {
            let tensors = safetensors(path, &mut file)?;
            (Source::Safetensors(file), tensors)
        };
        Ok(Self { path: path.to_owned(), source, tensors })
    }

    /// Which trunk this is: all of its first and last layers' names tell it from its relatives.
    pub fn trunk(&self) -> Option<Trunk> {
        let has = |name: &str| self.tensors.contains_key(name);
        let first = self.tensors.get("features.0.weight")?;
        match first.shape.last() {
            Some(11) => Some(Trunk::AlexNet),
            _ if has("features.3.squeeze.weight") => Some(Trunk::SqueezeNet),
            _ if has("features.28.weight") && !has("features.34.weight") => Some(Trunk::Vgg16),
            _ => None,
        }
    }

    /// Whether the linear layers of `trunk` are here.
    pub fn has_lin(&self, trunk: Trunk) -> bool {
        let channels: &[usize] = match trunk {
            Trunk::Vgg16 => &[64, 128, 256, 512, 512],
            Trunk::AlexNet => &[64, 192, 384, 256, 256],
            Trunk::SqueezeNet => &[64, 128, 256, 384, 384, 512, 512],
        };
        let fits = |(i, &channels): (usize, &usize)| {
            let tensor = self.find(&format!("lin{i}.weight"));
            tensor.is_some_and(|(_, t)| t.shape.iter().product::<usize>() == channels)
        };
        channels.iter().enumerate().all(fits) && self.find(&format!("lin{}.weight", channels.len())).is_none()
    }

    /// The tensor `name`; the package's own files put `model.1` into the names of linear layers.
    fn find(&self, name: &str) -> Option<(&String, &Tensor)> {
        let found = self.tensors.get_key_value(name);
        found.or_else(|| self.tensors.get_key_value(&name.replace(".weight", ".model.1.weight")))
    }

    /// Reads a tensor of exactly `shape`, axes of one beside.
    fn read(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, Error> {
        let path = &self.path;
        let found = self.find(name).map(|(name, tensor)| (name.clone(), tensor.clone()));
        let (name, tensor) = found.ok_or_else(|| fault(path, format!("lacks `{name}`, of shape {shape:?}")))?;
        let bare = |shape: &[usize]| shape.iter().copied().filter(|&n| n != 1).collect::<Vec<_>>();
        let (known, dtype) = match &tensor.place {
            Place::Bytes(dtype, _) => {
                (matches!(dtype, Dtype::F16 | Dtype::BF16 | Dtype::F32 | Dtype::F64), format!("{dtype:?}"))
            }
            Place::Torch(tensor) => (tensor.is_float(), tensor.dtype.to_owned()),
        };
        let flat = shape.len() == 1 && bare(&tensor.shape) == bare(shape);
        if !known || (tensor.shape != shape && !flat) {
            let found = &tensor.shape;
            return Err(fault(path, format!("`{name}` is {dtype} {found:?}, expected floats {shape:?}")));
        }
        // The shape is one of ours, so this is at most a few megabytes.
        match (&mut self.source, &tensor.place) {
            (Source::Safetensors(file), Place::Bytes(dtype, at)) => {
                let size = dtype.bitsize() / 8;
                let mut bytes = vec![0; size * shape.iter().product::<usize>()];
                let cut = |e: std::io::Error| fault(path, format!("`{name}`, {dtype:?} {shape:?}: {e}"));
                file.seek(SeekFrom::Start(*at)).map_err(cut)?;
                file.read_exact(&mut bytes).map_err(cut)?;
                Ok(bytes.chunks_exact(size).map(|word| number(*dtype, word)).collect())
            }
            (Source::Torch(file), Place::Torch(tensor)) => Ok(match file.read(&name, tensor)?.data {
                Data::F32(values) => values,
                Data::F64(values) => values.into_iter().map(|value| value as f32).collect(),
                Data::I64(_) | Data::Bool(_) => Vec::new(),
            }),
            _ => Err(fault(path, format!("`{name}` is in no open file"))),
        }
    }
}

/// The tensors of a state dictionary, alone or as `state_dict` of a training checkpoint.
fn torch_tensors(file: &TorchFile<BufReader<File>>) -> Result<BTreeMap<String, Tensor>, Error> {
    let root = file.root();
    let mut tensors = BTreeMap::new();
    if let Value::Dict(items) = root.get("state_dict").unwrap_or(root) {
        for (name, value) in items {
            let Some(name) = name.as_str() else { continue };
            if let Some(tensor) = file.tensor(name, value)? {
                let shape = tensor.shape.clone();
                tensors.insert(name.to_owned(), Tensor { shape, place: Place::Torch(tensor) });
            }
        }
    }
    Ok(tensors)
}

/// A little-endian float.
fn number(dtype: Dtype, word: &[u8]) -> f32 {
    match (dtype, word) {
        (Dtype::F16, &[a, b]) => half(u16::from_le_bytes([a, b])),
        (Dtype::BF16, &[a, b]) => f32::from_le_bytes([0, 0, a, b]),
        (Dtype::F32, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]),
        (Dtype::F64, &[a, b, c, d, e, f, g, h]) => f64::from_le_bytes([a, b, c, d, e, f, g, h]) as f32,
        _ => f32::NAN,
    }
}

/// IEEE half precision: the exponent's bias is 15 instead of 127.
fn half(bits: u16) -> f32 {
    let (sign, rest) = (u32::from(bits & 0x8000) << 16, u32::from(bits & 0x7fff));
    // As a float with a wrong bias it is too small by 2¹¹², subnormal numbers included.
    let magnitude = if rest >= 0x7c00 {
        f32::from_bits(rest << 13 | 0x7f80_0000)
    } else {
        f32::from_bits(rest << 13) * 2f32.powi(112)
    };
    f32::from_bits(sign | magnitude.to_bits())
}

fn safetensors(path: &Path, file: &mut File) -> Result<BTreeMap<String, Tensor>, Error> {
    let length = file.metadata().map_err(io(path))?.len();
    let mut start = [0; 8];
    let not_ours = "is neither a safetensors file nor one that torch.save has written";
    file.seek(SeekFrom::Start(0)).and_then(|_| file.read_exact(&mut start)).map_err(|_| fault(path, not_ours))?;
    let header = u64::from_le_bytes(start);
    if header > MAX_HEADER || header > length.saturating_sub(8) {
        return Err(fault(path, format!("{not_ours}, or is cut: a header of {header} bytes in a file of {length}")));
    }
    let mut bytes = Vec::new();
    file.take(header).read_to_end(&mut bytes).map_err(io(path))?;
    let metadata: Metadata = serde_json::from_slice(&bytes).map_err(|e| fault(path, format!("{not_ours}: {e}")))?;
    let found = length - 8 - header;
    let mut tensors = BTreeMap::new();
    for (name, info) in metadata.tensors() {
        // Types and shapes fit the offsets: safetensors has looked. Whether the bytes are there it
        // cannot know.
        let (start, end) = (info.data_offsets.0 as u64, info.data_offsets.1 as u64);
        if end > found {
            let (dtype, shape) = (info.dtype, &info.shape);
            return Err(fault(path, format!("is cut: `{name}`, {dtype:?} {shape:?}, ends at byte {end} of {found}")));
        }
        let place = Place::Bytes(info.dtype, 8 + header + start);
        tensors.insert(name, Tensor { shape: info.shape.clone(), place });
    }
    Ok(tensors)
}
