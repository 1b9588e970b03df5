//! Arrays in memory, and conversions with checks of shape and type.

use crate::Error;

/// Values of an [`NdArray`], widened to four types.
///
/// ```
/// use array_files::{Data, pickle};
///
/// // Two 16-bit integers as numpy saves them.
/// let header = b"\x93NUMPY\x01\0\x3a\0{'descr': '<i2', 'fortran_order': False, 'shape': (2,), }\n";
/// let value = pickle::from_bytes("two.npy", [header.as_slice(), b"\x07\0\xff\xff"].concat())?;
/// assert_eq!(value.as_array().map(|array| &array.data), Some(&Data::I64(vec![7, -1])));
/// # Ok::<(), array_files::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub enum Data {
    /// 64-bit floats.
    F64(Vec<f64>),
    /// 16- and 32-bit floats.
    F32(Vec<f32>),
    /// Integers of every width; unsigned 64-bit values above `i64::MAX` wrap.
    I64(Vec<i64>),
    /// Booleans.
    Bool(Vec<bool>),
}

/// Dense row-major array.
///
/// ```
/// use array_files::{Data, NdArray};
///
/// let array = NdArray { shape: vec![2, 2], data: Data::F64(vec![1.0, 2.0, 3.0, 4.0]) };
/// assert_eq!(array.to_f32("a.npz", "k", &[Some(2), None])?, [1.0, 2.0, 3.0, 4.0]);
/// let error = array.to_f32("a.npz", "k", &[Some(3)]).unwrap_err();
/// assert_eq!(error.to_string(), "a.npz: `k`: shape [2, 2], expected [3]");
/// # Ok::<(), array_files::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct NdArray {
    /// Extent of every axis, empty for a scalar; the product is the number of values.
    pub shape: Vec<usize>,
    /// The values, last axis fastest.
    pub data: Data,
}

impl NdArray {
    /// Number of values.
    pub fn len(&self) -> usize {
        match &self.data {
            Data::F64(v) => v.len(),
            Data::F32(v) => v.len(),
            Data::I64(v) => v.len(),
            Data::Bool(v) => v.len(),
        }
    }

    /// Whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Every value as `f64`, row-major; booleans as 0 and 1.
    pub fn to_f64(&self) -> Vec<f64> {
        match &self.data {
            Data::F64(v) => v.clone(),
            Data::F32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Data::I64(v) => v.iter().map(|&x| x as f64).collect(),
            Data::Bool(v) => v.iter().map(|&x| f64::from(u8::from(x))).collect(),
        }
    }

    /// Every value as finite `f32`, row-major, if the shape fits `pattern` (`None`: any extent).
    /// `file` and `key` name the array in errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] for another shape, and for NaN, infinities and values beyond `f32`.
    pub fn to_f32(&self, file: &str, key: &str, pattern: &[Option<usize>]) -> Result<Vec<f32>, Error> {
        self.check_shape(file, key, pattern)?;
        let values: Vec<f32> = match &self.data {
            Data::F64(v) => v.iter().map(|&x| x as f32).collect(),
            Data::F32(v) => v.clone(),
            Data::I64(v) => v.iter().map(|&x| x as f32).collect(),
            Data::Bool(v) => v.iter().map(|&x| f32::from(u8::from(x))).collect(),
        };
        match values.iter().position(|x| !x.is_finite()) {
            Some(index) => Err(Error::invalid(file, key, format!("not finite at flat index {index}"))),
            None => Ok(values),
        }
    }

    /// Every value as `i64`, row-major, if the shape fits `pattern` (`None`: any extent).
    ///
    /// # Errors
    /// [`Error::Invalid`] for another shape and for floats.
    pub fn to_i64(&self, file: &str, key: &str, pattern: &[Option<usize>]) -> Result<Vec<i64>, Error> {
        self.check_shape(file, key, pattern)?;
        match &self.data {
            Data::I64(v) => Ok(v.clone()),
            Data::Bool(v) => Ok(v.iter().map(|&x| i64::from(x)).collect()),
            Data::F32(_) | Data::F64(_) => Err(Error::invalid(file, key, "floats, expected integers")),
        }
    }

    fn check_shape(&self, file: &str, key: &str, pattern: &[Option<usize>]) -> Result<(), Error> {
        let fault = || Error::invalid(file, key, format!("shape {:?}, expected {}", self.shape, shown(pattern)));
        if fits(&self.shape, pattern) { Ok(()) } else { Err(fault()) }
    }
}

/// Whether a shape has the extents of `pattern` (`None`: any).
pub(crate) fn fits(shape: &[usize], pattern: &[Option<usize>]) -> bool {
    shape.len() == pattern.len() && shape.iter().zip(pattern).all(|(extent, n)| n.is_none_or(|n| n == *extent))
}

/// The pattern of a shape as errors show it, such as `[6890, _]`.
pub(crate) fn shown(pattern: &[Option<usize>]) -> String {
    let extents: Vec<String> = pattern.iter().map(|n| n.map_or("_".to_owned(), |n| n.to_string())).collect();
    format!("[{}]", extents.join(", "))
}
