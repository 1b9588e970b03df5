//! Displacements of the prior's surface along its normals, from the outlines of the training frames.
//!
//! Gauss-Newton steps over all heights at once. Residuals are those of registration's outlines; each
//! frame sees the outline elsewhere, so their intersection is the visual hull (Laurentini 1994).
//! Thin-plate regularisation couples neighbours; conjugate gradients solve.

use glam::Vec3;
use rayon::prelude::*;

use super::plate::{Plate, Term};
use super::surface::NormalRay;
use crate::Error;
use crate::model::subdivide::Subdivided;
use crate::model::view::PosedView;
use crate::scene::prepared::Scene;
use crate::scene::registration::{Crop, Edge, ObservationOptions, observe, robust, shared_edges};

/// Gauss-Newton steps.
const ROUNDS: usize = 5;
/// Most frames that are observed.
const MOST_FRAMES: usize = 96;
/// Search distance of the mask's edge in the first round and in the last, pixels.
const REACH: [f32; 2] = [10.0, 4.0];
/// Standard deviation of an outline residual, pixels: so small that an outline follows the median of the
/// frames, not the mean.
const OUTLINE: f32 = 0.15;
/// Standard deviation of the heights' Laplacian, in edge lengths.
const BEND: f32 = 0.08;
/// Standard deviation of a height around that of the prior's clothes, normalised metres.
const SPREAD: f32 = 0.05;
/// Lowest and highest surface, normalised metres.
const RANGE: [f32; 2] = [-0.03, 0.12];

/// Heights of the vertices of `mesh` over their `feet` (V) that explain the outlines in the frames,
/// starting from those of `prior` (V).
pub(super) fn displacements(
    scene: &Scene,
    mesh: &Subdivided,
    feet: &[NormalRay],
    prior: &[f32],
) -> Result<Vec<f32>, Error> {
    let stride = scene.learnt.len().div_ceil(MOST_FRAMES).max(1);
    let frames: Vec<usize> = scene.learnt.iter().copied().step_by(stride).collect();
    let crop = |&frame: &usize| {
        let frame = &scene.train[frame];
        Ok(Crop::new(&frame.view.camera, &frame.pixels()?, &frame.view.posed.vertices))
    };
    let crops = frames.par_iter().map(crop).collect::<Result<Vec<_>, Error>>()?;
    let edges = shared_edges(&mesh.faces);
    let places: Vec<Vec3> = feet.iter().map(|foot| foot.foot).collect();
    let plate = Plate::new(&places, &mesh.faces, BEND);
    let mut heights = prior.to_vec();
    for round in 0..ROUNDS {
        let late = round as f32 / (ROUNDS - 1) as f32;
        let options = ObservationOptions { reach: REACH[0] + late * (REACH[1] - REACH[0]), blur: 0.0, unit: 1.0 };
        let look = |(&frame, crop): (&usize, &Option<Crop>)| -> Result<_, Error> {
            let Some(crop) = crop else { return Ok(Vec::new()) };
            let (vertices, up) = raised(scene, &scene.train[frame].view, mesh, feet, &heights);
            let term = |&Edge { vertex, distance, gradient, .. }: &Edge| {
                let slope = gradient.dot(up[vertex as usize]);
                let weight = robust(distance * distance, OUTLINE) / (OUTLINE * OUTLINE);
                (vertex, weight * slope * slope, weight * slope * distance)
            };
            Ok(observe(crop, &vertices, (&mesh.faces, &edges), options)?.edges.iter().map(term).collect())
        };
        let looked = frames.par_iter().zip(&crops).map(look).collect::<Result<Vec<Vec<_>>, Error>>()?;
        let mut sums: Vec<Term> = vec![(0.0, 0.0); heights.len()];
        for (v, precision, pull) in looked.into_iter().flatten() {
            let sum = &mut sums[v as usize];
            *sum = (sum.0 + precision, sum.1 + pull);
        }
        for ((sum, height), prior) in sums.iter_mut().zip(&heights).zip(prior) {
            let precision = (SPREAD * SPREAD).recip();
            *sum = (sum.0 + precision, sum.1 + precision * (prior - height));
        }
        let step = plate.step(&sums, &heights);
        for (height, step) in heights.iter_mut().zip(step) {
            *height = (*height + step).clamp(RANGE[0], RANGE[1]);
        }
    }
    Ok(heights)
}

/// Vertices at `heights` in the pose of a view, and their derivatives by the height, (V).
fn raised(
    scene: &Scene,
    view: &PosedView,
    mesh: &Subdivided,
    feet: &[NormalRay],
    heights: &[f32],
) -> (Vec<Vec3>, Vec<Vec3>) {
    let weights = &scene.body.model.weights;
    let turned = |v: usize| -> Vec3 {
        weights.row(v).map(|(joint, w)| w * (view.posed.bones[joint].matrix3 * feet[v].direction)).sum()
    };
    // The first vertices of the subdivided prior are its own.
    let directions: Vec<Vec3> = (0..view.posed.vertices.len()).map(turned).collect();
    let each = mesh.anchors.iter().zip(heights).map(|(anchor, height)| {
        let up = anchor.mix(&directions).normalize_or_zero();
        (anchor.mix(&view.posed.vertices) + height * up, up)
    });
    each.unzip()
}
