//! Pictures as a camera makes them and masks as a segmenter makes them: a backdrop, blur, exposure,
//! binary masks with pieces of the backdrop in them and feet cut off, a thing held in a hand.

use glam::{Vec2, Vec3};

use crate::film::noise::smooth_noise;
use capture::Pixels;

/// Standard deviation of the blur of all frames, pixels.
const BLUR: f32 = 0.6;
/// Interval of the frames blurred by motion, and length of the blur relative to the body's height.
const MOVING: u64 = 8;
const MOTION: f32 = 0.03;
/// Area of the backdrop's pieces relative to the mask's, and their farthest distance from it
/// relative to the body's height.
const PATCHES: f32 = 0.055;
const NEAR: f32 = 0.05;
/// Interval of the masks without a foot, and radius of the hole around its joint relative to the
/// body's height.
const LAME: u64 = 3;
const FOOT: f32 = 0.06;
/// Length and radius of the thing in the right hand, relative to the body's height, and interval of
/// the masks with it.
const HELD: [f32; 2] = [0.3, 0.012];
const HELD_IN_MASKS: u64 = 2;
/// Root mean square change of exposure.
const EXPOSURE: f32 = 0.04;

/// One training frame of a real video.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shot {
    pub frame: u64,
    /// Factor of the exposure.
    pub gain: f32,
    /// Height of the body, pixels.
    pub height: f32,
    /// Elbow and hand that holds something.
    pub hand: Option<(Vec2, Vec2)>,
    /// The foot that a mask may lack.
    pub foot: Option<Vec2>,
}

impl Shot {
    /// A frame, with a `light` of unit variance over frames.
    pub fn new(frame: u64, light: f32) -> Self {
        Self { frame, gain: 1.0 + EXPOSURE * light, height: 100.0, hand: None, foot: None }
    }

    /// Whether the thing in the hand covers a pixel.
    fn held(&self, at: Vec2) -> bool {
        self.hand.is_some_and(|(elbow, hand)| {
            let way = (hand - elbow).normalize_or_zero();
            let along = (at - hand).dot(way).clamp(0.0, HELD[0] * self.height);
            at.distance(hand + along * way) < HELD[1] * self.height
        })
    }

    /// The picture before the mask is applied.
    pub fn photograph(&self, pixels: &Pixels) -> Vec<Vec3> {
        let (width, shown) = (pixels.image.width as usize, pixels.image.pixels.as_chunks::<3>().0);
        let scene = (0..shown.len()).map(|i| {
            let at = Vec2::new((i % width) as f32, (i / width) as f32);
            let behind = (1.0 - pixels.mask[i]) * backdrop(at);
            if self.held(at + 0.5) { Vec3::new(0.75, 0.72, 0.2) } else { Vec3::from(shown[i]) + behind }
        });
        let mut photograph: Vec<Vec3> = scene.collect();
        let weight = |k: i32| (-0.5 * (k as f32 / BLUR).powi(2)).exp();
        for axis in [Vec2::X, Vec2::Y] {
            photograph = filtered(&photograph, width, &[-2, -1, 0, 1, 2].map(|k| (k as f32 * axis, weight(k))));
        }
        if self.frame % MOVING == MOVING / 2 {
            let way = MOTION * self.height * Vec2::from_angle(self.frame as f32);
            photograph =
                filtered(&photograph, width, &[-4, -3, -2, -1, 0, 1, 2, 3, 4].map(|k| (k as f32 / 8.0 * way, 1.0)));
        }
        photograph.iter().map(|color| (self.gain * *color).min(Vec3::ONE)).collect()
    }

    /// Makes the mask a segmenter's, and the picture the `photograph` under it.
    pub fn segment(&self, pixels: &mut Pixels, photograph: &[Vec3]) {
        let width = pixels.image.width as usize;
        let place = |i: usize| Vec2::new((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
        for mask in &mut pixels.mask {
            *mask = f32::from(*mask > 0.5);
        }
        let area = pixels.mask.iter().sum::<f32>();
        let mut near = pixels.clone();
        near.grow((NEAR * self.height) as i32);
        // Pieces of the backdrop stay for some frames.
        let wave = |i: usize| smooth_noise((12.0 / self.height * place(i)).extend(0.15 * self.frame as f32));
        let mut pieces: Vec<(f32, usize)> =
            (0..near.mask.len()).filter(|&i| near.mask[i] > pixels.mask[i]).map(|i| (wave(i), i)).collect();
        pieces.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        pieces.iter().take((PATCHES * area) as usize).for_each(|&(_, i)| pixels.mask[i] = 1.0);
        for i in 0..pixels.mask.len() {
            if self.frame.is_multiple_of(HELD_IN_MASKS) && self.held(place(i)) {
                pixels.mask[i] = 1.0;
            }
            let is_foot = |foot: Vec2| foot.distance(place(i)) < FOOT * self.height;
            if self.frame.is_multiple_of(LAME) && self.foot.is_some_and(is_foot) {
                pixels.mask[i] = 0.0;
            }
            let color = pixels.mask[i] * photograph[i];
            pixels.image.pixels[3 * i..3 * i + 3].copy_from_slice(&color.to_array());
        }
    }
}

/// A wall of three scales.
fn backdrop(at: Vec2) -> Vec3 {
    let wave = |size: f32, part: f32| smooth_noise((at / size).extend(part));
    let grain = 0.4 * wave(3.0, 7.5) + 0.6 * wave(11.0, 8.5);
    (0.4 + 0.6 * grain) * Vec3::new(wave(40.0, 1.5), wave(40.0, 2.5), wave(40.0, 3.5))
}

/// The weighted mean of a picture moved by each offset, pixels.
fn filtered(picture: &[Vec3], width: usize, taps: &[(Vec2, f32)]) -> Vec<Vec3> {
    let height = picture.len() / width.max(1);
    let total: f32 = taps.iter().map(|tap| tap.1).sum();
    let at = |i: usize, by: Vec2| {
        let inside = |c: f32, side: usize| c.round().clamp(0.0, side as f32 - 1.0) as usize;
        picture[inside((i / width) as f32 + by.y, height) * width + inside((i % width) as f32 + by.x, width)]
    };
    (0..picture.len()).map(|i| taps.iter().map(|&(by, weight)| weight / total * at(i, by)).sum()).collect()
}

/// Wavelength of ragged mask edges, pixels.
const RAGGED: f32 = 5.0;

/// Displaces the edge of the mask by up to `by` pixels of smooth noise, independent for each
/// `frame`.
pub(crate) fn fray(pixels: &mut Pixels, by: f32, frame: u64) {
    let (old, width, height) = (pixels.mask.clone(), pixels.image.width as usize, pixels.image.height as usize);
    for i in 0..old.len() {
        let (x, y) = ((i % width) as f32, (i / width) as f32);
        let wave = |part: f32| {
            // Noise at distant points is independent.
            let at = Vec3::new(x / RAGGED, y / RAGGED, 10.0 * (frame % 100_000) as f32 + 5.0 * part);
            (by * (2.0 * smooth_noise(at) - 1.0)).round()
        };
        let inside = |c: f32, side: usize| c.clamp(0.0, side as f32 - 1.0) as usize;
        let from = inside(y + wave(1.0), height) * width + inside(x + wave(0.0), width);
        pixels.cover(i, old[from]);
    }
}
