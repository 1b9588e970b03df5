//! What a frame shows, and changes to it.

use std::ops::Range;
use std::sync::Arc;

use glam::Vec3;

use super::Image;
use super::synth::noise::smooth_noise;

/// Pixels over which a ragged edge runs from one side to the other.
const RAGGED: f32 = 5.0;

/// A rectangle of pixels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Area {
    pub columns: Range<u32>,
    pub rows: Range<u32>,
}

impl Area {
    pub fn is_empty(&self) -> bool {
        self.columns.is_empty() || self.rows.is_empty()
    }

    /// Whether the pixel of this index is inside, in a picture of this width.
    pub fn contains(&self, pixel: usize, width: u32) -> bool {
        let pixel = pixel as u32;
        self.columns.contains(&(pixel % width)) && self.rows.contains(&(pixel / width))
    }
}

/// A frame's picture, mask and occluder.
#[derive(Clone, Debug, PartialEq)]
pub struct Pixels {
    /// Picture multiplied by `mask`: colours are premultiplied by coverage, and 0 where the mask is
    /// 0. Over a background B the picture is `image + (1 − mask) · B`.
    pub image: Image,
    /// Coverage of each pixel by the *visible* subject, 0 to 1, (H, W); above 0.5 the pixel counts
    /// as subject.
    pub mask: Vec<f32>,
    /// Pixels known to be covered by something in front of the subject, (H, W); `None` where nobody
    /// marked them.
    pub occluder: Option<Vec<bool>>,
}

impl Pixels {
    /// Lets nothing be seen in an area.
    fn hide(&mut self, area: &Area) {
        let width = self.image.width;
        let visible: Vec<f32> = (0..self.mask.len()).map(|p| if area.contains(p, width) { 0.0 } else { 1.0 }).collect();
        self.mask.iter_mut().zip(&visible).for_each(|(mask, seen)| *mask *= seen);
        self.image.multiply(&visible);
    }

    /// Grows or shrinks the mask by so many pixels along the axes, and the picture with it.
    fn grow(&mut self, pixels: i32) {
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

    /// What a photograph shows where the mask would be if it were larger by so many pixels, of those
    /// pixels that are `wanted`.
    pub(crate) fn beyond_mask(&self, photograph: &Image, by: u32, wanted: impl Fn(usize) -> bool) -> Vec<Seen> {
        let mut larger = self.clone();
        larger.grow(i32::try_from(by).unwrap_or(i32::MAX));
        let seen = |pixel: usize| {
            let coverage = larger.mask[pixel];
            let color = [0, 1, 2].map(|c| coverage * photograph.pixels[3 * pixel + c]);
            Seen { pixel: pixel as u32, coverage, color }
        };
        (0..self.mask.len()).filter(|&i| larger.mask[i] > self.mask[i] && wanted(i)).map(seen).collect()
    }

    fn show(&mut self, seen: &[Seen]) {
        for Seen { pixel, coverage, color } in seen {
            let i = *pixel as usize;
            self.mask[i] = *coverage;
            self.image.pixels[3 * i..3 * i + 3].copy_from_slice(color);
        }
    }

    /// Gives a pixel another coverage; what is added shows black.
    fn cover(&mut self, i: usize, coverage: f32) {
        if coverage < self.mask[i] {
            // The picture is premultiplied by the mask.
            let share = coverage / self.mask[i];
            self.image.pixels[3 * i..3 * i + 3].iter_mut().for_each(|c| *c *= share);
        }
        self.mask[i] = coverage;
    }

    /// Moves the edge of the mask to and fro by up to so many pixels, in other places for each
    /// `frame`.
    fn fray(&mut self, pixels: f32, frame: u64) {
        let (old, width, height) = (self.mask.clone(), self.image.width as usize, self.image.height as usize);
        for i in 0..old.len() {
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            let wave = |part: f32| {
                // Frames far from each other in noise have nothing to do with each other.
                let at = Vec3::new(x / RAGGED, y / RAGGED, 10.0 * (frame % 100_000) as f32 + 5.0 * part);
                (pixels * (2.0 * smooth_noise(at) - 1.0)).round()
            };
            let inside = |c: f32, side: usize| c.clamp(0.0, side as f32 - 1.0) as usize;
            let from = inside(y + wave(1.0), height) * width + inside(x + wave(0.0), width);
            self.cover(i, old[from]);
        }
    }
}

/// A change of pixels that can be made whenever they are decoded.
#[derive(Clone, Debug)]
pub(super) enum Edit {
    /// Something stands before these pixels.
    Hide(Area),
    /// The mask is larger, or smaller, by so many pixels.
    Grow(i32),
    /// The edge of the mask goes to and fro by up to so many pixels, as the number decides.
    Fray(f32, u64),
    /// The subject is seen at these pixels, too.
    Show(Arc<[Seen]>),
}

/// A pixel that a mask leaves out and a photograph has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    pixel: u32,
    coverage: f32,
    /// Multiplied by the coverage.
    color: [f32; 3],
}

impl Edit {
    pub fn apply(&self, pixels: &mut Pixels) {
        match self {
            Self::Hide(area) => pixels.hide(area),
            Self::Grow(by) => pixels.grow(*by),
            Self::Fray(by, frame) => pixels.fray(*by, *frame),
            Self::Show(seen) => pixels.show(seen),
        }
    }
}
