//! The allowed globals and the types of arrays' elements, by their names.

use super::reader::Step;
use crate::array::{ElementType, element_count};

/// Class of the describing object, which never becomes a value.
pub(super) const WRAPPER: &str = "joblib.numpy_pickle.NumpyArrayWrapper";

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
    /// A dictionary, or what makes the entries that a `defaultdict` lacks.
    Dict,
    List,
    DefaultDict,
    OrderedDict,
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
    /// Latin-1 or ASCII, bytes an item.
    ByteText(usize),
    /// UTF-32, bytes an item.
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
            ("__builtin__" | "builtins", "dict") => Self::Dict,
            ("__builtin__" | "builtins", "list") => Self::List,
            ("collections", "defaultdict") => Self::DefaultDict,
            ("collections", "OrderedDict") => Self::OrderedDict,
            ("joblib.numpy_pickle", "NumpyArrayWrapper") => Self::Class(WRAPPER),
            ("_codecs", "encode") => Self::Encode,
            ("chumpy.ch", "Ch") => Self::Class("chumpy.ch.Ch"),
            ("scipy.sparse.csc" | "scipy.sparse._csc", "csc_matrix") => Self::Class("scipy.sparse.csc_matrix"),
            ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2") => Self::RebuildTensor,
            ("torch._utils", "_rebuild_parameter") => Self::RebuildParameter,
            ("torch", "FloatStorage") => Self::Class("torch.FloatStorage"),
            ("torch", "DoubleStorage") => Self::Class("torch.DoubleStorage"),
            ("torch", "HalfStorage") => Self::Class("torch.HalfStorage"),
            ("torch", "BFloat16Storage") => Self::Class("torch.BFloat16Storage"),
            ("torch", "LongStorage") => Self::Class("torch.LongStorage"),
            ("torch", "IntStorage") => Self::Class("torch.IntStorage"),
            ("torch", "ShortStorage") => Self::Class("torch.ShortStorage"),
            ("torch", "CharStorage") => Self::Class("torch.CharStorage"),
            ("torch", "ByteStorage") => Self::Class("torch.ByteStorage"),
            ("torch", "BoolStorage") => Self::Class("torch.BoolStorage"),
            _ => return Err(format!("global `{} {}` is not allowed", module.escape_debug(), name.escape_debug())),
        })
    }
}

impl Dtype {
    pub(super) fn parse(name: &str) -> Step<Self> {
        if let Some(element) = ElementType::parse(name) {
            return Ok(Self::Number(element));
        }
        let big_endian = name.starts_with('>');
        let bare = name.trim_start_matches(['<', '>', '|', '=']);
        let size = |s: &str| s.parse::<usize>().ok().filter(|n| (1..=1 << 20).contains(n));
        let parsed = match bare.as_bytes().first() {
            Some(b'O') => Some(Self::Object),
            Some(b'S') => bare.get(1..).and_then(size).map(Self::ByteText),
            Some(b'U') => bare.get(1..).and_then(size).map(|n| Self::WideText { size: 4 * n, big_endian }),
            _ => None,
        };
        parsed.ok_or_else(|| format!("dtype {name:?} is not supported"))
    }

    /// Bytes of an array as raw memory; `None` for objects, which have none.
    pub(super) fn raw_bytes(self, shape: &[usize]) -> Step<Option<u64>> {
        let size = match self {
            Self::Number(element) => element.size(),
            Self::ByteText(size) | Self::WideText { size, .. } => size,
            Self::Object => return Ok(None),
        };
        let bytes = element_count(shape).and_then(|n| n.checked_mul(size as u128));
        let bytes = bytes.and_then(|n| u64::try_from(n).ok());
        bytes.map(Some).ok_or_else(|| format!("shape {shape:?}"))
    }
}

/// How many elements an array has.
pub(super) fn count(shape: &[usize]) -> Step<usize> {
    let count = element_count(shape).and_then(|n| usize::try_from(n).ok());
    count.ok_or_else(|| format!("shape {shape:?}"))
}
