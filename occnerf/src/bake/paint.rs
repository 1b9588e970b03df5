//! Texture baking: the field integrated along the normals through each shell.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use surface_query::MeshDistance;

use super::field::CanonicalField;
use super::surface::{NormalRay, STEP};
use crate::Error;
use visibility::{RasterOptions, Rasterizer, View};

/// Range of integration beyond the outermost and below the innermost shell, normalised metres.
const BEYOND: f32 = 0.02;
const BELOW: f32 = 0.0125;
/// Texels of a batch.
const CHUNK: usize = 128;

/// A texel on the surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Texel {
    /// In the atlas, row-major.
    pub index: u32,
    /// Vertices of the subdivided prior and their barycentric weights.
    pub corners: [u32; 3],
    pub weights: [f32; 3],
    /// Face of the prior that it is part of.
    pub parent: u32,
    pub shell: usize,
}

impl Texel {
    fn mix(&self, values: &[f32]) -> f32 {
        self.corners.iter().zip(self.weights).map(|(&v, w)| w * values[v as usize]).sum()
    }

    fn normal(&self, normals: &[NormalRay]) -> NormalRay {
        let sum = |part: fn(&NormalRay) -> Vec3| {
            self.corners.iter().zip(self.weights).map(|(&v, w)| w * part(&normals[v as usize])).sum::<Vec3>()
        };
        NormalRay { foot: sum(|n| n.foot), direction: sum(|n| n.direction).normalize_or(Vec3::Y) }
    }
}

/// Rasterises `faces` with vertices at `places` (V, texels) into a square of `side`: the texels whose
/// centres are covered. `describe` maps a face to its shell, its vertices in the subdivided prior, and
/// its face of the prior.
pub(super) fn texels(
    side: u32,
    places: &[Vec2],
    faces: &[[u32; 3]],
    describe: impl Fn(u32) -> (usize, [u32; 3], u32),
) -> Result<Vec<Texel>, Error> {
    let flat: Vec<Vec3> = places.iter().map(|place| place.extend(1.0)).collect();
    let (focal, centre, world_to_camera) = (Vec2::ONE, Vec2::ZERO, glam::Affine3A::IDENTITY);
    let view = View { focal, centre, world_to_camera, width: side, height: side };
    let drawn = Rasterizer::default().faces(&flat, faces, &view, &RasterOptions::default())?;
    let texel = |(index, fragment): (u32, Option<visibility::Fragment>)| {
        let fragment = fragment?;
        let (shell, corners, parent) = describe(fragment.face);
        Some(Texel { index, corners, weights: fragment.barycentric, parent, shell })
    };
    Ok((0..).zip(drawn).filter_map(texel).collect())
}

/// Colour and alpha of each of `texels`, with shells at `heights` (shells, V) over the prior's
/// `normals` (V).
///
/// A shell represents the field up to the middles of the gaps to its neighbours. The innermost is
/// opaque.
pub(super) fn paint(
    field: &impl CanonicalField,
    prior: &MeshDistance,
    normals: &[NormalRay],
    heights: &[Vec<f32>],
    texels: &[Texel],
) -> Vec<(Vec3, f32)> {
    let chunks: Vec<Vec<(Vec3, f32)>> = texels
        .par_chunks(CHUNK)
        .map_init(
            Default::default,
            |(along, places, lengths, values): &mut (Vec<_>, Vec<_>, Vec<f32>, Vec<_>), texels| {
                places.clear();
                lengths.clear();
                let mut counts = Vec::with_capacity(texels.len());
                for texel in texels {
                    let [low, high] = slab(heights, texel, field.reach(), field.spacing());
                    texel.normal(normals).places(prior, high, low, field.reach() + high - low, along);
                    counts.push(along.len());
                    places.extend(along.iter().map(|(_, place)| *place));
                    // Quadrature weight of each point within the slab.
                    let length = |height: f32| (height + 0.5 * STEP).min(high) - (height - 0.5 * STEP).max(low);
                    lengths.extend(along.iter().map(|(height, _)| length(*height).max(0.0)));
                }
                field.evaluate(places, values);
                let mut first = 0;
                let colour = |count: usize| {
                    let own = first..first + count;
                    first += count;
                    integrate(&values[own.clone()], &lengths[own], field.spacing())
                };
                let colours = counts.into_iter().map(colour);
                let opaque = |((c, a), texel): ((Vec3, f32), &Texel)| (c, if texel.shell == 0 { 1.0 } else { a });
                colours.zip(texels).map(opaque).collect()
            },
        )
        .collect();
    chunks.concat()
}

/// Height range that a texel's shell represents, for a sample spacing of `spacing`.
fn slab(heights: &[Vec<f32>], texel: &Texel, reach: f32, spacing: f32) -> [f32; 2] {
    let own = texel.mix(&heights[texel.shell]);
    let to = |shell: Option<&Vec<f32>>| shell.map(|heights| 0.5 * (own + texel.mix(heights)));
    let inner = to(texel.shell.checked_sub(1).and_then(|shell| heights.get(shell)));
    let outer = to(heights.get(texel.shell + 1));
    let high = outer.unwrap_or((own + BEYOND).min(reach));
    [inner.unwrap_or(own - BELOW.max(spacing)), high.max(own + STEP)]
}

/// Volume rendering of points, outside in, with quadrature weights `lengths`: the mean over all phases
/// of a sampling at `spacing`, as over neighbouring pixels.
fn integrate(points: &[(f32, Vec3)], lengths: &[f32], spacing: f32) -> (Vec3, f32) {
    let stride = ((spacing / STEP).round() as usize).max(1);
    let (mut sum, mut opacity) = (Vec3::ZERO, 0.0);
    for phase in 0..stride.min(points.len()) {
        let mut transmittance = 1.0;
        for (&(density, colour), length) in points.iter().zip(lengths).skip(phase).step_by(stride) {
            let alpha = 1.0 - (-density * length * stride as f32).exp();
            sum += transmittance * alpha * colour;
            transmittance *= 1.0 - alpha;
        }
        opacity += 1.0 - transmittance;
    }
    if opacity > 1e-3 {
        return (sum / opacity, opacity / stride as f32);
    }
    // The colour of a transparent ray is the mean of its points.
    let mean = points.iter().map(|p| p.1).sum::<Vec3>() / points.len().max(1) as f32;
    (mean, 0.0)
}

/// Dilates the values of the `known` texels over all others, ring by ring, for bilinear lookups at the
/// rim of a chart.
pub(super) fn dilate<const N: usize>(side: usize, values: &mut [[f32; N]], known: &mut [bool]) {
    let mut rim: Vec<usize> = (0..known.len()).filter(|&i| !known[i]).collect();
    while !rim.is_empty() {
        let mean = |&i: &usize| {
            let (x, y) = (i % side, i / side);
            let (mut sum, mut count) = ([0.0; N], 0.0f32);
            for ny in y.saturating_sub(1)..(y + 2).min(side) {
                for nx in x.saturating_sub(1)..(x + 2).min(side) {
                    let n = ny * side + nx;
                    if known[n] {
                        (0..N).for_each(|k| sum[k] += values[n][k]);
                        count += 1.0;
                    }
                }
            }
            (count > 0.0).then(|| (i, sum.map(|s| s / count)))
        };
        let found: Vec<(usize, [f32; N])> = rim.par_iter().filter_map(mean).collect();
        if found.is_empty() {
            return;
        }
        for (i, value) in found {
            (values[i], known[i]) = (value, true);
        }
        rim.retain(|&i| !known[i]);
    }
}
