//! RGB pictures in memory, and reading and writing them.

use std::path::Path;

use image::imageops::{FilterType, resize as resize_picture};
use image::metadata::Orientation;
use image::{DynamicImage, ImageBuffer, ImageDecoder, ImageReader, Luma, Rgb};

use super::CaptureError;

/// Longest decoded side.
pub const MAX_SIDE: u32 = 8192;

/// An sRGB picture with values from 0 to 1.
///
/// ```
/// let mut image = capture::Image::new(2, 1);
/// image.pixels[3..].copy_from_slice(&[1.0, 0.5, 0.0]);
/// assert_eq!([image.rgb(0, 0), image.rgb(1, 0)], [[0.0; 3], [1.0, 0.5, 0.0]]);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// (H, W, 3), row-major from the top left.
    pub pixels: Vec<f32>,
}

impl Image {
    /// A black picture.
    #[must_use]
    pub fn new(width: u32, height: u32) -> Self {
        Self { width, height, pixels: vec![0.0; width as usize * height as usize * 3] }
    }

    /// The colour at `column`, `row`.
    ///
    /// # Panics
    /// Outside the picture.
    #[must_use]
    pub fn rgb(&self, column: u32, row: u32) -> [f32; 3] {
        assert!(
            column < self.width && row < self.height,
            "Image::rgb: ({column}, {row}) of {}×{}",
            self.width,
            self.height
        );
        let i = (row as usize * self.width as usize + column as usize) * 3;
        [self.pixels[i], self.pixels[i + 1], self.pixels[i + 2]]
    }

    /// Reads a PNG or JPEG of 8 or 16 bits a channel, turned upright by the orientation of its Exif
    /// data; grey becomes RGB, transparency is dropped. Colours are taken for sRGB: embedded
    /// profiles and gamma chunks are not applied.
    ///
    /// # Errors
    /// [`CaptureError::Io`], [`CaptureError::Picture`], and, before decoding,
    /// [`CaptureError::Invalid`] for a side of 0 or above 8192.
    pub fn load(path: &Path) -> Result<Self, CaptureError> {
        let decoded = decode(path)?.into_rgb32f();
        Ok(Self { width: decoded.width(), height: decoded.height(), pixels: decoded.into_raw() })
    }

    /// Writes an 8-bit PNG; values are clamped to 0 to 1 and NaN becomes 0.
    ///
    /// # Errors
    /// [`CaptureError::Io`] or [`CaptureError::Picture`] where the file cannot be written,
    /// [`CaptureError::Setting`] where `pixels` is not (H, W, 3).
    pub fn save_png(&self, path: &Path) -> Result<(), CaptureError> {
        let bytes = self.pixels.iter().copied().map(to_byte).collect();
        let picture = image::RgbImage::from_raw(self.width, self.height, bytes);
        let picture = picture.ok_or_else(|| {
            let expected = format!("{}×{}×3 values", self.height, self.width);
            CaptureError::setting("pixels", expected, self.pixels.len())
        })?;
        picture.save_with_format(path, image::ImageFormat::Png).map_err(|source| picture_error(path, source))
    }

    /// Multiplies every pixel by its entry of `mask` (H, W).
    ///
    /// # Panics
    /// Where `mask` has another size.
    pub fn multiply(&mut self, mask: &[f32]) {
        assert_eq!(mask.len() * 3, self.pixels.len(), "Image::multiply: mask is not ({}, {})", self.height, self.width);
        for (pixel, coverage) in self.pixels.chunks_exact_mut(3).zip(mask) {
            for channel in pixel {
                *channel *= coverage;
            }
        }
    }
}

/// Nearest of 256 levels. `as` saturates, and takes NaN to 0.
pub(super) fn to_byte(value: f32) -> u8 {
    (value * 255.0 + 0.5) as u8
}

pub(super) fn picture_error(path: &Path, source: image::ImageError) -> CaptureError {
    match source {
        // A truncated file is damaged.
        image::ImageError::IoError(source) if source.kind() != std::io::ErrorKind::UnexpectedEof => {
            CaptureError::Io { path: path.to_owned(), source }
        }
        source => CaptureError::Picture { path: path.to_owned(), source },
    }
}

fn open(path: &Path) -> Result<ImageReader<std::io::BufReader<std::fs::File>>, CaptureError> {
    // A pipe is read once, a picture twice.
    if path.metadata().is_ok_and(|found| !found.is_file()) {
        return Err(CaptureError::invalid(path, "the file", "a plain file", "a device, pipe or folder"));
    }
    ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(CaptureError::io(path))
}

/// Width and height from the header alone, upright.
pub(super) fn dimensions(path: &Path) -> Result<(u32, u32), CaptureError> {
    header(path).map(|(_, _, size)| size)
}

/// Whether a picture has a colour profile that is not named sRGB.
pub(super) fn has_profile(path: &Path) -> Result<bool, CaptureError> {
    let profile = header(path)?.0.icc_profile().map_err(|source| picture_error(path, source))?;
    // Version 4 has UTF-16.
    let bytes: Vec<u8> = profile.unwrap_or_default().into_iter().filter(|byte| *byte != 0).collect();
    Ok(!bytes.is_empty() && !bytes.windows(4).any(|word| word == b"sRGB"))
}

/// A decoder, the orientation of Exif, and the upright size.
fn header(path: &Path) -> Result<(impl ImageDecoder, Orientation, (u32, u32)), CaptureError> {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    let mut decoder = open(path)?.into_decoder().map_err(|source| picture_error(path, source))?;
    let orientation = decoder.orientation().map_err(|source| picture_error(path, source))?;
    let (mut width, mut height) = decoder.dimensions();
    if matches!(orientation, Rotate90 | Rotate90FlipH | Rotate270 | Rotate270FlipH) {
        (width, height) = (height, width);
    }
    if width.min(height) == 0 || width.max(height) > MAX_SIDE {
        return Err(CaptureError::invalid(
            path,
            "size",
            format!("1 to {MAX_SIDE} pixels a side"),
            format!("{width}×{height}"),
        ));
    }
    Ok((decoder, orientation, (width, height)))
}

/// The picture, upright.
pub(super) fn decode(path: &Path) -> Result<DynamicImage, CaptureError> {
    let (decoder, orientation, _) = header(path)?;
    let mut picture = DynamicImage::from_decoder(decoder).map_err(|source| picture_error(path, source))?;
    picture.apply_orientation(orientation);
    Ok(picture)
}

/// The alpha channel, 16 bits, where a pixel is not opaque.
pub(super) fn alpha(picture: &DynamicImage) -> Option<Vec<u16>> {
    if !picture.color().has_alpha() {
        return None;
    }
    let alpha: Vec<u16> = picture.to_luma_alpha16().pixels().map(|pixel| pixel.0[1]).collect();
    alpha.iter().any(|a| *a < u16::MAX).then_some(alpha)
}

/// Coverage in [0,1] from a mask picture, with its width and height: alpha where a pixel is not
/// opaque, else the largest of a pixel's colour channels, full scale (255) being 1.
pub(super) fn load_mask(path: &Path) -> Result<(u32, u32, Vec<f32>), CaptureError> {
    let picture = decode(path)?;
    let (width, height) = (picture.width(), picture.height());
    let mask = match alpha(&picture) {
        Some(alpha) => alpha.into_iter().map(|a| f32::from(a) / f32::from(u16::MAX)).collect(),
        None => picture.into_rgb32f().pixels().map(|p| p[0].max(p[1]).max(p[2])).collect(),
    };
    Ok((width, height, mask))
}

/// Resamples values of `channels` (1 or 3) a pixel with a tent filter as wide as the reduction
/// needs; the outer edges of both pictures coincide. Linear, which preserves premultiplication.
pub(super) fn resize(values: Vec<f32>, channels: usize, from: (u32, u32), to: (u32, u32)) -> Vec<f32> {
    fn resample<P>(values: Vec<f32>, from: (u32, u32), to: (u32, u32)) -> Vec<f32>
    where
        P: image::Pixel<Subpixel = f32> + 'static,
    {
        let picture = ImageBuffer::<P, _>::from_raw(from.0, from.1, values);
        picture.map_or(Vec::new(), |p| resize_picture(&p, to.0, to.1, FilterType::Triangle).into_raw())
    }
    if from == to {
        return values;
    }
    assert_eq!(values.len(), channels * from.0 as usize * from.1 as usize, "resize: values of {from:?}");
    if channels == 1 { resample::<Luma<f32>>(values, from, to) } else { resample::<Rgb<f32>>(values, from, to) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Directory;

    #[test]
    fn what_is_written_is_read_back_to_the_nearest_level() {
        let dir = Directory::new("round");
        let path = dir.file("a.png");
        let mut picture = Image::new(5, 3);
        for (i, p) in picture.pixels.iter_mut().enumerate() {
            *p = i as f32 / 44.0;
        }
        picture.save_png(&path).unwrap();
        let back = Image::load(&path).unwrap();
        assert_eq!((back.width, back.height), (5, 3));
        for (a, b) in picture.pixels.iter().zip(&back.pixels) {
            assert!((a - b).abs() <= 0.5 / 255.0 + 1e-6, "{a} {b}");
        }
        back.save_png(&path).unwrap();
        assert_eq!(Image::load(&path).unwrap(), back, "levels are kept exactly");
    }

    #[test]
    fn resizing_keeps_ramps_and_means() {
        // 12 × 8 to 6 × 4: a ramp across the columns, inside the border that the tent leaves.
        let ramp: Vec<f32> = (0..96).map(|i| (i % 12) as f32 / 16.0).collect();
        let small = resize(ramp.clone(), 1, (12, 8), (6, 4));
        for (i, value) in small.iter().enumerate().filter(|(i, _)| (1..5).contains(&(i % 6))) {
            // Column c of the small picture is centred at 2c + 1 − 0.5 of the large one's indices.
            let expected = (2.0 * (i % 6) as f32 + 0.5) / 16.0;
            assert!((value - expected).abs() < 1e-6, "{i}: {value} {expected}");
        }
        let colour: Vec<f32> = ramp.iter().flat_map(|&r| [r, 0.5, 1.0 - r]).collect();
        let both = resize(colour, 3, (12, 8), (6, 4));
        for (pixel, value) in both.chunks(3).zip(&small) {
            assert!((pixel[0] - value).abs() < 1e-6 && (pixel[1] - 0.5).abs() < 1e-6);
        }
        assert_eq!(resize(ramp.clone(), 1, (12, 8), (12, 8)), ramp);
        let stripes: Vec<f32> = (0..96).map(|i| (i % 2) as f32).collect();
        // Every second column lit: an unfiltered reduction would give all or nothing.
        assert!(resize(stripes, 1, (12, 8), (6, 4)).iter().all(|v| (0.3..0.7).contains(v)));
    }

    #[test]
    fn values_outside_the_range_are_clamped() {
        assert_eq!([-1.0, 0.0, 0.5, 1.0, 7.0, f32::NAN].map(to_byte), [0, 0, 128, 255, 255, 0]);
    }

    #[test]
    fn a_header_of_absurd_size_is_refused_before_decoding() {
        let mut header = Vec::new();
        let mut encoder = png::Encoder::new(&mut header, 100_000, 100_000);
        encoder.set_color(png::ColorType::Rgb);
        drop(encoder.write_header().unwrap());
        // Signature and IHDR, then no data at all.
        header.truncate(33);
        header.extend(b"\0\0\0\0IDAT\x35\xaf\x06\x1e");
        let dir = Directory::new("absurd");
        let path = dir.file("a.png");
        dir.write("a.png", header);
        let message = Image::load(&path).unwrap_err().to_string();
        assert!(message.contains("100000×100000") && message.contains("8192"), "{message}");
    }

    /// A JPEG with an orientation, 1 to 8, in Exif data.
    fn oriented(picture: &image::RgbImage, orientation: u8) -> Vec<u8> {
        let mut jpeg = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 100).encode_image(picture).unwrap();
        let mut exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
        exif.extend([orientation, 0, 0, 0, 0, 0, 0]);
        let mut segment = vec![0xFF, 0xE1];
        segment.extend((exif.len() as u16 + 2).to_be_bytes());
        segment.extend(exif);
        jpeg.splice(2..2, segment);
        jpeg
    }

    #[test]
    fn pictures_of_every_orientation_stand_upright() {
        let dir = Directory::new("upright");
        // Blocks of eight pixels, which JPEG keeps apart: red, green, blue, white, black, yellow.
        let colors = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255; 3], [0; 3], [255, 255, 0]];
        let upright = image::RgbImage::from_fn(24, 16, |x, y| image::Rgb(colors[(x / 8 + 3 * (y / 8)) as usize]));
        // How a camera that is held so stores the upright picture: (column, row) of a stored pixel.
        type Stored = fn(u32, u32) -> (u32, u32);
        let stored: [(u32, u32, Stored); 8] = [
            (24, 16, |x, y| (x, y)),
            (24, 16, |x, y| (23 - x, y)),
            (24, 16, |x, y| (23 - x, 15 - y)),
            (24, 16, |x, y| (x, 15 - y)),
            (16, 24, |x, y| (y, x)),
            (16, 24, |x, y| (23 - y, x)),
            (16, 24, |x, y| (23 - y, 15 - x)),
            (16, 24, |x, y| (y, 15 - x)),
        ];
        for (i, (width, height, from)) in stored.into_iter().enumerate() {
            let turned = image::RgbImage::from_fn(width, height, |x, y| {
                let (x, y) = from(x, y);
                *upright.get_pixel(x, y)
            });
            let path = dir.file(&format!("{i}.jpg"));
            std::fs::write(&path, oriented(&turned, i as u8 + 1)).unwrap();
            assert_eq!(dimensions(&path).unwrap(), (24, 16), "{}", i + 1);
            let read = Image::load(&path).unwrap();
            for (x, y, color) in upright.enumerate_pixels().filter(|(x, y, _)| x % 8 == 4 && y % 8 == 4) {
                let difference = [0, 1, 2].map(|c| (read.rgb(x, y)[c] - f32::from(color[c]) / 255.0).abs());
                assert!(difference.iter().all(|d| *d < 0.2), "{} ({x}, {y}): {difference:?}", i + 1);
            }
            assert_eq!(load_mask(&path).unwrap().0, 24);
        }
    }

    #[test]
    fn jpeg_and_grey_and_16_bit_are_read_and_rubbish_is_named() {
        let dir = Directory::new("kinds");
        let grey = image::GrayImage::from_pixel(4, 2, image::Luma([255]));
        grey.save(dir.file("grey.jpg")).unwrap();
        // The format is told by content, not by extension.
        std::fs::copy(dir.file("grey.jpg"), dir.file("really_a_jpeg.png")).unwrap();
        let deep = image::ImageBuffer::<image::Rgb<u16>, _>::from_pixel(4, 2, image::Rgb([65535u16; 3]));
        deep.save(dir.file("deep.png")).unwrap();
        for name in ["grey.jpg", "really_a_jpeg.png", "deep.png"] {
            let picture = Image::load(&dir.file(name)).unwrap();
            assert!(picture.pixels.iter().all(|p| *p > 0.99), "{name}");
            assert_eq!(load_mask(&dir.file(name)).unwrap().2.len(), 8);
        }
        dir.write("rubbish.png", b"not a picture");
        for name in ["rubbish.png", "none.png"] {
            let message = Image::load(&dir.file(name)).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
    }
}
