//! The decoded pixels of a frame.

use super::Image;
use std::ops::Range;

/// A rectangle of pixels.
///
/// ```
/// let area = capture::Area { columns: 1..3, rows: 0..1 };
/// assert!(area.contains(2, 4) && !area.contains(4 + 2, 4) && !area.is_empty());
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Area {
    /// Columns.
    pub columns: Range<u32>,
    /// Rows.
    pub rows: Range<u32>,
}

impl Area {
    /// Whether it holds no pixel.
    pub fn is_empty(&self) -> bool {
        self.columns.is_empty() || self.rows.is_empty()
    }

    /// Whether it holds the pixel of this index in a picture of this width.
    pub fn contains(&self, pixel: usize, width: u32) -> bool {
        let pixel = pixel as u32;
        self.columns.contains(&(pixel % width)) && self.rows.contains(&(pixel / width))
    }
}

/// A frame's picture, mask and occluder.
///
/// ```
/// use capture::{Area, Image, PackedPixels, Pixels};
///
/// let image = Image { width: 2, height: 1, pixels: vec![0.5; 6] };
/// let mut pixels = Pixels { image, mask: vec![1.0; 2], occluder: None };
/// pixels.hide(&Area { columns: 0..1, rows: 0..1 });
/// assert_eq!((pixels.image.rgb(0, 0), &pixels.mask[..]), ([0.0; 3], &[0.0, 1.0][..]));
/// assert_eq!(PackedPixels::new(&pixels).pixels(), pixels);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Pixels {
    /// Picture multiplied by `mask`: colours are premultiplied by coverage, and 0 where the mask is
    /// 0. Over a background B the picture is `image + (1 − mask) · B`.
    pub image: Image,
    /// Coverage of each pixel by the *visible* subject, 0 to 1, (H, W); above 0.5 the pixel counts
    /// as subject.
    pub mask: Vec<f32>,
    /// Known occluder pixels, (H, W); `None` where unknown.
    pub occluder: Option<Vec<bool>>,
}

impl Pixels {
    /// Masks an area.
    pub fn hide(&mut self, area: &Area) {
        let width = self.image.width;
        let visible: Vec<f32> = (0..self.mask.len()).map(|p| if area.contains(p, width) { 0.0 } else { 1.0 }).collect();
        self.mask.iter_mut().zip(&visible).for_each(|(mask, seen)| *mask *= seen);
        self.image.multiply(&visible);
    }

    /// Dilates the mask by `pixels` along the axes (erodes it where negative), and the picture with
    /// it; added pixels are black.
    pub fn grow(&mut self, pixels: i32) {
        let (width, height) = (self.image.width as usize, self.image.height as usize);
        for _ in 0..pixels.unsigned_abs() {
            let old = self.mask.clone();
            for i in 0..old.len() {
                let (x, y) = (i % width, i / width);
                let around = [
                    (x > 0).then(|| i - 1),
                    (x + 1 < width).then(|| i + 1),
                    (y > 0).then(|| i - width),
                    (y + 1 < height).then(|| i + width),
                ];
                let values = around.into_iter().flatten().map(|j| old[j]);
                let new = if pixels > 0 { values.fold(old[i], f32::max) } else { values.fold(old[i], f32::min) };
                self.cover(i, new);
            }
        }
    }

    /// The photograph's pixels that dilating the mask by `by` pixels would add, where `wanted`.
    pub fn beyond_mask(&self, photograph: &Image, by: u32, wanted: impl Fn(usize) -> bool) -> Vec<MaskedPixel> {
        let mut larger = self.clone();
        larger.grow(i32::try_from(by).unwrap_or(i32::MAX));
        let masked = |pixel: usize| {
            let coverage = larger.mask[pixel];
            let color = [0, 1, 2].map(|c| coverage * photograph.pixels[3 * pixel + c]);
            MaskedPixel { pixel: pixel as u32, coverage, color }
        };
        (0..self.mask.len()).filter(|&i| larger.mask[i] > self.mask[i] && wanted(i)).map(masked).collect()
    }

    /// Adds pixels to the mask and the picture.
    pub fn show(&mut self, added: &[MaskedPixel]) {
        for MaskedPixel { pixel, coverage, color } in added {
            let i = *pixel as usize;
            self.mask[i] = *coverage;
            self.image.pixels[3 * i..3 * i + 3].copy_from_slice(color);
        }
    }

    /// Sets the coverage of a pixel; added coverage is black.
    pub fn cover(&mut self, i: usize, coverage: f32) {
        if coverage < self.mask[i] {
            // The picture is premultiplied by the mask.
            let share = coverage / self.mask[i];
            self.image.pixels[3 * i..3 * i + 3].iter_mut().for_each(|c| *c *= share);
        }
        self.mask[i] = coverage;
    }
}

/// A photographed pixel with its coverage.
#[derive(Clone, Copy, Debug)]
pub struct MaskedPixel {
    pixel: u32,
    coverage: f32,
    /// Premultiplied by the coverage.
    color: [f32; 3],
}
