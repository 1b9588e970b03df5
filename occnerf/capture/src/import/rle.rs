//! COCO's run lengths: masks column by column, runs of 0 and 1 in turn, beginning with 0.

use array_files::pickle::Value;

use crate::CaptureError;
use crate::image::MAX_SIDE;
use crate::item::Item;

/// A mask in runs.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Rle {
    pub height: usize,
    pub width: usize,
    runs: Vec<u32>,
}

impl Rle {
    /// Reads `{size: [H, W], counts}`, counts being compressed (`bytes` or `str`) or a list of
    /// numbers.
    pub fn read(item: &Item<'_>) -> Result<Self, CaptureError> {
        let size = item.get("size")?;
        let sides = size.numbers(&[Some(2)])?;
        let side = |value: f64| value.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE)).contains(&value);
        if !sides.iter().all(|&value| side(value)) {
            return Err(size.invalid(format!("height and width of 1 to {MAX_SIDE}"), format!("{sides:?}")));
        }
        let (height, width) = (sides[0] as usize, sides[1] as usize);
        let counts = item.get("counts")?;
        let (pixels, most) = (height * width, height * width + 2);
        let runs = match counts.value {
            Value::Bytes(bytes) => decompressed(bytes, most),
            Value::Str(text) => decompressed(text.as_bytes(), most),
            _ => {
                let whole = |n: &f64| (n.fract() == 0.0).then(|| u32::try_from(*n as i64).ok()).flatten();
                let run = |n: &f64| whole(n).ok_or_else(|| format!("a run of {n}"));
                counts.numbers(&[None])?.iter().map(run).collect()
            }
        };
        let expected = || format!("runs of {pixels} pixels in all ({height}×{width})");
        let runs: Vec<u32> = runs.map_err(|what| counts.invalid(expected(), what))?;
        let sum: u64 = runs.iter().map(|&n| u64::from(n)).sum();
        if sum != pixels as u64 {
            return Err(counts.invalid(expected(), format!("{sum}")));
        }
        Ok(Self { height, width, runs })
    }

    /// The pixels row by row.
    pub fn pixels(&self) -> Vec<bool> {
        let mut out = vec![false; self.height * self.width];
        let mut at = 0;
        for (i, &run) in self.runs.iter().enumerate() {
            let end = at + run as usize;
            if i % 2 == 1 {
                for column_major in at..end {
                    out[column_major % self.height * self.width + column_major / self.height] = true;
                }
            }
            at = end;
        }
        out
    }
}

/// Decodes COCO's compression: six bits a character from `0` on, five of the number, the lowest
/// first, and a continuation bit. From the third on, a number is the difference to the one two
/// earlier.
fn decompressed(bytes: &[u8], most: usize) -> Result<Vec<u32>, String> {
    let mut runs: Vec<u32> = Vec::new();
    let mut rest = bytes.iter();
    while !rest.as_slice().is_empty() {
        let (mut value, mut shift) = (0i64, 0);
        loop {
            let Some(&byte) = rest.next() else { return Err("a last run that is cut".to_owned()) };
            let bits = byte.checked_sub(48).filter(|bits| *bits < 64);
            let bits = i64::from(bits.ok_or_else(|| format!("byte {byte}"))?);
            value |= (bits & 31) << shift;
            shift += 5;
            if bits & 32 == 0 {
                if bits & 16 != 0 {
                    value |= -1 << shift;
                }
                break;
            }
            if shift > 35 {
                return Err("a run beyond 32 bits".to_owned());
            }
        }
        if runs.len() > 2 {
            value += i64::from(runs[runs.len() - 2]);
        }
        if runs.len() == most {
            return Err("more runs than pixels".to_owned());
        }
        runs.push(u32::try_from(value).map_err(|_| format!("a run of {value}"))?);
    }
    Ok(runs)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use array_files::{Data, NdArray};
    use proptest::prelude::*;

    use super::*;

    fn value(size: [i64; 2], counts: Value) -> Value {
        let size = Value::List(size.map(Value::Int).to_vec());
        Value::Dict(vec![(Value::Str("size".to_owned()), size), (Value::Str("counts".to_owned()), counts)])
    }

    fn read(value: &Value) -> Result<Rle, CaptureError> {
        Rle::read(&Item::new(Path::new("f"), value))
    }

    /// Runs by walking the columns, and COCO's compression written from its description.
    fn compressed(pixels: &[bool], height: usize, width: usize) -> (Vec<u32>, Vec<u8>) {
        let mut runs = vec![0u32];
        let mut last = false;
        for x in 0..width {
            for y in 0..height {
                if pixels[y * width + x] != last {
                    runs.push(0);
                    last = !last;
                }
                *runs.last_mut().unwrap() += 1;
            }
        }
        let mut out = Vec::new();
        for i in 0..runs.len() {
            let mut x = i64::from(runs[i]) - if i > 2 { i64::from(runs[i - 2]) } else { 0 };
            loop {
                let mut c = (x & 31) as u8;
                x >>= 5;
                let more = if c & 16 != 0 { x != -1 } else { x != 0 };
                if more {
                    c |= 32;
                }
                out.push(c + 48);
                if !more {
                    break;
                }
            }
        }
        (runs, out)
    }

    proptest! {
        #[test]
        fn what_is_compressed_is_read_back(
            height in 1usize..40, width in 1usize..40, density in 0.0f64..1.0, seed in any::<u64>(),
        ) {
            let mut stream = volrender::RandomStream::new(&[seed]);
            let pixels: Vec<bool> = (0..height * width).map(|_| f64::from(stream.uniform()) < density).collect();
            let (runs, bytes) = compressed(&pixels, height, width);
            let size = [height as i64, width as i64];
            let text = String::from_utf8(bytes.clone()).unwrap();
            let list = Value::List(runs.iter().map(|&n| Value::Int(n.into())).collect());
            let array = NdArray { shape: vec![runs.len()], data: Data::I64(runs.iter().map(|&n| n.into()).collect()) };
            for counts in [Value::Bytes(bytes), Value::Str(text), list, Value::Array(array)] {
                prop_assert_eq!(&read(&value(size, counts)).unwrap().pixels(), &pixels);
            }
        }

        #[test]
        fn anything_else_is_an_error_or_a_mask_of_its_size(
            height in -1i64..20, width in 0i64..20, bytes in prop::collection::vec(any::<u8>(), 0..40),
        ) {
            if let Ok(rle) = read(&value([height, width], Value::Bytes(bytes))) {
                prop_assert_eq!(rle.pixels().len() as i64, height * width);
            }
        }
    }

    #[test]
    fn sizes_and_runs_that_do_not_fit_are_named() {
        let ones = |n| Value::List(vec![Value::Int(n)]);
        for (size, counts, words) in [
            ([2, 2], ones(5), "found 5"),
            ([2, 2], ones(3), "found 3"),
            ([2, 2], ones(-1), "a run of -1"),
            ([2, 2], Value::List(vec![Value::Float(1.5), Value::Float(3.2)]), "a run of 1.5"),
            ([0, 2], ones(0), "size"),
            ([1 << 40, 2], ones(0), "8192"),
            ([2, 2], Value::Bytes(vec![255]), "byte 255"),
            ([2, 2], Value::Bytes(b"ooooooooooooooo0".to_vec()), "32 bits"),
            ([2, 2], Value::Bytes(b"o".to_vec()), "cut"),
            ([2, 2], Value::None, "counts"),
        ] {
            let error = read(&value(size, counts)).unwrap_err().to_string();
            assert!(error.contains(words) && error.starts_with("f: "), "{error}");
        }
    }
}
