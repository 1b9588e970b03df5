//! A training frame, cut to the subject and reduced to what registration needs to see.

use glam::{Vec2, Vec3};
use smpl::Posed;
use volrender::Camera;

use crate::capture::{CaptureError, Frame};

/// Height of the subject in a reduced picture, pixels: an outline found to a tenth of its pixels is
/// finer than what is known of any body's surface.
const HEIGHT: f32 = 240.0;
/// Share of the subject's height by which a picture reaches beyond the posed prior.
const BORDER: f32 = 0.15;
/// Largest side of a reduced picture.
const LARGEST: u32 = 1024;

/// The subject in a frame, and what is known to stand in front.
pub(super) struct Picture {
    pub camera: Camera,
    /// Colour, premultiplied by coverage, and coverage, 0 to 255, (H, W).
    pixels: Vec<[u8; 4]>,
    pub occluder: Option<Vec<bool>>,
}

/// Colours of a picture, blurred: premultiplied by coverage, and coverage, (H, W).
pub(super) struct Blurred {
    width: usize,
    pixels: Vec<[f32; 4]>,
}

/// A colour and its derivatives along the image's axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Look {
    pub color: Vec3,
    pub dx: Vec3,
    pub dy: Vec3,
}

impl Picture {
    /// Cuts and reduces a frame around `posed`; `None` where that is outside the picture.
    pub fn new(frame: &Frame, posed: &Posed) -> Result<Option<Self>, CaptureError> {
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for p in posed.vertices.iter().filter_map(|&v| frame.camera.project(v)) {
            (low, high) = (low.min(p.truncate()), high.max(p.truncate()));
        }
        let size = Vec2::new(frame.camera.width as f32, frame.camera.height as f32);
        let border = BORDER * (high.y - low.y);
        let factor = ((high.y - low.y).min(size.y) / HEIGHT).round().max(1.0) as u32;
        let (low, high) = ((low - border).clamp(Vec2::ZERO, size), (high + border).clamp(Vec2::ZERO, size));
        // False for NaN.
        if !(low.x < high.x && low.y < high.y) {
            return Ok(None);
        }
        let (x0, y0) = (low.x as u32, low.y as u32);
        let reduced = |low: u32, high: f32| (high.ceil() as u32 - low).div_ceil(factor).clamp(1, LARGEST);
        let (width, height) = (reduced(x0, high.x), reduced(y0, high.y));
        let shown = frame.pixels()?;
        let across = frame.camera.width;
        // Pixels of the frame that one of the reduced picture stands for.
        let block = |i: u32| {
            let (left, top) = (x0 + i % width * factor, y0 + i / width * factor);
            let rows = top..(top + factor).min(frame.camera.height);
            rows.flat_map(move |y| (left..(left + factor).min(across)).map(move |x| (y * across + x) as usize))
        };
        let share = 255.0 / (factor * factor) as f32;
        let mean = |i: u32| {
            let mut sum = [0.0f32; 4];
            for p in block(i) {
                // Nothing is known of other pixels: something may stand in front.
                if shown.mask[p] > 0.5 {
                    sum[3] += shown.mask[p];
                    (0..3).for_each(|c| sum[c] += shown.image.pixels[3 * p + c]);
                }
            }
            sum.map(|sum| (share * sum).round() as u8)
        };
        let covered = |known: &Vec<bool>| (0..width * height).map(|i| block(i).any(|p| known[p])).collect();
        let mut camera = Camera { width, height, ..frame.camera };
        camera.focal /= factor as f32;
        camera.centre = (camera.centre - Vec2::new(x0 as f32, y0 as f32)) / factor as f32;
        let pixels = (0..width * height).map(mean).collect();
        Ok(Some(Self { camera, pixels, occluder: shown.occluder.as_ref().map(covered) }))
    }

    /// Coverage of every pixel, 0 to 1.
    pub fn coverage(&self) -> Vec<f32> {
        self.pixels.iter().map(|p| f32::from(p[3]) / 255.0).collect()
    }

    /// The pixel that a point of the image falls into.
    pub fn pixel(&self, at: Vec2) -> Option<usize> {
        let (width, height) = (self.camera.width as f32, self.camera.height as f32);
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < width && at.y < height;
        inside.then(|| at.y as usize * self.camera.width as usize + at.x as usize)
    }

    /// Coverage between pixel centres; `None` beyond them.
    pub fn between(&self, at: Vec2) -> Option<f32> {
        let (corners, share) = corners(at, self.camera.width as usize, self.camera.height as usize)?;
        let [a, b, c, d] = corners.map(|i| f32::from(self.pixels[i][3]) / 255.0);
        let (top, bottom) = (a + share.x * (b - a), c + share.x * (d - c));
        Some(top + share.y * (bottom - top))
    }

    /// The picture under a Gaussian of this standard deviation, pixels.
    pub fn blurred(&self, sigma: f32) -> Blurred {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let radius = (2.5 * sigma).ceil() as usize;
        let weight = |k: usize| (-0.5 * ((k as f32 - radius as f32) / sigma).powi(2)).exp();
        let total: f32 = (0..=2 * radius).map(weight).sum();
        let kernel: Vec<f32> = (0..=2 * radius).map(|k| weight(k) / total).collect();
        // Beyond the picture there is nothing.
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
    /// The subject's colour between pixel centres; `None` beyond them, and where it does not cover
    /// `least` of every pixel around.
    pub fn look(&self, at: Vec2, least: f32) -> Option<Look> {
        let (corners, share) = corners(at, self.width, self.pixels.len() / self.width.max(1))?;
        let corners = corners.map(|i| self.pixels[i]);
        if corners.iter().any(|c| c[3] < least) {
            return None;
        }
        let [a, b, c, d] = corners.map(|c| Vec3::new(c[0], c[1], c[2]) / c[3]);
        let (top, bottom) = (a.lerp(b, share.x), c.lerp(d, share.x));
        Some(Look { color: top.lerp(bottom, share.y), dx: (b - a).lerp(d - c, share.y), dy: bottom - top })
    }
}

/// The four pixels whose centres lie around a point, row by row, and how far towards the last it is;
/// `None` beyond the centres.
fn corners(at: Vec2, width: usize, height: usize) -> Option<([usize; 4], Vec2)> {
    let at = at - 0.5;
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < width as f32 - 1.0 && at.y < height as f32 - 1.0) {
        return None;
    }
    let first = at.y as usize * width + at.x as usize;
    Some(([first, first + 1, first + width, first + width + 1], at.fract()))
}
