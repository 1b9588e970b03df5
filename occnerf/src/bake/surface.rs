//! Surface extraction: heights along the prior's normals at which the field becomes opaque.

use glam::Vec3;
use rayon::prelude::*;
use surface_query::{Closest, MeshDistance};

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
/// length of `grazing` at the greatest density so far, which puts the surface of a fuzzy field at its
/// rendered outline.
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

/// Fills NaN with the mean of the neighbours, from the rim inwards; 0, the prior itself, without any
/// finite height.
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
