//! Texture optimisation: the atlas fitted to the training frames through the rasteriser.
//!
//! Frames of a moving person that are registered to a few pixels leave streaks in a least-squares
//! texture: noise, which differs between halves of the frames, where detail is the same. The
//! correlation r of a detail between the halves gives the Wiener gain of the whole, 2 r / (1 + r),
//! as Fourier ring correlation does for images of electron microscopes.

use std::ops::{Add, Mul};

use glam::{UVec2, Vec2, Vec3};
use rayon::prelude::*;
use visibility::{Pixel, RasterOptions, Rasterizer, Samples};

use super::avatar::{Atlas, Avatar};
use super::draw::{BakedRenderer, BilinearCorner, color, look};
use crate::Error;
use crate::capture::Light;
use crate::model::view::pinhole;
use crate::scene::colors::GRAZING;
use crate::scene::hands::{HandPixels, is_arm};
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::scene::registration::{deviation, robust};
use crate::scene::reliability::Reliability;
use crate::scene::seen::depth_inside;

/// Regularisation of a texel towards its colour before, in pixels.
const PRIOR: f32 = 0.3;

/// Parts of the video, which belong to one half of the frames and the other in turn: neighbouring
/// frames have the same errors of registration.
const BLOCKS: usize = 32;

/// Least weight of a texel in either half for their agreement, in pixels.
const EVIDENCE: f32 = 0.05;

/// Most sampled training pixels.
const MAX_PIXELS: usize = 1 << 19;

/// A bilinear lookup: four texels and their weights.
type Lookup = ([u32; 4], [f32; 4]);

/// A photographed pixel as a linear function of the texels.
pub(super) struct PixelEquation {
    colour: Vec3,
    lookups: Vec<Lookup>,
    /// Weight, at most 1.
    trust: f32,
}

impl PixelEquation {
    /// Texels and their weights.
    fn texels(&self) -> impl Iterator<Item = (usize, f32)> {
        self.lookups.iter().flat_map(|(at, weights)| at.iter().map(|&i| i as usize).zip(*weights))
    }

    fn residual(&self, values: &[Vec3]) -> Vec3 {
        self.colour - self.texels().map(|(i, weight)| weight * values[i]).sum::<Vec3>()
    }
}

/// Fits the colours of the texels to the known pixels of the training frames by `passes` Jacobi
/// steps of regularised least squares; unobserved texels keep their colours. Returns the mean
/// squared error before the first step and before the last.
pub(super) fn refine(scene: &Scene, light: Light, avatar: &mut Avatar, passes: u32) -> Result<[f64; 2], Error> {
    let frames = &scene.train;
    let stride = frames.iter().map(|f| f.labels.num_subject()).sum::<usize>().div_ceil(MAX_PIXELS).max(1);
    let mut renderer = BakedRenderer::new(avatar, scene.body.scale, light, Samples::Four);
    let (_, reliability, hands) = scene.lighting()?;
    let arms: Vec<bool> = (avatar.joints.iter().zip(&avatar.weights))
        .map(|(joints, weights)| is_arm(joints.iter().map(|&joint| usize::from(joint)).zip(*weights)))
        .collect();
    let (blocks, mut halves) = (BLOCKS.min(frames.len()), [Vec::new(), Vec::new()]);
    for (f, frame) in frames.iter().enumerate() {
        let half = &mut halves[f * blocks / frames.len() % 2];
        let hands = hands.as_ref().map(|color| (color.in_frame(&scene.body.model, &frame.view), &arms[..]));
        half.extend(equations(avatar, &mut renderer, frame, stride, (reliability, hands))?);
    }
    let Atlas { rgb, width, .. } = &mut avatar.atlas;
    let mut values: Vec<Vec3> = rgb.as_chunks::<3>().0.iter().copied().map(color).collect();
    let errors = solve(&mut values, halves, *width as usize, passes, reliability.disagreement);
    for (texel, value) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(&values) {
        *texel = value.clamp(Vec3::ZERO, Vec3::ONE).to_array().map(|x| (x * 255.0 + 0.5) as u8);
    }
    Ok(errors)
}

/// Jacobi steps on the texels' `values` (H · W) for the equations of two halves of the frames,
/// whose details count as far as the halves agree. Residuals are weighted robustly by the share of
/// `disagreement` of the frames.
fn solve(
    values: &mut Vec<Vec3>,
    halves: [Vec<PixelEquation>; 2],
    width: usize,
    passes: u32,
    disagreement: f32,
) -> [f64; 2] {
    let [first, second] = &halves;
    let estimate = |equations: &[&[PixelEquation]]| jacobi(values, equations, passes, disagreement);
    let (whole, (a, b)) =
        rayon::join(|| estimate(&[first, second]), || rayon::join(|| estimate(&[first]), || estimate(&[second])));
    let shown = Shown::new(width, [&a.weights, &b.weights], EVIDENCE);
    let update = |estimate: &Estimate| -> Vec<Vec3> {
        shown.texels.iter().map(|&i| estimate.values[i as usize] - values[i as usize]).collect()
    };
    let shrunk = shown.shrunk(&update(&whole), [&update(&a), &update(&b)]);
    let start = std::mem::replace(values, whole.values);
    shown.texels.iter().zip(shrunk).for_each(|(&i, update)| values[i as usize] = start[i as usize] + update);
    whole.errors
}

/// A texture fitted to frames.
struct Estimate {
    /// (H · W)
    values: Vec<Vec3>,
    /// Sum of the trusted weights of each texel.
    weights: Vec<f32>,
    /// Mean squared error before the first step and before the last.
    errors: [f64; 2],
}

/// Regularised least squares of the texels from `start` (H · W).
fn jacobi(start: &[Vec3], equations: &[&[PixelEquation]], passes: u32, disagreement: f32) -> Estimate {
    let all = || equations.iter().copied().flatten();
    let mut values = start.to_vec();
    let spread = deviation(all().map(|equation| equation.residual(start))).unwrap_or(0.0);
    let mut errors = [0.0; 2];
    let mut weights = vec![0.0f32; start.len()];
    for pass in 0..passes {
        let mut sums = vec![Vec3::ZERO; start.len()];
        weights.fill(0.0);
        let (mut error, mut count) = (0.0, 0usize);
        for equation in all() {
            let residual = equation.residual(&values);
            let squared = residual.length_squared();
            (error, count) = (error + f64::from(squared) / 3.0, count + 1);
            let doubt = 1.0 - robust(squared, 2.0 * spread.max(f32::MIN_POSITIVE));
            let trust = equation.trust * (1.0 - disagreement * doubt);
            for (i, weight) in equation.texels() {
                sums[i] += trust * weight * residual;
                weights[i] += trust * weight;
            }
        }
        errors[usize::from(pass > 0)] = error / count.max(1) as f64;
        for (((value, sum), weight), start) in values.iter_mut().zip(sums).zip(&weights).zip(start) {
            *value += (sum + PRIOR * (start - *value)) / (weight + PRIOR);
        }
    }
    Estimate { values, weights, errors }
}

/// Equations of the fully covered subject pixels of a frame on surface that does not graze; `hands`
/// has where it may show hands, and whether each vertex of the avatar (V) belongs to a forearm or
/// hand.
pub(super) fn equations(
    avatar: &Avatar,
    renderer: &mut BakedRenderer<'_>,
    frame: &PreparedFrame,
    stride: usize,
    (reliability, hands): (&Reliability, Option<(HandPixels<'_>, &[bool])>),
) -> Result<Vec<PixelEquation>, Error> {
    let pixels = frame.pixels()?;
    let across = frame.view.camera.width as usize;
    let subject = frame.labels.iter().enumerate().filter(|(_, label)| *label == Label::Subject);
    let (low, high) = subject.fold((UVec2::MAX, UVec2::ZERO), |(low, high), (i, _)| {
        let at = UVec2::new((i % across) as u32, (i / across) as u32);
        (low.min(at), high.max(at + 1))
    });
    if low.x >= high.x {
        return Ok(Vec::new());
    }
    // The box of the subject's pixels.
    let mut view = pinhole(&frame.view.camera);
    view.centre -= low.as_vec2();
    (view.width, view.height) = (high - low).into();
    let (vertices, looks) = renderer.skin(&frame.view.posed.bones);
    // Supersampled as by default, so that the texture compensates the pixel footprint.
    let options = RasterOptions { samples: Samples::Four, cull_back: true, near: 1e-3 };
    let depth = depth_inside(&pixels.mask, across);
    let eye = frame.view.camera.centre_of_projection();
    let cosine = |face: u32| {
        let [a, b, c] = avatar.faces[face as usize].map(|v| vertices[v as usize]);
        (b - a).cross(c - a).normalize_or_zero().dot((eye - a).normalize_or_zero())
    };
    let equation = |pixel: Pixel<'_>| {
        let (x, y) = (pixel.index % view.width as usize, pixel.index / view.width as usize);
        let i = (y + low.y as usize) * across + x + low.x as usize;
        // Edge pixels are mixed with the background.
        let wanted = i.is_multiple_of(stride) && frame.labels.at(i as u32) == Label::Subject && pixels.mask[i] >= 0.99;
        let count = pixel.samples.len();
        if !wanted || count == 0 || pixel.samples.contains(&None) {
            return None;
        }
        let fragments = || pixel.samples.iter().flatten();
        let color = Vec3::from_slice(&pixels.image.pixels[3 * i..]);
        let is_hand_beside = |(hands, arms): &(HandPixels<'_>, &[bool])| {
            let is_arm = |face: u32| arms[avatar.faces[face as usize][0] as usize];
            hands.may_show(i, color) && !fragments().any(|fragment| is_arm(fragment.face))
        };
        if hands.as_ref().is_some_and(is_hand_beside) {
            return None;
        }
        let share = 1.0 / count as f32;
        let brightness: f32 = fragments().map(|fragment| share * look(avatar, looks, fragment).z).sum();
        let lookups = fragments().map(|fragment| lookup(avatar, look(avatar, looks, fragment).truncate(), share));
        let colour = color / brightness;
        let slant: f32 = fragments().map(|fragment| share * cosine(fragment.face)).sum();
        if slant < GRAZING {
            return None;
        }
        Some(PixelEquation { colour, lookups: lookups.collect(), trust: reliability.at(depth[i], slant) })
    };
    let mut out: Vec<Option<PixelEquation>> = Vec::new();
    out.resize_with(view.width as usize * view.height as usize, || None);
    Rasterizer::default().draw(vertices, &avatar.faces, &view, &options, &mut out, equation)?;
    Ok(out.into_iter().flatten().collect())
}

/// The lookup at a `place` of the atlas, texels, with weights that sum to `share`.
fn lookup(avatar: &Avatar, place: Vec2, share: f32) -> Lookup {
    let corner = BilinearCorner::new(place, &avatar.atlas);
    let Vec2 { x, y } = corner.share;
    let weights = [(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y].map(|weight| share * weight);
    (corner.texels(&avatar.atlas).map(|i| i as u32), weights)
}

/// Bands of detail, from 1 texel, each twice as wide as the one before.
const BANDS: u32 = 4;
/// Passes of the filter over products of details, each twice as wide as the one before.
const WINDOW: u32 = 3;
/// No texel.
const NONE: u32 = u32::MAX;

/// The texels that both halves show.
struct Shown {
    /// Indices in the atlas, ascending.
    pub texels: Vec<u32>,
    /// Position in `texels` of each texel of the atlas, or [`NONE`].
    positions: Vec<u32>,
    width: usize,
}

impl Shown {
    /// Those of an atlas of this width whose weight in either half, (H · W), is at least `least`.
    pub fn new(width: usize, halves: [&[f32]; 2], least: f32) -> Self {
        let is_shown = |&i: &u32| halves.iter().all(|half| half[i as usize] >= least);
        let texels: Vec<u32> = (0..halves[0].len() as u32).filter(is_shown).collect();
        let mut positions = vec![NONE; halves[0].len()];
        texels.iter().zip(0..).for_each(|(&texel, position)| positions[texel as usize] = position);
        Self { texels, positions, width }
    }

    /// Binomial filter [1 2 1] / 4 of `values`, a shown texel each, along both axes, with taps
    /// `step` texels apart; a texel stands in for neighbours that are not shown.
    fn filter<T>(&self, values: &[T], step: usize) -> Vec<T>
    where
        T: Copy + Send + Sync + Add<Output = T> + Mul<f32, Output = T>,
    {
        let along = |values: &[T], stride: usize| -> Vec<T> {
            let near = |texel: Option<usize>, own: T| {
                let position = texel.and_then(|texel| self.positions.get(texel)).filter(|&&position| position != NONE);
                position.map_or(own, |&position| values[position as usize])
            };
            let filtered = |(&texel, &own): (&u32, &T)| {
                let (before, after) = ((texel as usize).checked_sub(stride), texel as usize + stride);
                own * 0.5 + (near(before, own) + near(Some(after), own)) * 0.25
            };
            self.texels.par_iter().zip(values).map(filtered).collect()
        };
        along(&along(values, step), step * self.width)
    }

    /// The `update` of the shown texels with each band of detail shrunk to what the updates of the
    /// `halves` share.
    pub fn shrunk(&self, update: &[Vec3], halves: [&[Vec3]; 2]) -> Vec<Vec3> {
        let mut rests = [update.to_vec(), halves[0].to_vec(), halves[1].to_vec()];
        let mut out = vec![Vec3::ZERO; update.len()];
        for band in 0..BANDS {
            let step = 1 << band;
            let details = rests.each_mut().map(|rest| {
                let low = self.filter(rest, step);
                let detail: Vec<Vec3> = rest.iter().zip(&low).map(|(value, low)| *value - *low).collect();
                *rest = low;
                detail
            });
            let [detail, a, b] = &details;
            let products = |(a, b): (&Vec3, &Vec3)| (a.dot(*b), 0.5 * (a.length_squared() + b.length_squared()));
            let (mut covariance, mut variance): (Vec<f32>, Vec<f32>) = a.iter().zip(b).map(products).unzip();
            for pass in 0..WINDOW {
                (covariance, variance) = (self.filter(&covariance, step << pass), self.filter(&variance, step << pass));
            }
            for (((out, detail), covariance), variance) in out.iter_mut().zip(detail).zip(covariance).zip(variance) {
                let r = (covariance / variance.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
                *out += 2.0 * r / (1.0 + r) * *detail;
            }
        }
        out.iter().zip(&rests[0]).map(|(details, rest)| *details + *rest).collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use volrender::RandomStream;

    use super::*;

    fn seen(texel: u32, colour: Vec3) -> PixelEquation {
        PixelEquation { colour, lookups: vec![([texel; 4], [0.25; 4])], trust: 1.0 }
    }

    proptest! {
        /// Frames that agree: the regularised mean in one step.
        #[test]
        fn a_texel_takes_the_mean_of_frames_that_agree(
            start in 0.2f32..0.8, off in prop::collection::vec(-1e-3f32..1e-3, 1..9),
        ) {
            let mut values = vec![Vec3::splat(start); 25];
            let all: Vec<PixelEquation> = off.iter().map(|off| seen(12, Vec3::splat(start + off))).collect();
            let errors = solve(&mut values, [all, Vec::new()], 5, 1, 0.0);
            let expected = start + off.iter().sum::<f32>() / (off.len() as f32 + PRIOR);
            prop_assert!((values[12].x - expected).abs() < 1e-5, "{} {expected}", values[12]);
            prop_assert!(errors[0] < 1e-5 && values.iter().enumerate().all(|(i, v)| i == 12 || v.x == start));
        }
    }

    /// Each frame shows streaks of its own.
    #[test]
    fn streaks_that_differ_between_frames_vanish() {
        const SIDE: usize = 48;
        let streaks = |f: usize| {
            let mut stream = RandomStream::new(&[f as u64]);
            let tone: Vec<f32> = (0..SIDE).map(|_| 0.5 + 0.1 * stream.normal()).collect();
            (0..SIDE * SIDE).map(move |i| seen(i as u32, Vec3::splat(tone[i % SIDE])))
        };
        let halves = [0, 1].map(|half| (0..4).flat_map(|f| streaks(2 * f + half)).collect::<Vec<_>>());
        let mut values = vec![Vec3::splat(0.5); SIDE * SIDE];
        let roughness =
            |values: &[Vec3]| (1..values.len()).map(|i| (values[i].x - values[i - 1].x).powi(2)).sum::<f32>();
        let least_squares = jacobi(&values, &[&halves[0], &halves[1]], 4, 0.0).values;
        solve(&mut values, halves, SIDE, 4, 0.0);
        assert!(roughness(&values) < 0.3 * roughness(&least_squares));
    }

    #[test]
    fn one_frame_of_background_is_outvoted_where_frames_disagree() {
        let noise = |texel: usize, frame: usize| 0.36 * (((7 * texel + 5 * frame) % 11) as f32 / 10.0 - 0.5);
        let mut all = Vec::new();
        for (texel, frame) in (0..64).flat_map(|texel| (0..8).map(move |frame| (texel, frame))) {
            let of_person = 0.4 + noise(texel, frame);
            let background = texel == 27 && frame == 0;
            all.push(seen(texel as u32, Vec3::splat(if background { 3.0 } else { of_person })));
        }
        let values = jacobi(&[Vec3::splat(0.4); 64], &[&all], 4, 1.0).values;
        let mean = (0..8).map(|f| if f == 0 { 3.0 } else { 0.4 + noise(27, f) }).sum::<f32>() / 8.0;
        assert!((values[27].x - 0.4).abs() < 0.5 * (mean - 0.4), "{} for {mean}", values[27]);
    }

    /// All texels but those on which `hidden` is.
    fn shown(width: usize, height: usize, hidden: impl Fn(usize) -> bool) -> Shown {
        let weights: Vec<f32> = (0..width * height).map(|i| if hidden(i) { 0.0 } else { 1.0 }).collect();
        Shown::new(width, [&weights, &weights], 0.5)
    }

    fn noise(count: usize, seed: u64) -> Vec<Vec3> {
        let mut stream = RandomStream::new(&[seed]);
        (0..count).map(|_| Vec3::new(stream.normal(), stream.normal(), stream.normal())).collect()
    }

    fn energy(values: &[Vec3]) -> f32 {
        values.iter().map(|value| value.length_squared()).sum()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        #[test]
        fn the_filter_is_a_sum_over_nine_neighbours(seed in any::<u64>(), step in 1usize..4) {
            let shown = shown(24, 20, |_| false);
            let values = noise(24 * 20, seed);
            let found = shown.filter(&values, step);
            let taps = [(-1, 0.25), (0, 0.5), (1, 0.25)];
            for (x, y) in (step..24 - step).flat_map(|x| (step..20 - step).map(move |y| (x, y))) {
                let mut sum = Vec3::ZERO;
                for ((i, u), (j, v)) in taps.into_iter().flat_map(|a| taps.map(|b| (a, b))) {
                    let at = |p: usize, i: isize| p.wrapping_add_signed(i * step as isize);
                    sum += u * v * values[at(y, j) * 24 + at(x, i)];
                }
                prop_assert!(found[y * 24 + x].distance(sum) < 1e-5);
            }
        }

        /// Gaps between the texels change nothing.
        #[test]
        fn details_that_agree_stay(seed in any::<u64>(), gap in 2usize..9) {
            let shown = shown(32, 32, |i| i % gap == 0);
            let values = noise(shown.texels.len(), seed);
            let found = shown.shrunk(&values, [&values, &values]);
            prop_assert!(found.iter().zip(&values).all(|(a, b)| a.distance(*b) < 1e-4));
        }

        /// A pattern with noise that differs between the halves comes nearer to the pattern; noise
        /// alone nearly vanishes.
        #[test]
        fn details_that_differ_vanish(seed in any::<u64>()) {
            const SIDE: usize = 64;
            let shown = shown(SIDE, SIDE, |_| false);
            let (a, b) = (noise(SIDE * SIDE, seed), noise(SIDE * SIDE, !seed));
            let mean = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| 0.5 * (*a + *b)).collect::<Vec<_>>();
            let whole = mean(&a, &b);
            prop_assert!(energy(&shown.shrunk(&whole, [&a, &b])) < 0.15 * energy(&whole));
            // Stripes 3 texels wide on the left half.
            let pattern = |i: usize| if i % SIDE < SIDE / 2 && i % 6 < 3 { 1.5 } else { 0.0 };
            let with = |noise: &[Vec3]| noise.iter().enumerate().map(|(i, n)| *n + pattern(i)).collect::<Vec<_>>();
            let (a, b) = (with(&a), with(&b));
            let error = |values: &[Vec3]| {
                energy(&values.iter().enumerate().map(|(i, value)| *value - pattern(i)).collect::<Vec<_>>())
            };
            let whole = mean(&a, &b);
            prop_assert!(error(&shown.shrunk(&whole, [&a, &b])) < 0.7 * error(&whole));
        }
    }

    #[test]
    fn nothing_shown_and_nothing_updated_are_finite() {
        let none = shown(4, 4, |_| true);
        assert!(none.shrunk(&[], [&[], &[]]).is_empty());
        let still = vec![Vec3::ZERO; 16];
        assert_eq!(shown(4, 4, |_| false).shrunk(&still, [&still, &still]), still);
    }
}
