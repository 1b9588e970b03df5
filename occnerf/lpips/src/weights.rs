//! Files of weights: finding a trunk with its linear layers, and reading single tensors.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use array_files::pickle::Value;
use array_files::torch::{self, TorchFile};
use safetensors::tensor::{Dtype, Metadata};

use crate::error::Error;
use crate::trunk::Trunk;

/// Longest header of a safetensors file, as in the format's own library.
const MAX_HEADER: u64 = 100_000_000;
/// Most files of a directory that are opened.
const MAX_FILES: usize = 256;

/// Type, shape and offset of each tensor of a safetensors file.
type Places = BTreeMap<String, (Dtype, Vec<usize>, u64)>;

/// An open file, and its tensors by name.
enum Source {
    Safetensors(File, Places),
    Torch(TorchFile<BufReader<File>>, BTreeMap<String, torch::Tensor>),
}

/// An open file of weights.
struct Weights {
    path: PathBuf,
    source: Source,
}

/// A trunk with its linear layers, in one file or two.
pub(crate) struct Found {
    pub trunk: Trunk,
    weights: Weights,
    lin: Option<Weights>,
}

impl Found {
    /// Reads a tensor of exactly `shape`; that of a linear layer may have further axes of length 1.
    pub fn read(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, Error> {
        match &mut self.lin {
            Some(lin) if name.starts_with("lin") => lin.read(name, shape),
            _ => self.weights.read(name, shape),
        }
    }

    /// Adds the file's name to the error of a tensor.
    pub fn blame(&self, error: Error) -> Error {
        match error {
            Error::Tensor { .. } => fault(&self.weights.path, error.to_string()),
            other => other,
        }
    }
}

fn fault(path: &Path, what: impl Into<String>) -> Error {
    Error::File { path: path.to_owned(), what: what.into() }
}

fn io(path: &Path) -> impl Fn(std::io::Error) -> Error {
    move |source| Error::Io { path: path.to_owned(), source }
}

/// Searches `path` as [`Lpips::load`](crate::Lpips::load) describes.
pub(crate) fn find(path: &Path) -> Result<Found, Error> {
    if std::fs::metadata(path).map_err(io(path))?.is_dir() {
        let found = first(path, |weights| match weights.trunk() {
            Some(trunk) => with_lin(weights, trunk, path).map(Some),
            None => Ok(None),
        });
        let absent = || fault(path, "has no .safetensors, .pth or .pt file with a trunk in it");
        return found?.ok_or_else(absent);
    }
    let weights = Weights::open(path)?;
    let trunk = weights.trunk().ok_or_else(|| {
        let names = weights.names().into_iter().take(4).collect::<Vec<_>>().join(", ");
        let expected = "expected `features.0.weight` and the other layers of SqueezeNet 1.1, VGG16 or AlexNet";
        fault(path, format!("holds no trunk: {expected}; it starts with {names}"))
    })?;
    let beside = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    with_lin(weights, trunk, beside)
}

/// Completes a trunk with linear layers from its own file or from a file in `directory`.
fn with_lin(weights: Weights, trunk: Trunk, directory: &Path) -> Result<Found, Error> {
    if weights.has_lin(trunk) {
        return Ok(Found { trunk, weights, lin: None });
    }
    let lin = first(directory, |lin| Ok(lin.has_lin(trunk).then_some(lin)))?;
    let absent = || {
        let name = trunk.name();
        let what = "without LPIPS's linear layers: no `lin0.weight`";
        fault(&weights.path, format!("is {name} {what} of {name} in it or in a file beside it"))
    };
    let lin = lin.ok_or_else(absent)?;
    Ok(Found { trunk, weights, lin: Some(lin) })
}

/// What `choose` makes of the first file of a directory that it takes. A damaged file is an error
/// only if it takes no other.
fn first<T>(directory: &Path, mut choose: impl FnMut(Weights) -> Result<Option<T>, Error>) -> Result<Option<T>, Error> {
    let mut first_error = None;
    for file in files(directory)? {
        match Weights::open(&file).and_then(&mut choose) {
            Ok(None) => {}
            Ok(found) => return Ok(found),
            Err(error) => first_error = first_error.or(Some(error)),
        }
    }
    first_error.map_or(Ok(None), Err)
}

/// Files of weights in a directory, sorted by name.
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
    /// Reads the names, types and shapes of a file's tensors.
    fn open(path: &Path) -> Result<Self, Error> {
        if path.exists() && !path.is_file() {
            return Err(fault(path, "is not a plain file"));
        }
        let mut file = File::open(path).map_err(io(path))?;
        let mut start = Vec::new();
        (&mut file).take(64).read_to_end(&mut start).map_err(io(path))?;
        let source = if torch::is_torch(&start) {
            let file = TorchFile::open(&path.display().to_string(), BufReader::new(file))?;
            let tensors = torch_tensors(&file)?;
            Source::Torch(file, tensors)
        } else {
            let tensors = safetensors(path, &mut file)?;
            Source::Safetensors(file, tensors)
        };
        Ok(Self { path: path.to_owned(), source })
    }

    fn names(&self) -> Vec<&str> {
        match &self.source {
            Source::Safetensors(_, tensors) => tensors.keys().map(String::as_str).collect(),
            Source::Torch(_, tensors) => tensors.keys().map(String::as_str).collect(),
        }
    }

    fn shape(&self, name: &str) -> Option<&[usize]> {
        match &self.source {
            Source::Safetensors(_, tensors) => tensors.get(name).map(|(_, shape, _)| shape.as_slice()),
            Source::Torch(_, tensors) => tensors.get(name).map(|tensor| tensor.shape.as_slice()),
        }
    }

    /// The trunk in the file, told by the names of its layers.
    fn trunk(&self) -> Option<Trunk> {
        let has = |name: &str| self.shape(name).is_some();
        match self.shape("features.0.weight")?.last() {
            Some(11) => Some(Trunk::AlexNet),
            _ if has("features.3.squeeze.weight") => Some(Trunk::SqueezeNet),
            _ if has("features.28.weight") && !has("features.34.weight") => Some(Trunk::Vgg16),
            _ => None,
        }
    }

    /// Whether the file has the linear layers of `trunk`.
    fn has_lin(&self, trunk: Trunk) -> bool {
        let channels = |i: usize| Some(self.shape(&self.named(&format!("lin{i}.weight")))?.iter().product::<usize>());
        let taps = trunk.taps();
        taps.iter().enumerate().all(|(i, taps)| channels(i) == Some(*taps)) && channels(taps.len()).is_none()
    }

    /// The name of a tensor in the file. The Python package `lpips` names linear layers
    /// `lin0.model.1.weight`.
    fn named(&self, name: &str) -> String {
        if self.shape(name).is_some() { name.to_owned() } else { name.replace(".weight", ".model.1.weight") }
    }

    fn read(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, Error> {
        let (own, path) = (self.named(name), &self.path);
        let bare = |shape: &[usize]| shape.iter().copied().filter(|&n| n != 1).collect::<Vec<_>>();
        let fits = |found: &[usize]| found == shape || shape.len() == 1 && bare(found) == bare(shape);
        let wrong = |dtype: &str, found: &[usize]| {
            fault(path, format!("`{own}` is {dtype} {found:?}, expected floats {shape:?}"))
        };
        let lacks = || fault(path, format!("lacks `{name}`, of shape {shape:?}"));
        // `shape` is that of a layer: at most 9 MB.
        match &mut self.source {
            Source::Safetensors(file, tensors) => {
                let (dtype, found, at) = tensors.get(&own).ok_or_else(lacks)?;
                if !matches!(dtype, Dtype::F16 | Dtype::BF16 | Dtype::F32 | Dtype::F64) || !fits(found) {
                    return Err(wrong(&format!("{dtype:?}"), found));
                }
                let size = dtype.bitsize() / 8;
                let mut bytes = vec![0; size * shape.iter().product::<usize>()];
                let read = file.seek(SeekFrom::Start(*at)).and_then(|_| file.read_exact(&mut bytes));
                read.map_err(|e| fault(path, format!("`{own}`, {dtype:?} {shape:?}: {e}")))?;
                Ok(bytes.chunks_exact(size).map(|word| number(*dtype, word)).collect())
            }
            Source::Torch(file, tensors) => {
                let tensor = tensors.get(&own).ok_or_else(lacks)?;
                if !tensor.is_float() || !fits(&tensor.shape) {
                    return Err(wrong(tensor.dtype, &tensor.shape));
                }
                // Exact: floats of 16 and 32 bits are widened and narrowed again.
                Ok(file.read(&own, tensor)?.to_f64().into_iter().map(|value| value as f32).collect())
            }
        }
    }
}

/// Tensors of a state dictionary, saved alone or as `state_dict` of a training checkpoint.
fn torch_tensors(file: &TorchFile<BufReader<File>>) -> Result<BTreeMap<String, torch::Tensor>, Error> {
    let root = file.root();
    let mut tensors = BTreeMap::new();
    if let Value::Dict(items) = root.get("state_dict").unwrap_or(root) {
        for (name, value) in items {
            let Some(name) = name.as_str() else { continue };
            if let Some(tensor) = file.tensor(name, value)? {
                tensors.insert(name.to_owned(), tensor);
            }
        }
    }
    Ok(tensors)
}

/// Converts a little-endian float of any width.
fn number(dtype: Dtype, word: &[u8]) -> f32 {
    match (dtype, word) {
        (Dtype::F16, &[a, b]) => array_files::half_to_f32(u16::from_le_bytes([a, b])),
        (Dtype::BF16, &[a, b]) => f32::from_le_bytes([0, 0, a, b]),
        (Dtype::F32, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]),
        (Dtype::F64, &[a, b, c, d, e, f, g, h]) => f64::from_le_bytes([a, b, c, d, e, f, g, h]) as f32,
        _ => f32::NAN,
    }
}

/// Tensors of a safetensors file, from its header.
fn safetensors(path: &Path, file: &mut File) -> Result<Places, Error> {
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
        // `Metadata` checks types and shapes against the offsets, not the offsets against the file.
        let (start, end) = (info.data_offsets.0 as u64, info.data_offsets.1 as u64);
        if end > found {
            let (dtype, shape) = (info.dtype, &info.shape);
            return Err(fault(path, format!("is cut: `{name}`, {dtype:?} {shape:?}, ends at byte {end} of {found}")));
        }
        tensors.insert(name, (info.dtype, info.shape.clone(), 8 + header + start));
    }
    Ok(tensors)
}
