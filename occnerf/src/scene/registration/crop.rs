//! A training frame, cropped to the subject and downsampled.

use glam::{Vec2, Vec3};
use volrender::Camera;

use crate::capture::Pixels;

/// Height of the subject in a crop, pixels: a tenth of one is below the accuracy of a body's
/// surface.
const HEIGHT: f32 = 240.0;
/// Margin around the posed prior, in multiples of the subject's height.
const BORDER: f32 = 0.15;
/// Largest side of a crop.
const LARGEST: u32 = 1024;

/// The subject in a frame, and the known occluder.
pub(crate) struct Crop {
    pub camera: Camera,
    /// Premultiplied colour and coverage of pixels over one half, 0 to 255, (H, W).
    pixels: Vec<[u8; 4]>,
    /// Coverage of all pixels, 0 to 255, (H, W): antialiased edges.
    coverage: Vec<u8>,
    pub occluder: Option<Vec<bool>>,
}

/// A blurred crop: premultiplied colour and coverage, (H, W).
pub(crate) struct Blurred {
    width: usize,
    pixels: Vec<[f32; 4]>,
}

/// A colour and its image derivatives.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ColorSample {
    pub color: Vec3,
    pub dx: Vec3,
    pub dy: Vec3,
}

impl Crop {
    /// Crops the picture of `given` to a body's `vertices`; `None` where they are outside it.
    pub fn new(given: &Camera, shown: &Pixels, vertices: &[Vec3]) -> Option<Self> {
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for p in vertices.iter().filter_map(|&v| given.project(v)) {
            (low, high) = (low.min(p.truncate()), high.max(p.truncate()));
        }
        let size = Vec2::new(given.width as f32, given.height as f32);
        let border = BORDER * (high.y - low.y);
        let factor = ((high.y - low.y).min(size.y) / HEIGHT).round().max(1.0) as u32;
        let (low, high) = ((low - border).clamp(Vec2::ZERO, size), (high + border).clamp(Vec2::ZERO, size));
        // False for NaN.
        if !(low.x < high.x && low.y < high.y) {
            return None;
        }
        let (x0, y0) = (low.x as u32, low.y as u32);
        let reduced = |low: u32, high: f32| (high.ceil() as u32 - low).div_ceil(factor).clamp(1, LARGEST);
        let (width, height) = (reduced(x0, high.x), reduced(y0, high.y));
        let across = given.width;
        // Pixels of the frame under one pixel of the crop.
        let block = |i: u32| {
            let (left, top) = (x0 + i % width * factor, y0 + i / width * factor);
            let rows = top..(top + factor).min(given.height);
            rows.flat_map(move |y| (left..(left + factor).min(across)).map(move |x| (y * across + x) as usize))
        };
        let share = 255.0 / (factor * factor) as f32;
        let mean = |i: u32| {
            let mut sum = [0.0f32; 4];
            // Pixels outside the mask may show an occluder.
            for p in block(i).filter(|&p| shown.mask[p] > 0.5) {
                sum[3] += shown.mask[p];
                (0..3).for_each(|c| sum[c] += shown.image.pixels[3 * p + c]);
            }
            sum.map(|sum| (share * sum).round() as u8)
        };
        let coverage = |i: u32| (share * block(i).map(|p| shown.mask[p]).sum::<f32>()).round() as u8;
        let covered = |known: &Vec<bool>| (0..width * height).map(|i| block(i).any(|p| known[p])).collect();
        let mut camera = Camera { width, height, ..*given };
        camera.focal /= factor as f32;
        camera.centre = (camera.centre - Vec2::new(x0 as f32, y0 as f32)) / factor as f32;
        let (pixels, coverage) = (0..width * height).map(|i| (mean(i), coverage(i))).unzip();
        Some(Self { camera, pixels, coverage, occluder: shown.occluder.as_ref().map(covered) })
    }

    /// Coverage of every pixel, 0 to 1.
    pub fn coverage(&self) -> Vec<f32> {
        self.coverage.iter().map(|&c| f32::from(c) / 255.0).collect()
    }

    /// Index of the pixel at an image point; `None` outside.
    pub fn pixel(&self, at: Vec2) -> Option<usize> {
        let (width, height) = (self.camera.width as f32, self.camera.height as f32);
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < width && at.y < height;
        inside.then(|| at.y as usize * self.camera.width as usize + at.x as usize)
    }

    /// Coverage, interpolated bilinearly; `None` beyond the outermost pixel centres.
    pub fn coverage_at(&self, at: Vec2) -> Option<f32> {
        interpolated(|i| f32::from(self.coverage[i]) / 255.0, at, &self.camera)
    }

    /// The crop under a Gaussian blur with standard deviation `sigma`, pixels; black and empty beyond
    /// its border.
    pub fn blurred(&self, sigma: f32) -> Blurred {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let radius = (2.5 * sigma).ceil() as usize;
        let weight = |k: usize| (-0.5 * ((k as f32 - radius as f32) / sigma).powi(2)).exp();
        let total: f32 = (0..=2 * radius).map(weight).sum();
        let kernel: Vec<f32> = (0..=2 * radius).map(|k| weight(k) / total).collect();
        let along = |from: &[[f32; 4]], length: usize, stride: usize| -> Vec<[f32; 4]> {
            let at = |i: usize| {
                let place = i / stride % length;
                let mut sum = [0.0f32; 4];
                for (k, weight) in kernel.iter().enumerate() {
                    let moved = place + k;
                    if moved >= radius && moved - radius < length {
                        let value = &from[i + moved * stride - (radius + place) * stride];
                        sum.iter_mut().zip(value).for_each(|(sum, value)| *sum += weight * value);
                    }
                }
                sum
            };
            (0..from.len()).map(at).collect()
        };
        let pixels: Vec<[f32; 4]> = self.pixels.iter().map(|p| p.map(|v| f32::from(v) / 255.0)).collect();
        Blurred { width, pixels: along(&along(&pixels, width, 1), height, width) }
    }
}

impl Blurred {
    /// The subject's colour, interpolated bilinearly; `None` beyond the outermost pixel centres, and
    /// where the coverage of one of the four pixels is below `least`.
    pub fn sample(&self, at: Vec2, least: f32) -> Option<ColorSample> {
        let (corners, share) = corners(at, self.width, self.pixels.len() / self.width.max(1))?;
        let corners = corners.map(|i| self.pixels[i]);
        if corners.iter().any(|c| c[3] < least) {
            return None;
        }
        let [a, b, c, d] = corners.map(|c| Vec3::new(c[0], c[1], c[2]) / c[3]);
        let (top, bottom) = (a.lerp(b, share.x), c.lerp(d, share.x));
        Some(ColorSample { color: top.lerp(bottom, share.y), dx: (b - a).lerp(d - c, share.y), dy: bottom - top })
    }
}

/// Values of pixels, interpolated bilinearly; `None` beyond the outermost pixel centres.
pub(crate) fn interpolated(value: impl Fn(usize) -> f32, at: Vec2, camera: &Camera) -> Option<f32> {
    let (corners, share) = corners(at, camera.width as usize, camera.height as usize)?;
    let [a, b, c, d] = corners.map(value);
    let (top, bottom) = (a + share.x * (b - a), c + share.x * (d - c));
    Some(top + share.y * (bottom - top))
}

/// The four pixels around a point, row by row, and its fractional offset from the first centre;
/// `None` beyond the centres.
fn corners(at: Vec2, width: usize, height: usize) -> Option<([usize; 4], Vec2)> {
    let at = at - 0.5;
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < width as f32 - 1.0 && at.y < height as f32 - 1.0) {
        return None;
    }
    let first = at.y as usize * width + at.x as usize;
    Some(([first, first + 1, first + width, first + width + 1], at.fract()))
}
