//! Raw values of a mask file: palette indices, not colours.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use array_files::npz::read_npy;
use array_files::{Data, NdArray};
use png::{ColorType, Decoder, Limits};

use crate::CaptureError;
use crate::image::{MAX_SIDE, alpha, decode, dimensions};

/// One value a pixel.
pub(super) struct Levels {
    pub width: u32,
    pub height: u32,
    /// Row by row.
    pub values: Vec<u32>,
    /// Full coverage, where values are coverage: 255 or 65535.
    pub full: u32,
    /// Whether values are ids: of a palette, or integers of a `.npy` file.
    pub ids: bool,
    /// Whether values are of an alpha channel.
    pub alpha: bool,
}

impl Levels {
    /// Reads a PNG, JPEG or `.npy` file.
    pub fn load(path: &Path) -> Result<Self, CaptureError> {
        if path.extension().is_some_and(|e| e == "npy") {
            return Self::from_array(path, &read_npy(path)?);
        }
        if let Some(levels) = indexed(path)? {
            return Ok(levels);
        }
        let picture = decode(path)?;
        let (width, height) = (picture.width(), picture.height());
        if let Some(alpha) = alpha(&picture) {
            let values = alpha.into_iter().map(u32::from).collect();
            return Ok(Self { width, height, values, full: 65535, ids: false, alpha: true });
        }
        // Levels of 8 bits are not scaled: they may be ids.
        let depth = picture.color().bytes_per_pixel() / picture.color().channel_count();
        let scale = if depth > 1 { 1 } else { 257 };
        let rgb = picture.into_rgb16();
        let spread = |p: &image::Rgb<u16>| p[0].abs_diff(p[1]).max(p[1].abs_diff(p[2]));
        if let Some(pixel) = rgb.pixels().find(|p| spread(p) > 16 * 257) {
            let expected = "shades of grey, a palette whose indices are objects, or transparency (alpha)";
            let found = format!("colour {:?}", pixel.0.map(|c| c / 257));
            return Err(CaptureError::invalid(path, "colours", expected, found));
        }
        let values = rgb.pixels().map(|p| u32::from(p[0]) / scale).collect();
        Ok(Self { width, height, values, full: 65535 / scale, ids: false, alpha: false })
    }

    /// From an array (H,W), ignoring axes of length 1; floats are coverage from 0 to 1, or whole
    /// numbers.
    pub fn from_array(path: &Path, array: &NdArray) -> Result<Self, CaptureError> {
        let bare: Vec<usize> = array.shape.iter().copied().filter(|&n| n != 1).collect();
        let sides = match (array.shape.as_slice(), bare.as_slice()) {
            (&[height, width], _) | (_, &[height, width]) => Some((width, height)),
            _ => None,
        };
        let side = |n: usize| u32::try_from(n).ok().filter(|n| (1..=MAX_SIDE).contains(n));
        let sides = sides.and_then(|(width, height)| side(width).zip(side(height)));
        let (width, height) = sides.ok_or_else(|| {
            let expected = format!("(height, width) of 1 to {MAX_SIDE}");
            CaptureError::invalid(path, "shape", expected, format!("{:?}", array.shape))
        })?;
        let wrong = |value: String| {
            CaptureError::invalid(path, "values", "ids of objects from 0, or coverage from 0 to 1", value)
        };
        let whole = |id: i64| u32::try_from(id).map_err(|_| wrong(id.to_string()));
        let (values, ids): (Result<Vec<u32>, _>, bool) = match &array.data {
            Data::Bool(v) => (Ok(v.iter().map(|&b| u32::from(b)).collect()), true),
            Data::I64(v) => (v.iter().map(|&id| whole(id)).collect(), true),
            Data::F32(_) | Data::F64(_) => {
                let values = array.to_f64();
                let ids = values.iter().any(|x| *x > 1.0) && values.iter().all(|x| x.fract() == 0.0);
                let share = |&x: &f64| match ids {
                    true => whole(x as i64),
                    false if (0.0..=1.0).contains(&x) => Ok((x * 65535.0).round() as u32),
                    false => Err(wrong(x.to_string())),
                };
                (values.iter().map(share).collect(), ids)
            }
        };
        let full = if ids { 255 } else { 65535 };
        Ok(Self { width, height, values: values?, full, ids, alpha: false })
    }

    /// Checks the size against the frames'.
    pub fn sized(self, path: &Path, size: (u32, u32)) -> Result<Self, CaptureError> {
        if (self.width, self.height) == size {
            return Ok(self);
        }
        let expected = format!("{}×{}, as the frames", size.0, size.1);
        Err(CaptureError::invalid(path, "size", expected, format!("{}×{}", self.width, self.height)))
    }
}

/// The values of a PNG with a palette or at most 8 bits of grey; `None` for others.
fn indexed(path: &Path) -> Result<Option<Levels>, CaptureError> {
    let file = BufReader::new(File::open(path).map_err(CaptureError::io(path))?);
    let limits = Limits { bytes: (MAX_SIDE as usize).pow(2) };
    let Ok(mut reader) = Decoder::new_with_limits(file, limits).read_info() else { return Ok(None) };
    let info = reader.info();
    let (kind, depth) = (info.color_type, info.bit_depth as usize);
    if !matches!(kind, ColorType::Indexed | ColorType::Grayscale) || depth > 8 {
        return Ok(None);
    }
    // Checks the size.
    let (width, height) = dimensions(path)?;
    let malformed = |what: String| CaptureError::invalid(path, "pixels", "a whole PNG", what);
    let length = reader.output_buffer_size().ok_or_else(|| malformed("no size".to_owned()))?;
    let mut bytes = vec![0; length];
    reader.next_frame(&mut bytes).map_err(|e| malformed(e.to_string()))?;
    let row = (width as usize * depth).div_ceil(8);
    let mask = ((1u16 << depth) - 1) as u8;
    let values = bytes.chunks(row.max(1)).take(height as usize).flat_map(|row| {
        // The leftmost pixel is in the highest bits.
        (0..width as usize).map(move |x| {
            let at = x * depth;
            row.get(at / 8).map_or(0, |byte| u32::from(byte >> (8 - depth - at % 8) & mask))
        })
    });
    let mut values: Vec<u32> = values.collect();
    if kind == ColorType::Grayscale && depth == 1 {
        // One bit of grey is 0 or 255.
        values.iter_mut().for_each(|value| *value *= 255);
    }
    Ok(Some(Levels { width, height, values, full: 255, ids: kind == ColorType::Indexed, alpha: false }))
}
