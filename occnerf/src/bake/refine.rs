//! The texture, drawn towards the training pictures through the rasteriser.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use visibility::{Fragment, RasterOptions, Rasterizer};

use super::avatar::{Atlas, Avatar};
use super::draw::{BakedPerson, BilinearCorner, atlas_place};
use crate::Error;
use crate::model::trained::Model;
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene, pinhole};

/// Weight of the field's own colour in that of a texel, in pixels that show it.
const PRIOR: f32 = 2.0;

/// Training pixels that are looked at, at most; of more, every n-th.
const MAX_PIXELS: usize = 1 << 21;

/// What a training pixel shows: four texels, how much of each, and the colour photographed.
#[derive(Clone, Copy)]
struct Sight {
    texels: [u32; 4],
    weights: [f32; 4],
    colour: Vec3,
}

/// Moves the colours of the middle shell's texels towards the known pixels of the training frames,
/// `passes` times, each by a Jacobi step of the least squares problem that keeps unseen texels as
/// they are. Returns the mean squared error before the first pass and before the last.
pub(super) fn refine(model: &Model, scene: &Scene, avatar: &mut Avatar, passes: u32) -> Result<[f64; 2], Error> {
    let frames = &scene.train;
    let stride = frames.iter().map(|f| f.labels.num_subject()).sum::<usize>().div_ceil(MAX_PIXELS).max(1);
    let sights: Result<Vec<Vec<Sight>>, Error> =
        frames.iter().map(|frame| sights(model, avatar, frame, stride)).collect();
    let sights = sights?.concat();
    let Atlas { rgba, .. } = &mut avatar.atlas;
    let start: Vec<Vec3> = rgba.as_chunks::<4>().0.iter().map(|&[r, g, b, _]| colour([r, g, b])).collect();
    let mut values = start.clone();
    let mut errors = [0.0; 2];
    for pass in 0..passes {
        let mut sums = vec![(Vec3::ZERO, 0.0f32); values.len()];
        let mut error = 0.0;
        for sight in &sights {
            let at = sight.texels.map(|i| i as usize);
            let shown: Vec3 = at.iter().zip(sight.weights).map(|(&i, w)| w * values[i]).sum();
            let residual = sight.colour - shown;
            error += f64::from(residual.length_squared()) / 3.0;
            for (i, w) in at.into_iter().zip(sight.weights) {
                sums[i].0 += w * residual;
                sums[i].1 += w;
            }
        }
        errors[usize::from(pass > 0)] = error / sights.len().max(1) as f64;
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
fn sights(model: &Model, avatar: &Avatar, frame: &PreparedFrame, stride: usize) -> Result<Vec<Sight>, Error> {
    let pixels = frame.pixels()?;
    let mut person = BakedPerson::new(avatar, model.body.scale);
    let vertices = person.skin(&model.corrected(&frame.view).bones);
    let options = RasterOptions { cull_back: true, near: 1e-3, ..RasterOptions::default() };
    let middle = avatar.shell_ends.len() / 2;
    let first = middle.checked_sub(1).map_or(0, |before| avatar.shell_ends[before]);
    let drawn = Rasterizer::default().faces(vertices, avatar.shell(middle), &pinhole(&frame.view.camera), &options)?;
    let size = Vec2::new(avatar.atlas.width as f32, avatar.atlas.height as f32);
    let sight = |i: usize| {
        let fragment = drawn[i]?;
        let fragment = Fragment { face: fragment.face + first, ..fragment };
        // Edge pixels are mixed with the background.
        if frame.labels.at(i as u32) != Label::Subject || pixels.mask[i] < 0.99 {
            return None;
        }
        let corner = BilinearCorner::new(atlas_place(avatar, &fragment) * size, size);
        let Vec2 { x, y } = corner.share;
        Some(Sight {
            texels: corner.texels(avatar.atlas.width, avatar.atlas.height).map(|t| t as u32),
            weights: [(1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y],
            colour: Vec3::from_slice(&pixels.image.pixels[3 * i..]),
        })
    };
    Ok((0..drawn.len()).into_par_iter().step_by(stride).filter_map(sight).collect())
}
