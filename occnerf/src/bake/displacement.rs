//! Displacements of the prior's surface along its normals, from outlines and colours of the
//! training frames.
//!
//! Gauss-Newton steps over all heights at once. Outline residuals are those of registration; each
//! frame sees the outline elsewhere, so their intersection is the visual hull (Laurentini 1994).
//! Colour residuals are differences of a vertex's colour between frames: its albedo is eliminated
//! from the normal equations (variable projection, Golub and Pereyra 1973). Thin-plate
//! regularisation couples neighbours; conjugate gradients solve.

use glam::Vec3;
use rayon::prelude::*;

use super::plate::{Plate, Term};
use super::surface::NormalRay;
use crate::Error;
use crate::capture::Light;
use crate::model::subdivide::Subdivided;
use crate::model::view::PosedView;
use crate::scene::light::{ColorObservation, albedo};
use crate::scene::prepared::Scene;
use crate::scene::registration::{Crop, Edge, ObservationOptions, Observations, noise, observe, robust, shared_edges};

/// Gauss-Newton steps, and those of them with outline residuals alone.
const ROUNDS: usize = 5;
const OUTLINES: usize = 2;
/// Most frames that are observed.
const MOST_FRAMES: usize = 96;
/// Search distance of the mask's edge in the first round and in the last, pixels.
const REACH: [f32; 2] = [10.0, 4.0];
/// Blur of the colours in their first round and in the last, pixels.
const BLUR: [f32; 2] = [2.0, 0.5];
/// Standard deviation of an outline residual, pixels: so small that an outline follows the median of the
/// frames, not the mean.
const OUTLINE: f32 = 0.15;
/// Weight of colour residuals.
const COLOR_WEIGHT: f32 = 2.0;
/// Standard deviation of the heights' Laplacian, in edge lengths.
const BEND: f32 = 0.08;
/// Standard deviation of a height around that of the prior's clothes, normalised metres.
const SPREAD: f32 = 0.05;
/// Lowest and highest surface, normalised metres.
const RANGE: [f32; 2] = [-0.03, 0.12];

/// A vertex's colour in one frame, and its derivative by the height, a component a channel.
type Shown = (ColorObservation, Vec3);

/// Heights of the vertices of `mesh` over their `feet` (V) that explain the frames under `light`,
/// starting from those of `prior` (V).
pub(super) fn displacements(
    scene: &Scene,
    light: Light,
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
        let between = |ends: [f32; 2], share: f32| ends[0] + share * (ends[1] - ends[0]);
        let sharp = (round as f32 - OUTLINES as f32) / (ROUNDS - 1 - OUTLINES) as f32;
        let blur = if round < OUTLINES { 0.0 } else { between(BLUR, sharp) };
        let options = ObservationOptions { reach: between(REACH, late), blur, unit: 1.0 };
        let look = |(&frame, crop): (&usize, &Option<Crop>)| -> Result<_, Error> {
            let Some(crop) = crop else { return Ok((Vec::new(), Vec::new())) };
            let (vertices, up) = raised(scene, &scene.train[frame].view, mesh, feet, &heights);
            let observed = observe(crop, &vertices, (&mesh.faces, &edges), options)?;
            Ok(terms(&observed, &up))
        };
        let looked = frames.par_iter().zip(&crops).map(look).collect::<Result<Vec<_>, Error>>()?;
        let mut sums: Vec<Term> = vec![(0.0, 0.0); heights.len()];
        for (v, precision, pull) in looked.iter().flat_map(|(outline, _)| outline) {
            let sum = &mut sums[*v as usize];
            *sum = (sum.0 + precision, sum.1 + pull);
        }
        let shown: Vec<&Shown> = looked.iter().flat_map(|(_, shown)| shown).collect();
        add_colors(&shown, light, blur, &mut sums);
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

/// Outline terms of the vertices, and their colours, of one frame.
fn terms(observed: &Observations, up: &[Vec3]) -> (Vec<(u32, f32, f32)>, Vec<Shown>) {
    let outline = |&Edge { vertex, distance, gradient, .. }: &Edge| {
        let slope = gradient.dot(up[vertex as usize]);
        let weight = robust(distance * distance, OUTLINE) / (OUTLINE * OUTLINE);
        (vertex, weight * slope * slope, weight * slope * distance)
    };
    let shown = |(seen, jacobian): (&ColorObservation, &[Vec3; 3])| {
        (*seen, Vec3::from(jacobian.map(|row| row.dot(up[seen.0 as usize]))))
    };
    (observed.edges.iter().map(outline).collect(), observed.colors.iter().zip(&observed.jacobians).map(shown).collect())
}

/// Normal equations of a vertex: its height and its albedo.
#[derive(Clone, Copy, Default)]
struct Block {
    height: f32,
    /// A component a channel.
    mixed: Vec3,
    albedo: f32,
    /// Weighted residuals by the height, and by the albedo, a component a channel.
    pull: f32,
    sum: Vec3,
}

/// Adds the colour terms, with the albedo of each vertex eliminated.
fn add_colors(shown: &[&Shown], light: Light, blur: f32, sums: &mut [Term]) {
    let albedo = albedo(shown.iter().map(|(seen, _)| seen), sums.len(), light);
    let residual = |(vertex, color, normal): &ColorObservation| {
        let (sum, squares) = albedo[*vertex as usize];
        *color - light.on(*normal) * sum / squares.max(f32::MIN_POSITIVE)
    };
    let Some(noise) = noise(shown.iter().map(|(seen, _)| residual(seen))) else { return };
    let mut blocks = vec![Block::default(); sums.len()];
    // Neighbouring residuals are correlated under a blur.
    let scale = COLOR_WEIGHT / (noise * noise * (1.0 + blur * blur));
    for (seen, change) in shown {
        let (residual, shade) = (residual(seen), light.on(seen.2));
        let weight = scale * robust(residual.length_squared(), noise);
        let block = &mut blocks[seen.0 as usize];
        block.height += weight * change.length_squared();
        block.mixed += weight * shade * *change;
        block.albedo += weight * shade * shade;
        block.pull += weight * change.dot(residual);
        block.sum += weight * shade * residual;
    }
    // The model is shade · albedo = colour + change · step.
    for (sum, block) in sums.iter_mut().zip(&blocks).filter(|(_, block)| block.albedo > 0.0) {
        let precision = block.height - block.mixed.length_squared() / block.albedo;
        let pull = -(block.pull - block.mixed.dot(block.sum) / block.albedo);
        *sum = (sum.0 + precision.max(0.0), sum.1 + pull);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix4, Vector4};
    use proptest::prelude::*;

    proptest! {
        /// The step solves the dense normal equations of height and albedo together.
        #[test]
        fn the_albedo_is_eliminated_exactly(
            frames in prop::collection::vec(
                (prop::array::uniform3(0.0f32..1.0), -1.0f32..1.0, prop::array::uniform3(-5.0f32..5.0)), 2..7),
        ) {
            let light = Light { slope: 0.5 * Vec3::X };
            let shown: Vec<Shown> = frames.iter().map(|&(color, x, change)| {
                let normal = Vec3::new(x, (1.0 - x * x).sqrt(), 0.0);
                ((0, color.into(), normal), change.into())
            }).collect();
            let mut sums = [(0.0, 0.0)];
            add_colors(&shown.iter().collect::<Vec<_>>(), light, 0.0, &mut sums);
            let shade = |(seen, _): &Shown| light.on(seen.2);
            let (sum, squares) = shown.iter().fold((Vec3::ZERO, 0.0), |(sum, squares), s| {
                (sum + shade(s) * s.0.1, squares + shade(s) * shade(s))
            });
            let residual = |s: &Shown| s.0.1 - shade(s) * sum / squares;
            let mut errors: Vec<f32> = shown.iter().map(|s| residual(s).abs().element_sum() / 3.0).collect();
            errors.sort_by(f32::total_cmp);
            let noise = (1.48 * errors[errors.len() / 2]).max(0.05);
            let (mut matrix, mut vector) = (Matrix4::<f64>::zeros(), Vector4::<f64>::zeros());
            for s in &shown {
                let weight = f64::from(COLOR_WEIGHT / (noise * noise) * robust(residual(s).length_squared(), noise));
                for channel in 0..3 {
                    // The residual, shade · albedo − colour, by the albedo and by the height.
                    let mut row = Vector4::zeros();
                    (row[0], row[1 + channel]) = (-f64::from(s.1[channel]), f64::from(shade(s)));
                    matrix += weight * row * row.transpose();
                    vector += weight * f64::from(residual(s)[channel]) * row;
                }
            }
            prop_assume!(sums[0].0 > 1e-2 * matrix[(0, 0)] as f32);
            let expected = matrix.try_inverse().map_or(0.0, |inverse| (inverse * vector)[0]);
            let found = f64::from(sums[0].1 / sums[0].0);
            prop_assert!((found - expected).abs() < 1e-2 * (0.1 + expected.abs()), "{found} {expected}");
        }
    }
}
