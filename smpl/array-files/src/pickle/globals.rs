//! Allow-list of globals, and element types of arrays by name.

use super::reader::Step;
use crate::element::{ElementType, Kind, byte_count};

/// Class of joblib's describing object, which never becomes a value.
pub(super) const WRAPPER: &str = "joblib.numpy_pickle.NumpyArrayWrapper";
pub(super) const CHUMPY: &str = "chumpy.ch.Ch";
pub(super) const CSC: &str = "scipy.sparse.csc_matrix";
pub(super) const CSR: &str = "scipy.sparse.csr_matrix";
pub(super) const COO: &str = "scipy.sparse.coo_matrix";

/// PyTorch's storage classes, its names of their elements, and those elements.
pub(crate) const STORAGES: [(&str, &str, ElementType); 10] = [
    ("torch.FloatStorage", "float32", ElementType::new(Kind::Float, 4)),
    ("torch.DoubleStorage", "float64", ElementType::new(Kind::Float, 8)),
    ("torch.HalfStorage", "float16", ElementType::new(Kind::Float, 2)),
    ("torch.BFloat16Storage", "bfloat16", ElementType::new(Kind::Brain, 2)),
    ("torch.LongStorage", "int64", ElementType::new(Kind::Signed, 8)),
    ("torch.IntStorage", "int32", ElementType::new(Kind::Signed, 4)),
    ("torch.ShortStorage", "int16", ElementType::new(Kind::Signed, 2)),
    ("torch.CharStorage", "int8", ElementType::new(Kind::Signed, 1)),
    ("torch.ByteStorage", "uint8", ElementType::new(Kind::Unsigned, 1)),
    ("torch.BoolStorage", "bool", ElementType::new(Kind::Bool, 1)),
];

/// A global on the allow-list.
#[derive(Clone, Copy)]
pub(super) enum Global {
    Reconstruct,
    Ndarray,
    Dtype,
    Scalar,
    FromBuffer,
    CopyReconstructor,
    Object,
    Set,
    Bytes,
    List,
    /// `dict`, `OrderedDict` or `defaultdict`.
    Dict,
    Encode,
    /// `torch.Tensor` from storage, offset, extents and strides.
    RebuildTensor,
    /// A tensor under another name.
    RebuildParameter,
    Class(&'static str),
}

/// numpy's type of an array's elements.
#[derive(Clone, Copy)]
pub(super) enum Dtype {
    Number(ElementType),
    Object,
    /// Latin-1 or ASCII, bytes per item.
    ByteText(usize),
    /// UTF-32, bytes per item.
    WideText {
        size: usize,
        big_endian: bool,
    },
}

impl Global {
    pub(super) fn find(module: &str, name: &str) -> Step<Self> {
        Ok(match (module, name) {
            ("numpy.core.multiarray" | "numpy._core.multiarray", "_reconstruct") => Self::Reconstruct,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "scalar") => Self::Scalar,
            ("numpy.core.numeric" | "numpy._core.numeric", "_frombuffer") => Self::FromBuffer,
            ("numpy", "ndarray") => Self::Ndarray,
            ("numpy", "dtype") => Self::Dtype,
            ("copy_reg" | "copyreg", "_reconstructor") => Self::CopyReconstructor,
            ("__builtin__" | "builtins", "object") => Self::Object,
            ("__builtin__" | "builtins", "set" | "frozenset") => Self::Set,
            ("__builtin__" | "builtins", "bytes" | "bytearray") => Self::Bytes,
            ("__builtin__" | "builtins", "list") => Self::List,
            ("__builtin__" | "builtins", "dict") => Self::Dict,
            ("collections", "defaultdict" | "OrderedDict") => Self::Dict,
            ("joblib.numpy_pickle", "NumpyArrayWrapper") => Self::Class(WRAPPER),
            ("_codecs", "encode") => Self::Encode,
            ("chumpy.ch", "Ch") => Self::Class(CHUMPY),
            ("scipy.sparse.csc" | "scipy.sparse._csc", "csc_matrix" | "csc_array") => Self::Class(CSC),
            ("scipy.sparse.csr" | "scipy.sparse._csr", "csr_matrix" | "csr_array") => Self::Class(CSR),
            ("scipy.sparse.coo" | "scipy.sparse._coo", "coo_matrix" | "coo_array") => Self::Class(COO),
            ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2") => Self::RebuildTensor,
            ("torch._utils", "_rebuild_parameter") => Self::RebuildParameter,
            _ => {
                let named = |class: &&str| module == "torch" && class.strip_prefix("torch.") == Some(name);
                let storage = STORAGES.iter().map(|(class, ..)| *class).find(named).map(Self::Class);
                let (module, name) = (module.escape_debug(), name.escape_debug());
                storage.ok_or_else(|| format!("global `{module} {name}` is not allowed"))?
            }
        })
    }
}

impl Dtype {
    pub(super) fn parse(name: &str) -> Step<Self> {
        if let Some(element) = ElementType::parse(name) {
            return Ok(Self::Number(element));
        }
        let bare = name.trim_start_matches(['<', '>', '|', '=']);
        let size = bare.get(1..).and_then(|s| s.parse::<usize>().ok()).filter(|n| (1..=1 << 20).contains(n));
        match (bare.as_bytes().first(), size) {
            (Some(b'O'), _) => Ok(Self::Object),
            (Some(b'S'), Some(size)) => Ok(Self::ByteText(size)),
            (Some(b'U'), Some(size)) => Ok(Self::WideText { size: 4 * size, big_endian: name.starts_with('>') }),
            _ => Err(format!("dtype {name:?} is not supported")),
        }
    }

    /// Bytes of an array as raw memory; `None` for objects.
    pub(super) fn raw_bytes(self, shape: &[usize]) -> Step<Option<u64>> {
        let size = match self {
            Self::Number(element) => element.size,
            Self::ByteText(size) | Self::WideText { size, .. } => size,
            Self::Object => return Ok(None),
        };
        let bytes = byte_count(shape, size).and_then(|n| u64::try_from(n).ok());
        bytes.map(Some).ok_or_else(|| format!("shape {shape:?}"))
    }
}

/// Number of elements of an array.
pub(super) fn count(shape: &[usize]) -> Step<usize> {
    let count = byte_count(shape, 1).and_then(|n| usize::try_from(n).ok());
    count.ok_or_else(|| format!("shape {shape:?}"))
}
