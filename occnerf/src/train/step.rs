//! The parts of a training step, from rays to gradients.

use glam::Vec3;
use rayon::prelude::*;
use smpl::{Posed, WeightVolume};

use crate::config::DistanceKind;
use crate::model::arena::Arena;
use crate::model::correction::{Wrench, correct_backward};
use crate::model::encoder::Slopes;
use crate::model::field::Group;
use crate::model::parameters::Part;
use crate::model::samples::March;
use crate::model::times::{StepTimes, Stopwatch};
use crate::random::Stream;
use crate::scene::labels::Label;
use crate::scene::prepared::PreparedFrame;
use crate::train::batch::Batch;
use crate::train::loss::completeness;
use crate::train::trainer::{GroupState, Trainer, pixel_ray};

const JITTER: u64 = 0x4A49_5454;

impl Trainer<'_> {
    /// Traces, encodes, evaluates and composites the rays of a group. What lies outside the prior on a ray at an unknown pixel is dead:
    /// no photometric term asks for the ray's colour, and completeness for the inside alone.
    pub(crate) fn forward(&self, state: &mut GroupState, batch: &Batch, frame: &PreparedFrame, posed: &Posed) {
        let tracer = self.tracer(&self.stage, &self.shell, frame, posed);
        let GroupState { rays, runs, along, composites, terminations, times, jacobians, .. } = state;
        let marches = rays.iter().map(|&ray| {
            let jitter = Stream::new(&[self.config.seed, JITTER, self.steps_done, ray as u64]);
            let hidden = frame.labels.at(batch.pixels[ray]) == Label::Unknown && !self.evaluates_all;
            March::new(pixel_ray(frame, batch.pixels[ray]), Some(jitter)).only_inside(hidden)
        });
        let mut jacobians = (self.volume.is_some() || self.teaches_poses()).then_some(jacobians);
        if let Some(arena) = &mut jacobians {
            arena.clear(rays.len() * self.config.samples * self.field.encoder.jacobian_width());
        }
        let (field, table) = (self.parameters.get(Part::Field), self.parameters.get(Part::Table));
        runs.march(&tracer, marches, self.config.min_transmittance, self.run, |group| {
            let jacobians = jacobians.as_deref_mut();
            self.field.forward(field, table, &self.vertex_code.rows, &self.counts, group, jacobians);
        });
        *times = StepTimes::default();
        for group in runs.groups_mut() {
            *times += std::mem::take(&mut group.times);
        }
        let mut watch = Stopwatch::start();
        along.gather(runs);
        along.composite(batch.background, composites);
        watch.lap(&mut times.losses);
        terminations.clear();
        for (index, &ray) in rays.iter().enumerate() {
            let composite = &composites[index];
            let visible = frame.labels.at(batch.pixels[ray]) == Label::Subject && composite.opacity > 0.5;
            if let Some(t) = composite.termination.filter(|_| visible) {
                terminations.extend_from_slice(along.neighbours(runs, index, t as usize, self.config.surface.k));
            }
        }
    }

    /// Backward of [`Trainer::forward`] with the completeness term added.
    pub(crate) fn backward(
        &self,
        state: &mut GroupState,
        batch: &Batch,
        frame: &PreparedFrame,
        posed: &Posed,
        d_colors: &[Vec3],
    ) {
        let mut watch = Stopwatch::start();
        let GroupState { rays, runs, along, times, jacobians, .. } = state;
        along.composite_backward(batch.background, rays.iter().map(|&ray| d_colors[ray]), runs);
        let field = self.parameters.get(Part::Field);
        zero(&mut state.d_mlp, field.len());
        zero(&mut state.d_vertices, self.vertex_code.rows.len());
        if let Some(volume) = &self.volume {
            zero(&mut state.d_volume, volume.weights.len());
        }
        state.wrenches.clear();
        state.wrenches.resize(posed.bones.len(), Wrench::default());
        state.completeness = 0.0;
        let loss = &self.config.loss;
        let scale = loss.completeness / (batch.pixels.len() * self.config.samples) as f32;
        for group in runs.groups_mut() {
            if loss.completeness > 0.0 {
                for s in (0..group.samples.len()).filter(|&s| group.samples.distance[s] < 0.0) {
                    let (value, slope) = completeness(group.sigma[s], loss.beta);
                    state.completeness += f64::from(value);
                    group.d_sigma[s] += scale * slope;
                }
            }
            watch.lap(&mut times.losses);
            self.field.backward(
                field,
                &self.transposed,
                &self.vertex_code.rows,
                group,
                &mut state.d_mlp,
                &mut state.d_vertices,
            );
            watch.lap(&mut times.perceptron_backward);
            if let Some(volume) = &self.volume {
                self.motion_backward(volume, group, jacobians, frame, &mut state.d_volume);
            }
            if self.teaches_poses() {
                self.pose_backward(group, jacobians, posed, &mut state.wrenches);
            }
            watch.lap(&mut times.motion_backward);
        }
    }

    /// Fills `d_at` of a group: the gradients of the coordinates that its samples were encoded at.
    pub(crate) fn d_coordinates(&self, group: &mut Group, jacobians: &Arena) {
        let Group { at, d_at, jacobian, features, .. } = group;
        let slopes = Slopes::Jacobian(jacobians.piece(jacobian));
        self.field.encoder.encode_backward_points(slopes, at.all(), features, d_at);
    }

    /// Carries the gradients of the encoding's coordinates and of f into the weight volume.
    fn motion_backward(
        &self,
        volume: &WeightVolume,
        group: &mut Group,
        jacobians: &Arena,
        frame: &PreparedFrame,
        d_volume: &mut [f32],
    ) {
        self.d_coordinates(group, jacobians);
        let samples = &group.samples;
        let per_sample = samples.neighbours.len().checked_div(samples.len()).unwrap_or(0);
        for s in 0..samples.len() {
            let (d_point, d_coordinate) = self.field.encoder.d_metres(&group.d_at, s, &self.scene.canonical_box);
            let d_likelihood = group.d_likelihood[s];
            if d_point == Vec3::ZERO && [d_coordinate, group.d_distance[s], d_likelihood] == [0.0; 3] {
                continue;
            }
            let d_distance = group.d_distance[s]
                + if self.field.encoder.distance_is_inside(samples.distance[s]) { d_coordinate } else { 0.0 };
            let x = samples.canonical[s];
            let on_surface = !group.at.surface.is_empty();
            let d_closest = if on_surface { d_point } else { Vec3::ZERO };
            let through_surface = match self.config.surface.distance {
                DistanceKind::Blended => {
                    let finest = &samples.neighbours[s * per_sample..][..self.config.surface.k];
                    self.scene.query.blend_backward(x, finest, d_closest, d_distance)
                }
                DistanceKind::Mean => {
                    let finest = &samples.neighbours[s * per_sample..][..self.config.surface.k];
                    let query = &self.scene.query;
                    d_distance * query.mean_distance(x, finest).1 + query.blend_backward(x, finest, d_closest, 0.0)
                }
                DistanceKind::Exact => {
                    let away = (x - samples.closest[s]) * samples.distance[s].signum();
                    let normal = away.normalize_or_zero();
                    d_distance * normal + d_closest - normal.dot(d_closest) * normal
                }
            };
            let d_canonical = through_surface + if on_surface { Vec3::ZERO } else { d_point };
            volume.map_backward(&frame.to_canonical, samples.world[s], d_canonical, d_likelihood, d_volume);
        }
    }

    /// Sums the groups' gradients in order and runs the parts of the backward pass that all samples share.
    pub(crate) fn reduce(
        &mut self,
        groups: &[GroupState],
        frame: &PreparedFrame,
        posed: &Posed,
        times: &mut StepTimes,
    ) {
        let mut watch = Stopwatch::start();
        self.parameters.clear_gradients();
        let sum = |to: &mut [f32], from: &(dyn Fn(&GroupState) -> &[f32] + Sync)| {
            to.par_chunks_mut(1 << 12).enumerate().for_each(|(chunk, to)| {
                for state in groups {
                    let from = &from(state)[chunk << 12..][..to.len()];
                    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
                }
            });
        };
        let d_mlp = self.parameters.gradient(Part::Field);
        sum(d_mlp, &|g| &g.d_mlp);
        self.field.mlp.clear_padding(d_mlp);
        watch.lap(&mut times.update);
        if self.field.surface_term {
            zero(&mut self.vertex_code.d_rows, self.vertex_code.rows.len());
            sum(&mut self.vertex_code.d_rows, &|g| &g.d_vertices);
            let (table, d_offsets) = self.parameters.value_and_gradient(Part::Table, Part::Vertices);
            self.vertex_code.backward(self.scene, &self.field.encoder, table, d_offsets);
        }
        let d_table = self.parameters.gradient(Part::Table);
        let samples = groups.iter().flat_map(|state| state.runs.groups());
        let parts = samples.map(|group| (group.at.all(), &group.features[..])).chain(self.vertex_code.parts());
        self.field.encoder.encode_backward(parts, d_table);
        watch.lap(&mut times.encode_backward);
        if let Some(volume) = &self.volume {
            zero(&mut self.d_volume, volume.weights.len());
            sum(&mut self.d_volume, &|g| &g.d_volume);
            volume.softmax_backward(&self.d_volume, self.parameters.gradient(Part::Motion));
        }
        if let (Some(correction), Some(instant)) =
            (self.correction(frame).filter(|_| self.teaches_poses()), frame.instant)
        {
            let mut wrenches = vec![Wrench::default(); posed.bones.len()];
            for state in groups {
                wrenches.iter_mut().zip(&state.wrenches).for_each(|(to, from)| to.add(from));
            }
            let d_correction = correct_backward(&self.scene.model, &frame.posed, &correction, posed, &wrenches);
            self.corrections.at_backward(instant, &d_correction, self.parameters.gradient(Part::Pose));
        }
        watch.lap(&mut times.update);
    }
}

fn zero(buffer: &mut Vec<f32>, len: usize) {
    buffer.clear();
    buffer.resize(len, 0.0);
}
