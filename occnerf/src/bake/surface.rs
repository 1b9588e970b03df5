//! Surface extraction: heights along the prior's normals at which the field becomes opaque, and its
//! colours there.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use surface_query::{Closest, MeshDistance};
use visibility::{RasterOptions, Rasterizer, View};

use crate::Error;
use crate::model::subdivide::{Anchor, Subdivided, neighbours, normals};

/// Sampling step of a density profile, normalised metres.
const STEP: f32 = 0.0025;
/// Largest depth of the surface below the prior.
const DEPTH: f32 = 0.03;
/// Least ratio of a point's distance from the prior to its height along the normal; below it, the
/// point belongs to another part.
const OWN: f32 = 0.7;
/// Largest distance of a surface point from the median of its neighbours; others are noise.
const OUTLIER: f32 = 0.01;
/// Optical depth of opacity ½.
const HALF: f32 = std::f32::consts::LN_2;
/// Vertices of a batch.
const CHUNK: usize = 64;

/// A point near the canonical prior.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    /// Canonical, normalised metres.
    pub at: Vec3,
    /// The closest point of the prior, the face it is on, and its weights of that face's corners.
    pub closest: Vec3,
    pub face: u32,
    pub barycentric: [f32; 3],
    /// Signed distance from there, positive outside.
    pub distance: f32,
}

impl Place {
    pub fn new(at: Vec3, found: &Closest) -> Self {
        let &Closest { point: closest, face, barycentric, signed_distance: distance } = found;
        Self { at, closest, face, barycentric, distance }
    }
}

/// Densities, in 1 / normalised metre and 0 outside the extent, and colours of places.
type Values = Vec<(f32, Vec3)>;

/// A field in canonical space.
pub(super) struct CanonicalField<'a> {
    /// Evaluates places.
    pub evaluate: &'a (dyn Fn(&[Place]) -> Values + Sync),
    /// Path length of a ray that grazes the surface, as on the outline, normalised metres.
    pub grazing: f32,
    /// Largest distance of the extent from the prior.
    pub reach: f32,
}

/// A normal ray of the prior.
#[derive(Clone, Copy, Debug)]
pub(super) struct NormalRay {
    pub foot: Vec3,
    pub direction: Vec3,
}

impl NormalRay {
    /// Heights `high`, `high` − STEP, … down to `low`, outside in, and their points, as far as they
    /// belong to this part of the prior.
    fn places(&self, prior: &MeshDistance, high: f32, low: f32) -> (Vec<f32>, Vec<Place>) {
        let steps = ((high - low) / STEP).ceil().max(0.0) as usize;
        let place = |step: usize| {
            let height = high - step as f32 * STEP;
            let at = self.foot + height * self.direction;
            let found = prior.closest_within(at, high - low)?;
            let other_part = height > 0.0 && found.signed_distance < OWN * height;
            (!other_part).then(|| (height, Place::new(at, &found)))
        };
        // Inside out, up to the first point of another part.
        let mut along: Vec<(f32, Place)> = (0..=steps).rev().map_while(place).collect();
        along.reverse();
        along.into_iter().unzip()
    }
}

/// The normal rays of a subdivided prior.
pub(super) fn normal_rays(mesh: &Subdivided, prior: &[Vec3], prior_faces: &[[u32; 3]]) -> Vec<NormalRay> {
    let directions = normals(prior, prior_faces);
    let ray = |anchor: &Anchor| NormalRay {
        foot: anchor.mix(prior),
        direction: anchor.mix(&directions).normalize_or(Vec3::Y),
    };
    mesh.anchors.iter().map(ray).collect()
}

/// Height along each normal (V) at which the opacity from outside passes ½, NaN for none.
fn crossings(field: &CanonicalField<'_>, prior: &MeshDistance, normals: &[NormalRay]) -> Vec<f32> {
    let chunk = |normals: &[NormalRay]| {
        let along = normals.iter().map(|normal| normal.places(prior, field.reach, -DEPTH));
        let (heights, places): (Vec<Vec<f32>>, Vec<Vec<Place>>) = along.unzip();
        let values = (field.evaluate)(&places.concat());
        let mut rest = &values[..];
        let next = |heights: &Vec<f32>| {
            let (densities, others) = rest.split_at(heights.len());
            rest = others;
            crossing(heights, densities, field.grazing)
        };
        heights.iter().map(next).collect::<Vec<f32>>()
    };
    normals.par_chunks(CHUNK).flat_map_iter(chunk).collect()
}

/// The height at which the opacity passes ½. The optical depth is the integral from outside plus a
/// length of `grazing` at the greatest density so far, which puts the surface of a fuzzy field at
/// its rendered outline.
fn crossing(heights: &[f32], densities: &[(f32, Vec3)], grazing: f32) -> f32 {
    let (mut depth, mut thickest, mut previous) = (0.0, 0.0f32, 0.0);
    for (&height, &(density, _)) in heights.iter().zip(densities) {
        let added = density * STEP;
        thickest = thickest.max(density);
        let here = depth + added + grazing * thickest;
        if here >= HALF {
            return height + STEP * (0.5 - (HALF - previous) / (here - previous));
        }
        (previous, depth) = (here, depth + added);
    }
    f32::NAN
}

/// Heights along each normal (V) at which the opacity from outside is ½, and the number of normals
/// without one. These holes are filled, outliers replaced by the median, and all smoothed.
pub(super) fn heights(
    field: &CanonicalField<'_>,
    prior: &MeshDistance,
    normals: &[NormalRay],
    mesh: &Subdivided,
) -> (Vec<f32>, usize) {
    let mut heights = crossings(field, prior, normals);
    let near = neighbours(normals.len(), &mesh.faces);
    let holes = heights.iter().filter(|h| h.is_nan()).count();
    fill(&mut heights, &near);
    replace_outliers(&mut heights, &near);
    (smoothed(&heights, &near), holes)
}

/// Replaces outliers by the median of their neighbours.
fn replace_outliers(heights: &mut [f32], near: &[Vec<u32>]) {
    let median = |(near, &own): (&Vec<u32>, &f32)| {
        let mut about: Vec<f32> = near.iter().map(|&v| heights[v as usize]).collect();
        about.sort_by(f32::total_cmp);
        about.get(about.len() / 2).copied().unwrap_or(own)
    };
    let medians: Vec<f32> = near.iter().zip(&*heights).map(median).collect();
    let outliers = heights.iter_mut().zip(medians).filter(|(height, median)| (**height - median).abs() > OUTLIER);
    outliers.for_each(|(height, median)| *height = median);
}

/// Laplacian smoothing by half a step.
fn smoothed(heights: &[f32], near: &[Vec<u32>]) -> Vec<f32> {
    let mean = |near: &[u32]| near.iter().map(|&v| heights[v as usize]).sum::<f32>() / near.len() as f32;
    let halfway = |(near, &own): (&Vec<u32>, &f32)| if near.is_empty() { own } else { 0.5 * (own + mean(near)) };
    near.iter().zip(heights).map(halfway).collect()
}

/// Fills NaN with the mean of the neighbours, from the rim inwards; 0, the prior itself, without
/// any finite height.
fn fill(heights: &mut [f32], near: &[Vec<u32>]) {
    let mut missing: Vec<usize> = (0..heights.len()).filter(|&v| heights[v].is_nan()).collect();
    while !missing.is_empty() {
        let known = |v: usize| {
            let about = near[v].iter().map(|&n| heights[n as usize]).filter(|h| !h.is_nan());
            let (sum, count) = about.fold((0.0, 0), |(sum, count), h| (sum + h, count + 1));
            (count > 0).then(|| sum / count as f32)
        };
        let found: Vec<(usize, f32)> = missing.iter().filter_map(|&v| Some((v, known(v)?))).collect();
        if found.is_empty() {
            missing.iter().for_each(|&v| heights[v] = 0.0);
            return;
        }
        found.iter().for_each(|&(v, height)| heights[v] = height);
        missing.retain(|&v| heights[v].is_nan());
    }
}

/// Texels of a batch.
const TEXELS: usize = 128;

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

/// Rasterises `faces` with vertices at `places` (V, texels) into a square of `side`: the texels
/// whose centres are covered. `describe` maps a face to its vertices in the subdivided prior and
/// its face of the prior.
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

/// Colour of the field at each of `texels`, on the surface at `heights` (V) over the prior's
/// `normals` (V).
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
    texels.par_chunks(TEXELS).flat_map_iter(chunk).collect()
}

/// Dilates the values of the `known` texels over all others, ring by ring, for bilinear lookups at
/// the rim of a chart.
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
