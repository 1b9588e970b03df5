//! Element types of files: names, sizes, decoding and encoding.

use std::borrow::Cow;

use crate::array::{Data, NdArray};

/// Element type of an array in a file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ElementType {
    kind: Kind,
    /// Bytes per value.
    pub(crate) size: usize,
    big_endian: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Kind {
    Bool,
    Signed,
    Unsigned,
    Float,
    /// bfloat16: the high half of a 32-bit float.
    Brain,
}

impl ElementType {
    pub(crate) const fn new(kind: Kind, size: usize) -> Self {
        Self { kind, size, big_endian: false }
    }

    /// Type of numpy's short name, such as `<f4`, `|b1`, `u8` or `>i2`; `None` for all others.
    pub(crate) fn parse(descr: &str) -> Option<Self> {
        let name = descr.strip_prefix(['<', '>', '|', '=']).unwrap_or(descr);
        let size = name.get(1..)?.parse().ok()?;
        let kind = match (name.as_bytes()[0], size) {
            (b'b', 1) => Kind::Bool,
            (b'i', 1 | 2 | 4 | 8) => Kind::Signed,
            (b'u', 1 | 2 | 4 | 8) => Kind::Unsigned,
            (b'f', 2 | 4 | 8) => Kind::Float,
            _ => return None,
        };
        Some(Self { kind, size, big_endian: descr.starts_with('>') })
    }

    /// Bytes per value once widened to a type of [`Data`].
    pub(crate) fn size_in_memory(self) -> usize {
        match self.kind {
            Kind::Bool => 1,
            Kind::Signed | Kind::Unsigned => 8,
            Kind::Float | Kind::Brain => self.size.max(4),
        }
    }

    /// This type in numpy's byte order `<`, `>`, `|` or `=`.
    pub(crate) fn with_order(self, order: &str) -> Self {
        Self { big_endian: order == ">", ..self }
    }

    /// The array of `bytes`, column-major if `fortran`. `None` if `shape` needs another length.
    pub(crate) fn decode(self, bytes: &[u8], shape: &[usize], fortran: bool) -> Option<NdArray> {
        if byte_count(shape, self.size)? != bytes.len() as u128 {
            return None;
        }
        let mut bytes = Cow::Borrowed(bytes);
        if fortran && shape.len() > 1 && !bytes.is_empty() {
            let strides = shape.iter().scan(1, |next, n| Some(std::mem::replace(next, *next * n)));
            let strides: Vec<usize> = strides.collect();
            bytes = Cow::Owned(gather(&bytes, self.size, shape, &strides, 0));
        }
        let data = match (self.kind, self.size) {
            (Kind::Bool, _) => Data::Bool(self.values(&bytes, |bits| bits != 0)),
            (Kind::Signed, size) => {
                let shift = 64 - 8 * size as u32;
                Data::I64(self.values(&bytes, |bits| ((bits << shift) as i64) >> shift))
            }
            (Kind::Unsigned, _) => Data::I64(self.values(&bytes, |bits| bits as i64)),
            (Kind::Brain, _) => Data::F32(self.values(&bytes, |bits| f32::from_bits((bits as u32) << 16))),
            (Kind::Float, 2) => Data::F32(self.values(&bytes, |bits| half_to_f32(bits as u16))),
            (Kind::Float, 4) => Data::F32(self.values(&bytes, |bits| f32::from_bits(bits as u32))),
            (Kind::Float, _) => Data::F64(self.values(&bytes, f64::from_bits)),
        };
        Some(NdArray { shape: shape.to_vec(), data })
    }

    /// Values from their bits, in the low end of a word.
    fn values<T>(self, bytes: &[u8], value: impl Fn(u64) -> T) -> Vec<T> {
        let word = |chunk: &[u8]| {
            let mut word = [0u8; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            if self.big_endian {
                word[..chunk.len()].reverse();
            }
            value(u64::from_le_bytes(word))
        };
        bytes.chunks_exact(self.size).map(word).collect()
    }
}

/// numpy's name of the element type of `data`, and the bytes of its values.
pub(crate) fn encode(data: &Data) -> (&'static str, Vec<u8>) {
    match data {
        Data::F64(v) => ("<f8", v.iter().flat_map(|x| x.to_le_bytes()).collect()),
        Data::F32(v) => ("<f4", v.iter().flat_map(|x| x.to_le_bytes()).collect()),
        Data::I64(v) => ("<i8", v.iter().flat_map(|x| x.to_le_bytes()).collect()),
        Data::Bool(v) => ("|b1", v.iter().map(|&x| u8::from(x)).collect()),
    }
}

/// Bytes of an array with elements of `size` bytes; `None` on overflow.
pub(crate) fn byte_count(shape: &[usize], size: usize) -> Option<u128> {
    if shape.contains(&0) {
        return Some(0);
    }
    shape.iter().try_fold(size as u128, |n, &extent| n.checked_mul(extent as u128))
}

/// Elements of `size` bytes of a strided view, in row-major order. `strides` and `offset` count
/// elements; the view is not empty and lies within `storage`.
pub(crate) fn gather(storage: &[u8], size: usize, shape: &[usize], strides: &[usize], offset: usize) -> Vec<u8> {
    let count: usize = shape.iter().product();
    let mut expected = 1;
    let contiguous = shape.iter().zip(strides).rev().all(|(&extent, &stride)| {
        let fits = extent == 1 || stride == expected;
        expected *= extent;
        fits
    });
    if contiguous {
        return storage[offset * size..][..count * size].to_vec();
    }
    // The stride of an axis of one element is arbitrary.
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

/// Value of an IEEE half-precision number.
pub fn half_to_f32(bits: u16) -> f32 {
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
