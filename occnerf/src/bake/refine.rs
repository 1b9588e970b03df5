//! Texture optimisation: the atlas fitted to the training frames through the rasteriser.

use glam::{UVec2, Vec2, Vec3};
use visibility::{Pixel, RasterOptions, Rasterizer, Samples};

use super::agreement::Shown;
use super::avatar::{Atlas, Avatar};
use super::draw::{BakedRenderer, BilinearCorner, color, look};
use crate::Error;
use crate::capture::Light;
use crate::model::view::pinhole;
use crate::scene::hands::{HandPixels, is_arm};
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::scene::registration::{deviation, robust};
use crate::scene::reliability::Reliability;
use crate::scene::seen::depth_inside;

/// Regularisation of a texel towards its colour before, in pixels.
const PRIOR: f32 = 0.3;

/// Parts of the video, which belong to one half of the frames and the other in turn: neighbouring frames
/// have the same errors of registration.
const BLOCKS: usize = 32;

/// Least weight of a texel in either half for their agreement, in pixels.
const EVIDENCE: f32 = 0.05;

/// Most sampled training pixels.
const MAX_PIXELS: usize = 1 << 19;

/// A bilinear lookup: four texels and their weights.
type Lookup = ([u32; 4], [f32; 4]);

/// A photographed pixel as a linear function of the texels.
struct PixelEquation {
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

/// Fits the colours of the texels to the known pixels of the training frames by `passes` Jacobi steps
/// of regularised least squares; unobserved texels keep their colours. Returns the mean squared error
/// before the first step and before the last.
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

/// Jacobi steps on the texels' `values` (H · W) for the equations of two halves of the frames, whose details
/// count as far as the halves agree. Residuals are weighted robustly by the share of `disagreement` of the
/// frames.
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

/// Equations of the fully covered subject pixels of a frame; `hands` has where it may show hands, and
/// whether each vertex of the avatar (V) belongs to a forearm or hand.
fn equations(
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
        let slant = fragments().map(|fragment| share * cosine(fragment.face)).sum();
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use volrender::RandomStream;

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
}
