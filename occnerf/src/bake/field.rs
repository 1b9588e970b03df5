//! A trained field in canonical space.

use glam::Vec3;
use smpl::MotionField;

use super::surface::Place;
use crate::model::distance::surface_point;
use crate::model::extent::Extent;
use crate::model::field::SampleBatch;
use crate::model::trained::{Model, surface_motion};
use crate::model::vertices::VertexCode;

/// Density, in 1 / normalised metre and 0 outside the extent, and colour at each of `places`.
pub(super) fn evaluate(model: &Model, code: &VertexCode, extent: &Extent, places: &[Place]) -> Vec<(f32, Vec3)> {
    let Model { body, config, base, motion, .. } = model;
    let blended = config.surface.distance.needs_neighbours();
    let neighbours = config.needs_neighbours();
    let based = !base.colors.is_empty() && matches!(motion, MotionField::Surface(_));
    let mut batch = SampleBatch::default();
    batch.samples.clear();
    for place in places {
        let samples = &mut batch.samples;
        samples.push_canonical(body, place.at, place.closest, place.distance, neighbours);
        if blended {
            let own = &samples.neighbours[samples.neighbours.len() - body.query.neighbours_per_query()..];
            if let Some(point) = surface_point(body, &config.surface, place.at, own, f32::INFINITY)
                && let (Some(closest), Some(distance)) = (samples.closest.last_mut(), samples.distance.last_mut())
            {
                (*closest, *distance) = (point.closest, point.distance);
            }
        }
        if based {
            samples.base.push(base.logit(place.face, place.barycentric, 1.0));
        }
    }
    model.evaluate(code, &mut batch);
    let likelihood = surface_motion(&config.motion);
    let value = |((place, sigma), rgb): ((&Place, &f32), &Vec3)| {
        let lives = place.distance <= extent.faces[place.face as usize];
        (if lives { likelihood.likelihood(place.distance) * sigma } else { 0.0 }, *rgb)
    };
    places.iter().zip(&batch.sigma).zip(&batch.rgb).map(value).collect()
}
