//! The texture, drawn towards the training pictures through the rasteriser.

use glam::{Vec2, Vec3, Vec4};
use visibility::{Pixel, RasterOptions, Rasterizer, Samples};

use super::avatar::{Atlas, Avatar};
use super::draw::{BakedPerson, BilinearCorner, atlas_place, shade};
use crate::Error;
use crate::model::trained::Model;
use crate::model::view::pinhole;
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};

/// Weight of the field's own colour in that of a texel, in pixels that show it.
const PRIOR: f32 = 0.3;

/// Training pixels that are looked at, at most; of more, every n-th.
const MAX_PIXELS: usize = 1 << 19;

/// Four texels of a shell and how much of each a pixel shows.
type Look = ([u32; 4], [f32; 4]);

/// The colour that was photographed at a pixel, and what the pixel shows of each shell that it
/// sees.
struct Sight {
    colour: Vec3,
    looks: Vec<Look>,
}

/// Moves the colours of the texels towards the known pixels of the training frames, `passes` times,
/// each by a Jacobi step of the least squares problem that keeps unseen texels as they are. Returns
/// the mean squared error before the first pass and before the last.
pub(super) fn refine(model: &Model, scene: &Scene, avatar: &mut Avatar, passes: u32) -> Result<[f64; 2], Error> {
    let frames = &scene.train;
    let stride = frames.iter().map(|f| f.labels.num_subject()).sum::<usize>().div_ceil(MAX_PIXELS).max(1);
    let mut person = BakedPerson::new(avatar, model.body.scale).lit_by(model.base.light);
    let mut all = Vec::new();
    for frame in frames {
        all.extend(sights(avatar, &mut person, frame, stride)?);
    }
    let Atlas { rgba, .. } = &mut avatar.atlas;
    let start: Vec<Vec3> = rgba.as_chunks::<4>().0.iter().map(|&[r, g, b, _]| colour([r, g, b])).collect();
    let mut values = start.clone();
    let mut errors = [0.0; 2];
    for pass in 0..passes {
        let mut sums = vec![(Vec3::ZERO, 0.0f32); values.len()];
        let mut error = 0.0;
        for Sight { colour, looks } in &all {
            let texels = || looks.iter().flat_map(|(at, w)| at.iter().map(|&i| i as usize).zip(*w));
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
    for (texel, value) in rgba.as_chunks_mut::<4>().0.iter_mut().zip(&values) {
        let bytes = value.clamp(Vec3::ZERO, Vec3::ONE).to_array().map(|x| (x * 255.0 + 0.5) as u8);
        texel[..3].copy_from_slice(&bytes);
    }
    Ok(errors)
}

fn colour(bytes: [u8; 3]) -> Vec3 {
    Vec3::from(bytes.map(|byte| f32::from(byte) / 255.0))
}

/// The subject's pixels of a frame that look at the surface well away from its outline.
fn sights(
    avatar: &Avatar,
    person: &mut BakedPerson<'_>,
    frame: &PreparedFrame,
    stride: usize,
) -> Result<Vec<Sight>, Error> {
    let pixels = frame.pixels()?;
    person.skin(&frame.view.posed.bones);
    let (vertices, shades) = person.posed();
    // As pixels are drawn by default, so that the texture makes up for their width.
    let options = RasterOptions { samples: Samples::Four, cull_back: true, near: 1e-3 };
    let shells: Vec<&[[u32; 3]]> = (0..avatar.shell_ends.len()).map(|shell| avatar.shell(shell)).collect();
    let look = |pixel: Pixel<'_>| {
        let i = pixel.index;
        // Edge pixels are mixed with the background.
        let wanted = i.is_multiple_of(stride) && frame.labels.at(i as u32) == Label::Subject && pixels.mask[i] >= 0.99;
        let count = pixel.samples().len();
        if !wanted || count == 0 || pixel.samples().any(<[_]>::is_empty) {
            return None;
        }
        let share = 1.0 / count as f32;
        let brightness: f32 = pixel.samples().map(|fragments| share * shade(avatar, shades, &fragments[0])).sum();
        let looks = pixel.samples().flat_map(|fragments| {
            let mut before = share;
            fragments.iter().map(move |fragment| look(avatar, atlas_place(avatar, fragment), &mut before))
        });
        Some(Sight { colour: Vec3::from_slice(&pixels.image.pixels[3 * i..]) / brightness, looks: looks.collect() })
    };
    let mut out: Vec<Option<Sight>> = Vec::new();
    out.resize_with(pixels.mask.len(), || None);
    Rasterizer::default().draw(vertices, &shells, &pinhole(&frame.view.camera), &options, &mut out, look)?;
    Ok(out.into_iter().flatten().collect())
}

/// What is seen at a `place` of the atlas with the transmittance `before` it, which becomes that
/// behind it.
fn look(avatar: &Avatar, place: Vec2, before: &mut f32) -> Look {
    let Atlas { width, height, ref rgba, .. } = avatar.atlas;
    let size = Vec2::new(width as f32, height as f32);
    let corner = BilinearCorner::new(place * size, size);
    let (texels, Vec2 { x, y }) = (corner.texels(width, height), corner.share);
    let alphas = Vec4::from(texels.map(|i| f32::from(rgba[4 * i + 3]) / 255.0));
    let shown = Vec4::new((1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y) * alphas;
    let weights = *before * shown;
    *before *= 1.0 - shown.element_sum();
    (texels.map(|i| i as u32), weights.to_array())
}
