//! From the gradients of samples to those of the weight volume.

use glam::Vec3;
use smpl::{MotionFrame, WeightVolume};

use crate::model::distance::{SurfacePoint, surface_point_backward};
use crate::model::field::SampleBatch;
use crate::model::parameters::Part;
use crate::model::trained::Model;

/// Carries the gradients of the encoding's coordinates and of f into the weight volume.
pub(crate) fn volume_backward(
    model: &Model,
    volume: &WeightVolume,
    frame: &MotionFrame<'_>,
    batch: &mut SampleBatch,
    d_volume: &mut [f32],
) {
    let encoder = &model.field.encoder;
    let table = model.parameters.get(Part::Table);
    encoder.encode_backward_points(table, batch.at.all(), &batch.features, &mut batch.d_at);
    let samples = &batch.samples;
    let per_sample = samples.neighbours.len().checked_div(samples.len()).unwrap_or(0);
    let on_surface = !batch.at.surface.is_empty();
    for s in 0..samples.len() {
        let (d_point, d_coordinate) = encoder.d_metres(&batch.d_at, s, &model.body.canonical_box);
        let d_likelihood = batch.d_likelihood[s];
        if d_point == Vec3::ZERO && [d_coordinate, batch.d_distance[s], d_likelihood] == [0.0; 3] {
            continue;
        }
        let at = SurfacePoint { closest: samples.closest[s], distance: samples.distance[s] };
        let inside = encoder.distance_is_inside(at.distance);
        let d_at = SurfacePoint {
            closest: if on_surface { d_point } else { Vec3::ZERO },
            distance: batch.d_distance[s] + if inside { d_coordinate } else { 0.0 },
        };
        let (x, neighbours) = (samples.canonical[s], &samples.neighbours[s * per_sample..]);
        let config = &model.config.surface;
        let through_surface = surface_point_backward(&model.body, config, (x, neighbours), at, d_at, Vec3::ZERO);
        let d_canonical = through_surface + if on_surface { Vec3::ZERO } else { d_point };
        volume.map_backward(&frame.to_canonical, samples.world[s], d_canonical, d_likelihood, d_volume);
    }
}
