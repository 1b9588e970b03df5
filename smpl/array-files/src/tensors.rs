//! safetensors: named arrays and a header of texts, written deterministically and read with every
//! key, type and shape checked.
//!
//! ```
//! use array_files::tensors::{Tensor, Tensors, write};
//!
//! let path = std::env::temp_dir().join("array-files-tensors.safetensors");
//! let header = [("format", "example".to_owned())].into();
//! write(&path, &header, vec![Tensor::new("faces", &[1, 3], &[0u32, 1, 2][..])])?;
//!
//! let bytes = std::fs::read(&path)?;
//! let file = Tensors::parse("example", &bytes)?;
//! assert_eq!(file.header("format"), Some("example"));
//! assert_eq!(file.read::<u32>("faces", &[None, Some(3)])?, [0, 1, 2]);
//! assert!(file.read::<f32>("faces", &[None, Some(3)]).is_err());
//! # std::fs::remove_file(&path)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors};
use serde_json::json;

use crate::Error;
use crate::array::{fits, shown};

/// An element of a tensor.
///
/// ```
/// use array_files::tensors::Number;
///
/// let mut bytes = Vec::new();
/// 0x0102u16.write(&mut bytes)?;
/// assert_eq!(bytes, [2, 1]); // little-endian
/// assert_eq!(u16::read(&bytes), 0x0102);
/// # Ok::<(), std::io::Error>(())
/// ```
pub trait Number: Copy {
    /// Its type in a file.
    const DTYPE: Dtype;

    /// Reads it from its bytes, little-endian.
    ///
    /// # Panics
    /// Unless there are as many bytes as the number has.
    fn read(bytes: &[u8]) -> Self;

    /// Writes its bytes, little-endian.
    ///
    /// # Errors
    /// Those of `to`.
    fn write(self, to: &mut impl Write) -> io::Result<()>;
}

macro_rules! numbers {
    ($($number:ty: $dtype:ident),*) => {$(
        impl Number for $number {
            const DTYPE: Dtype = Dtype::$dtype;

            fn read(bytes: &[u8]) -> Self {
                let mut word = [0; size_of::<Self>()];
                word.copy_from_slice(bytes);
                Self::from_le_bytes(word)
            }

            fn write(self, to: &mut impl Write) -> io::Result<()> {
                to.write_all(&self.to_le_bytes())
            }
        }
    )*};
}

numbers!(f32: F32, u8: U8, u16: U16, u32: U32, u64: U64, i32: I32, i64: I64);

/// Writes the values of a tensor.
type Values<'a> = Box<dyn Fn(&mut BufWriter<File>) -> io::Result<()> + 'a>;

/// A tensor to be written.
///
/// ```
/// use array_files::tensors::Tensor;
///
/// let faces = [[0u32, 1, 2], [0, 2, 3]];
/// let borrowed = Tensor::new("faces", &[2, 3], faces.as_flattened());
/// let owned = Tensor::new("height", &[], vec![1.75f32]);
/// assert_eq!(format!("{borrowed:?}, {owned:?}"), "faces: U32 [2, 3], height: F32 []");
/// ```
pub struct Tensor<'a> {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    values: Values<'a>,
}

impl<'a> Tensor<'a> {
    /// A tensor of row-major `values`, borrowed or owned.
    ///
    /// # Panics
    /// If `shape` has another number of values.
    pub fn new<T: Number + 'a>(name: impl Into<String>, shape: &[usize], values: impl Into<Cow<'a, [T]>>) -> Self {
        let (name, values) = (name.into(), values.into());
        assert_eq!(shape.iter().product::<usize>(), values.len(), "{name}: values of shape {shape:?}");
        let values: Values<'a> = Box::new(move |to| values.iter().try_for_each(|value| value.write(to)));
        Self { name, dtype: T::DTYPE, shape: shape.to_vec(), values }
    }
}

impl fmt::Debug for Tensor<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {:?} {:?}", self.name, self.dtype, self.shape)
    }
}

/// Writes tensors as safetensors, with `header` as its metadata, and replaces the file at `path` as
/// [`replace_file`](crate::replace_file) does. Equal contents are
/// equal files.
///
/// # Errors
/// Those of the system.
pub fn write(path: &Path, header: &BTreeMap<&str, String>, mut tensors: Vec<Tensor<'_>>) -> io::Result<()> {
    // The widest first: all are aligned.
    tensors.sort_by(|a, b| b.dtype.cmp(&a.dtype).then(a.name.cmp(&b.name)));
    crate::replace_file(path, |to| {
        let mut keys = BTreeMap::from([("__metadata__", json!(header))]);
        let mut end = 0;
        for Tensor { name, dtype, shape, .. } in &tensors {
            let start = end;
            end += shape.iter().product::<usize>() * dtype.bitsize() / 8;
            keys.insert(name, json!({ "data_offsets": [start, end], "dtype": dtype, "shape": shape }));
        }
        let mut text = serde_json::to_vec(&keys)?;
        text.resize(text.len().next_multiple_of(8), b' ');
        to.write_all(&(text.len() as u64).to_le_bytes())?;
        to.write_all(&text)?;
        tensors.iter().try_for_each(|tensor| (tensor.values)(to))
    })
}

/// A parsed file.
///
/// ```
/// use array_files::tensors::Tensors;
///
/// let header = br#"{"ids":{"dtype":"U8","shape":[2],"data_offsets":[0,2]}}"#;
/// let bytes = [(header.len() as u64).to_le_bytes().as_slice(), header, &[7, 9]].concat();
/// let file = Tensors::parse("ids.safetensors", &bytes)?;
/// assert_eq!((file.shape("ids"), file.shape("names")), (Some(vec![2]), None));
/// let error = file.read::<f32>("ids", &[None]).unwrap_err();
/// assert_eq!(error.to_string(), "ids.safetensors: `ids`: U8 [2], expected F32 [_]");
/// # Ok::<(), array_files::Error>(())
/// ```
#[derive(Debug)]
pub struct Tensors<'a> {
    file: String,
    header: HashMap<String, String>,
    tensors: SafeTensors<'a>,
}

impl<'a> Tensors<'a> {
    /// Takes the bytes of a file apart; `file` names it in errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for anything but a whole safetensors file.
    pub fn parse(file: &str, bytes: &'a [u8]) -> Result<Self, Error> {
        let fault = |e| Error::invalid(file, "", format!("is not a whole safetensors file: {e}"));
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(fault)?;
        let header = metadata.metadata().clone().unwrap_or_default();
        Ok(Self { file: file.to_owned(), header, tensors: SafeTensors::deserialize(bytes).map_err(fault)? })
    }

    /// A text of the header.
    pub fn header(&self, key: &str) -> Option<&str> {
        self.header.get(key).map(String::as_str)
    }

    /// Extents of the tensor `key`; `None` where there is none.
    pub fn shape(&self, key: &str) -> Option<Vec<usize>> {
        self.tensors.tensor(key).ok().map(|view| view.shape().to_vec())
    }

    /// The values of the tensor `key`, row-major, if its elements are of type `T` and its shape
    /// fits `pattern` (`None`: any extent).
    ///
    /// # Errors
    /// [`Error::Invalid`] for a missing tensor and one of another type or shape.
    pub fn read<T: Number>(&self, key: &str, pattern: &[Option<usize>]) -> Result<Vec<T>, Error> {
        let missing = || {
            let mut names = self.tensors.names();
            names.sort_unstable();
            Error::missing(&self.file, key, names)
        };
        let view = self.tensors.tensor(key).map_err(|_| missing())?;
        let (dtype, shape) = (view.dtype(), view.shape());
        if dtype != T::DTYPE || !fits(shape, pattern) {
            let expected = format!("{:?} {}", T::DTYPE, shown(pattern));
            return Err(Error::invalid(&self.file, key, format!("{dtype:?} {shape:?}, expected {expected}")));
        }
        Ok(view.data().chunks_exact(size_of::<T>()).map(T::read).collect())
    }
}
