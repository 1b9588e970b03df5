//! Arrays as files hold them, and the checks between a file and a use.

use std::io::Write;

use crate::Error;

/// Values of an [`NdArray`], widened to the four types that are told apart.
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

/// Dense array, row-major whatever order the file had. `shape` is empty for a scalar.
#[derive(Clone, Debug, PartialEq)]
pub struct NdArray {
    /// Extent of every axis; the product is the number of values.
    pub shape: Vec<usize>,
    /// The values, last axis fastest.
    pub data: Data,
}

impl Data {
    /// numpy's name of the type in a file.
    pub(crate) fn descr(&self) -> &'static str {
        match self {
            Self::F64(_) => "<f8",
            Self::F32(_) => "<f4",
            Self::I64(_) => "<i8",
            Self::Bool(_) => "|b1",
        }
    }

    /// Writes the values as [`Data::descr`] says.
    pub(crate) fn write(&self, out: &mut impl Write) -> std::io::Result<()> {
        fn chunks<T: Copy, const N: usize>(
            v: &[T],
            out: &mut impl Write,
            bytes: fn(T) -> [u8; N],
        ) -> std::io::Result<()> {
            let mut buffer = Vec::new();
            for chunk in v.chunks(8192) {
                buffer.clear();
                buffer.extend(chunk.iter().flat_map(|&x| bytes(x)));
                out.write_all(&buffer)?;
            }
            Ok(())
        }
        match self {
            Self::F64(v) => chunks(v, out, f64::to_le_bytes),
            Self::F32(v) => chunks(v, out, f32::to_le_bytes),
            Self::I64(v) => chunks(v, out, i64::to_le_bytes),
            Self::Bool(v) => chunks(v, out, |x| [u8::from(x)]),
        }
    }
}

impl NdArray {
    /// Number of values.
    #[must_use]
    pub fn len(&self) -> usize {
        match &self.data {
            Data::F64(v) => v.len(),
            Data::F32(v) => v.len(),
            Data::I64(v) => v.len(),
            Data::Bool(v) => v.len(),
        }
    }

    /// Whether there are no values.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Every value as `f64`, row-major; booleans as 0 and 1.
    #[must_use]
    pub fn to_f64(&self) -> Vec<f64> {
        match &self.data {
            Data::F64(v) => v.clone(),
            Data::F32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Data::I64(v) => v.iter().map(|&x| x as f64).collect(),
            Data::Bool(v) => v.iter().map(|&x| f64::from(u8::from(x))).collect(),
        }
    }

    /// Every value as `f32`, row-major, after checking the shape against `pattern` (`None`: any
    /// size).
    ///
    /// `file` and `key` only name the array in errors.
    ///
    /// # Errors
    /// [`Error::Shape`]; [`Error::NotFinite`] for NaN, infinities and values beyond `f32`.
    pub fn to_f32(&self, file: &str, key: &str, pattern: &[Option<usize>]) -> Result<Vec<f32>, Error> {
        self.check_shape(file, key, pattern)?;
        let values: Vec<f32> = match &self.data {
            Data::F64(v) => v.iter().map(|&x| x as f32).collect(),
            Data::F32(v) => v.clone(),
            Data::I64(v) => v.iter().map(|&x| x as f32).collect(),
            Data::Bool(v) => v.iter().map(|&x| f32::from(u8::from(x))).collect(),
        };
        match values.iter().position(|x| !x.is_finite()) {
            Some(index) => Err(Error::NotFinite { file: file.to_owned(), key: key.to_owned(), index }),
            None => Ok(values),
        }
    }

    /// Every value as `i64`, row-major, after checking the shape against `pattern` (`None`: any
    /// size).
    ///
    /// # Errors
    /// [`Error::Shape`]; [`Error::Type`] for floats.
    pub fn to_i64(&self, file: &str, key: &str, pattern: &[Option<usize>]) -> Result<Vec<i64>, Error> {
        self.check_shape(file, key, pattern)?;
        match &self.data {
            Data::I64(v) => Ok(v.clone()),
            Data::Bool(v) => Ok(v.iter().map(|&x| i64::from(x)).collect()),
            Data::F32(_) | Data::F64(_) => Err(Error::Type {
                file: file.to_owned(),
                key: key.to_owned(),
                expected: "an array of integers",
                actual: "an array of floats".to_owned(),
            }),
        }
    }

    /// # Errors
    /// [`Error::Shape`] unless the shape fits `pattern`.
    fn check_shape(&self, file: &str, key: &str, pattern: &[Option<usize>]) -> Result<(), Error> {
        let fits = self.shape.len() == pattern.len()
            && (self.shape.iter().zip(pattern)).all(|(&n, p)| p.is_none_or(|p| p == n));
        if fits {
            return Ok(());
        }
        let sizes: Vec<String> = pattern.iter().map(|p| p.map_or("_".to_owned(), |n| n.to_string())).collect();
        Err(Error::Shape {
            file: file.to_owned(),
            key: key.to_owned(),
            expected: format!("[{}]", sizes.join(", ")),
            actual: self.shape.clone(),
        })
    }
}

/// Element type of an array on disk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ElementType {
    kind: Kind,
    size: usize,
    big_endian: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Bool,
    Signed,
    Unsigned,
    Float,
}

impl ElementType {
    /// Reads numpy's short form, such as `<f4`, `|b1`, `u8` or `>i2`. `None` for every other type.
    pub(crate) fn parse(descr: &str) -> Option<Self> {
        let (big_endian, rest) = match descr.as_bytes().first()? {
            b'<' | b'|' | b'=' => (false, &descr[1..]),
            b'>' => (true, &descr[1..]),
            _ => (false, descr),
        };
        let kind = match rest.as_bytes().first()? {
            b'b' => Kind::Bool,
            b'i' => Kind::Signed,
            b'u' => Kind::Unsigned,
            b'f' => Kind::Float,
            _ => return None,
        };
        let size = rest.get(1..)?.parse().ok()?;
        let known = match kind {
            Kind::Bool => size == 1,
            Kind::Signed | Kind::Unsigned => matches!(size, 1 | 2 | 4 | 8),
            Kind::Float => matches!(size, 2 | 4 | 8),
        };
        known.then_some(Self { kind, size, big_endian })
    }

    /// Bytes a value.
    pub(crate) fn size(self) -> usize {
        self.size
    }

    /// Bytes a value once decoded, when it is widened to one of the types of [`Data`].
    pub(crate) fn size_in_memory(self) -> usize {
        match self.kind {
            Kind::Bool => 1,
            Kind::Signed | Kind::Unsigned => 8,
            Kind::Float => self.size.max(4),
        }
    }

    /// This type in the named byte order (`<`, `>`, `|` or `=`).
    pub(crate) fn with_order(self, order: &str) -> Self {
        Self { big_endian: order == ">", ..self }
    }

    /// Decodes an array. `None` unless `bytes` has exactly the length that `shape` demands.
    pub(crate) fn decode(self, bytes: &[u8], shape: &[usize], fortran: bool) -> Option<NdArray> {
        let count = element_count(shape)?;
        if count.checked_mul(self.size as u128)? != bytes.len() as u128 {
            return None;
        }
        let data = match self.kind {
            Kind::Bool => Data::Bool(self.gather(bytes, shape, fortran, |b| b != 0)),
            Kind::Signed => {
                let shift = 64 - 8 * self.size as u32;
                Data::I64(self.gather(bytes, shape, fortran, |b| ((b << shift) as i64) >> shift))
            }
            Kind::Unsigned => Data::I64(self.gather(bytes, shape, fortran, |b| b as i64)),
            Kind::Float => match self.size {
                2 => Data::F32(self.gather(bytes, shape, fortran, |b| half(b as u16))),
                4 => Data::F32(self.gather(bytes, shape, fortran, |b| f32::from_bits(b as u32))),
                _ => Data::F64(self.gather(bytes, shape, fortran, f64::from_bits)),
            },
        };
        Some(NdArray { shape: shape.to_vec(), data })
    }

    /// Values in row-major order, each from its bits in the low end of a word.
    fn gather<T: Clone>(self, bytes: &[u8], shape: &[usize], fortran: bool, value: impl Fn(u64) -> T) -> Vec<T> {
        let word = |chunk: &[u8]| {
            let mut buffer = [0u8; 8];
            buffer[..chunk.len()].copy_from_slice(chunk);
            if self.big_endian {
                buffer[..chunk.len()].reverse();
            }
            value(u64::from_le_bytes(buffer))
        };
        let values: Vec<T> = bytes.chunks_exact(self.size).map(word).collect();
        if !fortran || shape.len() < 2 || values.is_empty() {
            return values;
        }
        // Walk the row-major order while tracking the column-major position.
        let mut index = vec![0usize; shape.len()];
        let mut out = Vec::with_capacity(values.len());
        let mut strides = vec![1usize; shape.len()];
        for axis in 1..shape.len() {
            strides[axis] = strides[axis - 1] * shape[axis - 1];
        }
        let mut at = 0;
        for _ in 0..values.len() {
            out.push(values[at].clone());
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
}

/// Product of the extents; `None` on overflow.
pub(crate) fn element_count(shape: &[usize]) -> Option<u128> {
    if shape.contains(&0) {
        return Some(0);
    }
    shape.iter().try_fold(1u128, |n, &extent| n.checked_mul(extent as u128))
}

/// IEEE half precision.
fn half(bits: u16) -> f32 {
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let exponent = i32::from(bits >> 10 & 31);
    let fraction = f32::from(bits & 0x3ff) / 1024.0;
    sign * match exponent {
        0 => fraction * 2f32.powi(-14),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        _ => (1.0 + fraction) * 2f32.powi(exponent - 15),
    }
}
