//! Raw values of a mask file: palette indices, not colours.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use array_files::npz::read_npy;
use array_files::{Data, NdArray};
use image::DynamicImage;
use png::{ColorType, Decoder, Limits};

use crate::CaptureError;
use crate::image::{MAX_SIDE, decode, dimensions};

/// One value a pixel.
pub(super) struct Levels {
    pub width: u32,
    pub height: u32,
    /// Row by row.
    pub values: Vec<u8>,
    /// Whether values are ids: of a palette, or integers of a `.npy` file.
    pub ids: bool,
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
        let (width, height) = dimensions(path)?;
        let values = match decode(path)? {
            DynamicImage::ImageLuma8(grey) => grey.into_raw(),
            DynamicImage::ImageLuma16(grey) => grey.into_raw().into_iter().map(|v| (v >> 8) as u8).collect(),
            DynamicImage::ImageLumaA8(grey) => grey.into_raw().chunks_exact(2).map(|p| p[0]).collect(),
            other => {
                let rgb = other.into_rgb8();
                if let Some(pixel) = rgb.pixels().find(|p| p[0].abs_diff(p[1]).max(p[1].abs_diff(p[2])) > 16) {
                    let expected = "shades of grey, or a palette whose indices are objects";
                    return Err(CaptureError::invalid(path, "colours", expected, format!("colour {:?}", pixel.0)));
                }
                rgb.into_raw().chunks_exact(3).map(|p| p[0]).collect()
            }
        };
        Ok(Self { width, height, values, ids: false })
    }

    /// From an array (H,W), ignoring axes of length 1; floats are coverage from 0 to 1.
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
        let wrong = |value: String| CaptureError::invalid(path, "values", "ids of 0 to 255, or 0 to 1", value);
        let share = |value: f64| {
            let fits = (0.0..=1.0).contains(&value);
            fits.then_some((value * 255.0).round() as u8).ok_or_else(|| wrong(value.to_string()))
        };
        let (values, ids): (Result<Vec<u8>, _>, bool) = match &array.data {
            Data::Bool(v) => (Ok(v.iter().map(|&b| u8::from(b)).collect()), true),
            Data::I64(v) => (v.iter().map(|&id| u8::try_from(id).map_err(|_| wrong(id.to_string()))).collect(), true),
            Data::F32(v) => (v.iter().map(|&x| share(x.into())).collect(), false),
            Data::F64(v) => (v.iter().map(|&x| share(x)).collect(), false),
        };
        Ok(Self { width, height, values: values?, ids })
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
            row.get(at / 8).map_or(0, |byte| byte >> (8 - depth - at % 8) & mask)
        })
    });
    let mut values: Vec<u8> = values.collect();
    if kind == ColorType::Grayscale && depth == 1 {
        // One bit of grey is 0 or 255.
        values.iter_mut().for_each(|value| *value *= 255);
    }
    Ok(Some(Levels { width, height, values, ids: kind == ColorType::Indexed }))
}
