//! Surface extraction: heights along the prior's normals at which the field becomes opaque.

use glam::Vec3;
use rayon::prelude::*;
use surface_query::MeshDistance;

use super::field::{CanonicalField, Place};
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

/// Statistics of surface extraction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SurfaceReport {
    /// Vertices without an opaque crossing, filled from their neighbours.
    pub holes: usize,
    /// Vertices with a second opaque layer behind a gap.
    pub double: usize,
    /// Vertices moved to the median of their neighbours.
    pub outliers: usize,
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
    pub fn places(&self, prior: &MeshDistance, high: f32, low: f32, farthest: f32, out: &mut Vec<(f32, Place)>) {
        out.clear();
        let steps = ((high - low) / STEP).ceil().max(0.0) as usize;
        // Inside out, up to the first point of another part.
        for step in (0..=steps).rev() {
            let height = high - step as f32 * STEP;
            let at = self.foot + height * self.direction;
            let Some(closest) = prior.closest_within(at, farthest) else { break };
            if height > 0.0 && closest.signed_distance < OWN * height {
                break;
            }
            let (face, barycentric, distance) = (closest.face, closest.barycentric, closest.signed_distance);
            out.push((height, Place { at, closest: closest.point, face, barycentric, distance }));
        }
        out.reverse();
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

/// Height along each normal (V) at which the opacity from outside passes ½, NaN for none; and the
/// number of normals with a second opaque layer.
fn crossings(field: &impl CanonicalField, prior: &MeshDistance, normals: &[NormalRay]) -> (Vec<f32>, usize) {
    let reach = field.reach();
    let chunks: Vec<(Vec<f32>, usize)> = normals
        .par_chunks(CHUNK)
        .map_init(Default::default, |(along, places, values): &mut Scratch, normals| {
            places.clear();
            let mut profiles = Vec::with_capacity(normals.len());
            for normal in normals {
                normal.places(prior, reach, -DEPTH, reach + DEPTH, along);
                profiles.push(along.iter().map(|(height, _)| *height).collect::<Vec<f32>>());
                places.extend(along.iter().map(|(_, place)| *place));
            }
            field.evaluate(places, values);
            let (mut out, mut double, mut start) = (Vec::new(), 0, 0);
            for heights in &profiles {
                let densities = &values[start..start + heights.len()];
                start += heights.len();
                let (height, twice) = profile(heights, densities, field.grazing());
                out.push(height);
                double += usize::from(twice);
            }
            (out, double)
        })
        .collect();
    let double = chunks.iter().map(|chunk| chunk.1).sum();
    (chunks.into_iter().flat_map(|chunk| chunk.0).collect(), double)
}

type Scratch = (Vec<(f32, Place)>, Vec<Place>, Vec<(f32, Vec3)>);

/// The height at which the opacity passes ½, and whether a gap, with at most a tenth of the peak
/// density, separates two opaque layers. The optical depth is the integral from outside plus a length
/// of `grazing` at the greatest density so far, which puts the surface of a fuzzy field at its
/// rendered outline.
fn profile(heights: &[f32], densities: &[(f32, Vec3)], grazing: f32) -> (f32, bool) {
    let (mut found, mut depth) = (f32::NAN, 0.0);
    // Greatest density and optical depth since the last gap.
    let (mut peak, mut since, mut gap, mut double) = (0.0f32, 0.0, false, false);
    let (mut thickest, mut previous) = (0.0f32, 0.0);
    for (&height, &(density, _)) in heights.iter().zip(densities) {
        let added = density * STEP;
        thickest = thickest.max(density);
        let here = depth + added + grazing * thickest;
        if found.is_nan() && here >= HALF {
            found = height + STEP * (0.5 - (HALF - previous) / (here - previous));
        }
        (previous, depth) = (here, depth + added);
        if since >= HALF && density < 0.1 * peak {
            gap = true;
            (peak, since) = (0.0, 0.0);
        }
        peak = peak.max(density);
        since += added;
        double |= gap && since >= HALF;
    }
    (found, double)
}

/// Heights along each normal (V) at which the opacity from outside is ½. Holes are filled, outliers
/// replaced by the median, and all smoothed.
pub(super) fn heights(
    field: &impl CanonicalField,
    prior: &MeshDistance,
    normals: &[NormalRay],
    mesh: &Subdivided,
) -> (Vec<f32>, SurfaceReport) {
    let (mut heights, double) = crossings(field, prior, normals);
    let near = neighbours(normals.len(), &mesh.faces);
    let holes = heights.iter().filter(|h| h.is_nan()).count();
    fill(&mut heights, &near);
    let outliers = replace_outliers(&mut heights, &near);
    (smoothed(&heights, &near), SurfaceReport { holes, double, outliers })
}

/// Replaces outliers by the median of their neighbours; returns their number.
fn replace_outliers(heights: &mut [f32], near: &[Vec<u32>]) -> usize {
    let median = |(near, &own): (&Vec<u32>, &f32)| {
        let mut about: Vec<f32> = near.iter().map(|&v| heights[v as usize]).collect();
        about.sort_by(f32::total_cmp);
        about.get(about.len() / 2).copied().unwrap_or(own)
    };
    let medians: Vec<f32> = near.iter().zip(&*heights).map(median).collect();
    let mut outliers = 0;
    for (height, median) in heights.iter_mut().zip(medians) {
        if (*height - median).abs() > OUTLIER {
            *height = median;
            outliers += 1;
        }
    }
    outliers
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
