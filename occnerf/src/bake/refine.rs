//! Texture optimisation: the atlas fitted to the training frames through the rasteriser.

use glam::{UVec2, Vec2, Vec3};
use visibility::{Pixel, RasterOptions, Rasterizer, Samples};

use super::avatar::{Atlas, Avatar};
use super::draw::{BakedRenderer, BilinearCorner, color, look};
use crate::Error;
use crate::capture::Light;
use crate::model::view::pinhole;
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::scene::registration::{deviation, robust};
use crate::scene::reliability::Reliability;
use crate::scene::seen::depth_inside;

/// Regularisation of a texel towards its colour before, in pixels.
const PRIOR: f32 = 0.3;

/// How many times stronger it is where frames disagree.
const DOUBT: f32 = 4.0;

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
    let (_, reliability) = scene.lighting()?;
    let mut all = Vec::new();
    for frame in frames {
        all.extend(equations(avatar, &mut renderer, frame, stride, reliability)?);
    }
    let Atlas { rgb, width, .. } = &mut avatar.atlas;
    let mut values: Vec<Vec3> = rgb.as_chunks::<3>().0.iter().copied().map(color).collect();
    let errors = solve(&all, *width as usize, &mut values, passes, reliability.disagreement);
    for (texel, value) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(&values) {
        *texel = value.clamp(Vec3::ZERO, Vec3::ONE).to_array().map(|x| (x * 255.0 + 0.5) as u8);
    }
    Ok(errors)
}

/// Jacobi steps on the texels' `values` (H · W). By the share of `disagreement` of the frames, residuals
/// are weighted robustly, steps smoothed and colours before trusted more: least squares would paint the
/// differences, background in the masks among them, as a moiré.
fn solve(all: &[PixelEquation], width: usize, values: &mut [Vec3], passes: u32, disagreement: f32) -> [f64; 2] {
    let start = values.to_vec();
    let spread = deviation(all.iter().map(|equation| equation.residual(&start))).unwrap_or(0.0);
    let prior = PRIOR * (1.0 + (DOUBT - 1.0) * disagreement);
    let mut errors = [0.0; 2];
    for pass in 0..passes {
        let mut sums = vec![(Vec3::ZERO, 0.0f32); values.len()];
        let mut error = 0.0;
        for equation in all {
            let residual = equation.residual(values);
            let squared = residual.length_squared();
            error += f64::from(squared) / 3.0;
            let doubt = 1.0 - robust(squared, 2.0 * spread.max(f32::MIN_POSITIVE));
            let trust = equation.trust * (1.0 - disagreement * doubt);
            for (i, weight) in equation.texels() {
                sums[i].0 += trust * weight * residual;
                sums[i].1 += trust * weight;
            }
        }
        errors[usize::from(pass > 0)] = error / all.len().max(1) as f64;
        smooth(&mut sums, width, disagreement);
        for ((value, (sum, weight)), start) in values.iter_mut().zip(sums).zip(&start) {
            *value += (sum + prior * (start - *value)) / (weight + prior);
        }
    }
    errors
}

/// Binomial filter [1 2 1] / 4 along both axes of an atlas, in the part `share`.
fn smooth(sums: &mut [(Vec3, f32)], width: usize, share: f32) {
    for stride in [1, width] {
        let before = sums.to_vec();
        for (sum, near) in sums.iter_mut().skip(stride).zip(before.windows(2 * stride + 1)) {
            let (a, b, c) = (near[0], near[stride], near[2 * stride]);
            *sum = (b.0 + 0.25 * share * (a.0 - 2.0 * b.0 + c.0), b.1 + 0.25 * share * (a.1 - 2.0 * b.1 + c.1));
        }
    }
}

/// Equations of the fully covered subject pixels of a frame.
fn equations(
    avatar: &Avatar,
    renderer: &mut BakedRenderer<'_>,
    frame: &PreparedFrame,
    stride: usize,
    reliability: &Reliability,
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
        let share = 1.0 / count as f32;
        let brightness: f32 = fragments().map(|fragment| share * look(avatar, looks, fragment).z).sum();
        let lookups = fragments().map(|fragment| lookup(avatar, look(avatar, looks, fragment).truncate(), share));
        let colour = Vec3::from_slice(&pixels.image.pixels[3 * i..]) / brightness;
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
            let errors = solve(&all, 5, &mut values, 1, 0.0);
            let expected = start + off.iter().sum::<f32>() / (off.len() as f32 + PRIOR);
            prop_assert!((values[12].x - expected).abs() < 1e-5, "{} {expected}", values[12]);
            prop_assert!(errors[0] < 1e-5 && values.iter().enumerate().all(|(i, v)| i == 12 || v.x == start));
        }

        /// The filter keeps sums that lie off the border, and does not go below zero.
        #[test]
        fn smoothing_keeps_the_sum(at in 0usize..9, share in 0.0f32..1.0) {
            let mut sums = vec![(Vec3::ZERO, 0.0); 49];
            sums[(at / 3 + 2) * 7 + at % 3 + 2] = (Vec3::ONE, 2.0);
            smooth(&mut sums, 7, share);
            prop_assert!((sums.iter().map(|sum| sum.1).sum::<f32>() - 2.0).abs() < 1e-5);
            prop_assert!((sums.iter().map(|sum| sum.0).sum::<Vec3>() - Vec3::ONE).abs().max_element() < 1e-5);
            prop_assert!(sums.iter().all(|sum| sum.1 >= 0.0));
        }
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
        let mut values = vec![Vec3::splat(0.4); 64];
        solve(&all, 8, &mut values, 4, 1.0);
        let mean = (0..8).map(|f| if f == 0 { 3.0 } else { 0.4 + noise(27, f) }).sum::<f32>() / 8.0;
        assert!((values[27].x - 0.4).abs() < 0.5 * (mean - 0.4), "{} for {mean}", values[27]);
    }
}
