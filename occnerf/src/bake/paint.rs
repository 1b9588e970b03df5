//! Texture baking: the colours of the field on the surface.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use surface_query::MeshDistance;

use super::surface::{CanonicalField, NormalRay, Place};
use crate::Error;
use visibility::{RasterOptions, Rasterizer, View};

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
/// centres are covered. `describe` maps a face to its vertices in the subdivided prior and its face
/// of the prior.
pub(super) fn texels(
    side: u32,
    places: &[Vec2],
    faces: &[[u32; 3]],
    describe: impl Fn(u32) -> ([u32; 3], u32),
) -> Result<Vec<Texel>, Error> {
    let flat: Vec<Vec3> = places.iter().map(|place| place.extend(1.0)).collect();
    let (focal, centre, world_to_camera) = (Vec2::ONE, Vec2::ZERO, glam::Affine3A::IDENTITY);
    let view = View { focal, centre, world_to_camera, width: side, height: side };
    let drawn = Rasterizer::default().faces(&flat, faces, &view, &RasterOptions::default())?;
    let texel = |(index, fragment): (u32, Option<visibility::Fragment>)| {
        let fragment = fragment?;
        let (corners, parent) = describe(fragment.face);
        Some(Texel { index, corners, weights: fragment.barycentric, parent })
    };
    Ok((0..).zip(drawn).filter_map(texel).collect())
}

/// Colour of the field at each of `texels`, on the surface at `heights` (V) over the prior's `normals` (V).
pub(super) fn paint(
    field: &CanonicalField<'_>,
    prior: &MeshDistance,
    normals: &[NormalRay],
    heights: &[f32],
    texels: &[Texel],
) -> Vec<Vec3> {
    let chunk = |texels: &[Texel]| {
        let place = |texel: &Texel| {
            let (normal, height) = (texel.normal(normals), texel.mix(heights));
            let at = normal.foot + height * normal.direction;
            Place::new(at, &prior.closest(at))
        };
        let values = (field.evaluate)(&texels.iter().map(place).collect::<Vec<_>>());
        values.into_iter().map(|(_, colour)| colour)
    };
    texels.par_chunks(CHUNK).flat_map_iter(chunk).collect()
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
