//! Texture optimisation: the atlas fitted to the training frames through the rasteriser.

use glam::{Vec2, Vec3};
use visibility::{Pixel, RasterOptions, Rasterizer, Samples};

use super::avatar::{Atlas, Avatar};
use super::draw::{BakedPerson, BilinearCorner, atlas_place, shade};
use crate::Error;
use crate::capture::Light;
use crate::model::view::pinhole;
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};

/// Regularisation of a texel towards its colour before, in pixels.
const PRIOR: f32 = 0.3;

/// Most sampled training pixels.
const MAX_PIXELS: usize = 1 << 19;

/// A bilinear lookup: four texels and their weights.
type Lookup = ([u32; 4], [f32; 4]);

/// A photographed pixel as a linear function of the texels.
struct PixelEquation {
    colour: Vec3,
    lookups: Vec<Lookup>,
}

/// Fits the colours of the texels to the known pixels of the training frames by `passes` Jacobi steps
/// of regularised least squares; unobserved texels keep their colours. Returns the mean squared error
/// before the first step and before the last.
pub(super) fn refine(scene: &Scene, light: Light, avatar: &mut Avatar, passes: u32) -> Result<[f64; 2], Error> {
    let frames = &scene.train;
    let stride = frames.iter().map(|f| f.labels.num_subject()).sum::<usize>().div_ceil(MAX_PIXELS).max(1);
    let mut person = BakedPerson::new(avatar, scene.body.scale).lit_by(light);
    let mut all = Vec::new();
    for frame in frames {
        all.extend(equations(avatar, &mut person, frame, stride)?);
    }
    let Atlas { rgb, .. } = &mut avatar.atlas;
    let start: Vec<Vec3> = rgb.as_chunks::<3>().0.iter().copied().map(colour).collect();
    let mut values = start.clone();
    let mut errors = [0.0; 2];
    for pass in 0..passes {
        let mut sums = vec![(Vec3::ZERO, 0.0f32); values.len()];
        let mut error = 0.0;
        for PixelEquation { colour, lookups } in &all {
            let texels = || lookups.iter().flat_map(|(at, w)| at.iter().map(|&i| i as usize).zip(*w));
            let residual = *colour - texels().map(|(i, w)| w * values[i]).sum::<Vec3>();
            error += f64::from(residual.length_squared()) / 3.0;
            for (i, w) in texels() {
                sums[i].0 += w * residual;
                sums[i].1 += w;
            }
        }
        errors[usize::from(pass > 0)] = error / all.len().max(1) as f64;
        for ((value, (sum, weight)), start) in values.iter_mut().zip(sums).zip(&start) {
            *value += (sum + PRIOR * (start - *value)) / (weight + PRIOR);
        }
    }
    for (texel, value) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(&values) {
        *texel = value.clamp(Vec3::ZERO, Vec3::ONE).to_array().map(|x| (x * 255.0 + 0.5) as u8);
    }
    Ok(errors)
}

fn colour(bytes: [u8; 3]) -> Vec3 {
    Vec3::from(bytes.map(|byte| f32::from(byte) / 255.0))
}

/// Equations of the fully covered subject pixels of a frame.
fn equations(
    avatar: &Avatar,
    person: &mut BakedPerson<'_>,
    frame: &PreparedFrame,
    stride: usize,
) -> Result<Vec<PixelEquation>, Error> {
    let pixels = frame.pixels()?;
    person.skin(&frame.view.posed.bones);
    let (vertices, shades) = person.posed();
    // Supersampled as by default, so that the texture compensates the pixel footprint.
    let options = RasterOptions { samples: Samples::Four, cull_back: true, near: 1e-3 };
    let equation = |pixel: Pixel<'_>| {
        let i = pixel.index;
        // Edge pixels are mixed with the background.
        let wanted = i.is_multiple_of(stride) && frame.labels.at(i as u32) == Label::Subject && pixels.mask[i] >= 0.99;
        let count = pixel.samples.len();
        if !wanted || count == 0 || pixel.samples.contains(&None) {
            return None;
        }
        let fragments = || pixel.samples.iter().flatten();
        let share = 1.0 / count as f32;
        let brightness: f32 = fragments().map(|fragment| share * shade(avatar, shades, fragment)).sum();
        let lookups = fragments().map(|fragment| lookup(avatar, atlas_place(avatar, fragment), share));
        let colour = Vec3::from_slice(&pixels.image.pixels[3 * i..]) / brightness;
        Some(PixelEquation { colour, lookups: lookups.collect() })
    };
    let mut out: Vec<Option<PixelEquation>> = Vec::new();
    out.resize_with(pixels.mask.len(), || None);
    Rasterizer::default().draw(vertices, &avatar.faces, &pinhole(&frame.view.camera), &options, &mut out, equation)?;
    Ok(out.into_iter().flatten().collect())
}

/// The lookup at a `place` of the atlas, with weights that sum to `share`.
fn lookup(avatar: &Avatar, place: Vec2, share: f32) -> Lookup {
    let Atlas { width, height, .. } = avatar.atlas;
    let size = Vec2::new(width as f32, height as f32);
    let corner = BilinearCorner::new(place * size, size);
    let Vec2 { x, y } = corner.share;
    let weights = [(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y].map(|weight| share * weight);
    (corner.texels(width, height).map(|i| i as u32), weights)
}
