//! Training: the step from rays to gradients, deterministic whatever the number of threads.

use glam::Vec3;
use rayon::prelude::*;
use smpl::WeightVolume;
use visibility::VisibilityCounts;
use volrender::{Composite, composite, composite_backward};

use crate::Error;
use crate::batch::{Batch, target};
use crate::config::{Config, DistanceKind, MotionKind};
use crate::encoder::Coordinates;
use crate::field::{Field, Group};
use crate::loss::{completeness, multiscale_dissimilarity};
use crate::parameters::{PARTS, Parameters, Part};
use crate::pixels::Label;
use crate::random::Stream;
use crate::samples::{Stage, Tracer};
use crate::scene::{PreparedFrame, Scene};
use crate::vertices::VertexCode;

/// Rays are dealt row by row to this many groups, each with its own gradient buffers, summed in order: the result
/// does not depend on who computes a group. Eight keep two to eight threads busy.
const GROUPS: usize = 8;
const JITTER: u64 = 0x4A49_5454;

/// What a step did.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct StepReport {
    /// Number of the step, from 1.
    pub step: u64,
    /// Weighted sum of the losses.
    pub loss: f64,
    /// Mean squared error over known pixels.
    pub mse: f64,
    /// Perceptual term.
    pub perceptual: f64,
    /// Completeness term.
    pub completeness: f64,
    /// Of the known pixels of the step, decibels.
    pub psnr: f64,
    /// Samples that were alive.
    pub live_samples: usize,
    /// Rays traced.
    pub rays: usize,
    /// Gradients that were not finite and were left out.
    pub bad_gradients: usize,
}

/// A model in training, or trained.
pub struct Trainer<'a> {
    pub(crate) config: Config,
    pub(crate) scene: &'a Scene,
    pub(crate) field: Field,
    pub(crate) parameters: Parameters,
    pub(crate) counts: VisibilityCounts,
    pub(crate) volume: Option<WeightVolume>,
    pub(crate) steps_done: u64,
    stage: Stage,
    batch: Batch,
    groups: Vec<GroupState>,
    vertex_code: VertexCode,
    transposed: Vec<f32>,
    all_at: Coordinates,
    all_d_features: Vec<f32>,
}

#[derive(Default)]
struct GroupState {
    group: Group,
    /// Indices into the batch of this group's rays.
    rays: Vec<usize>,
    composites: Vec<Composite>,
    weights: Vec<f32>,
    d_mlp: Vec<f32>,
    d_vertices: Vec<f32>,
    d_volume: Vec<f32>,
    /// Sum of the completeness terms.
    completeness: f64,
    /// Finest neighbours of the termination points.
    terminations: Vec<u32>,
}

impl<'a> Trainer<'a> {
    /// A model at step 0.
    pub fn new(scene: &'a Scene, config: Config) -> Result<Self, Error> {
        config.validate()?;
        let (levels, lists) = (scene.query.pyramid().levels.len(), scene.query.neighbours_per_query());
        let (wanted, k) = (config.surface.coarse_levels + 1, config.surface.k);
        if levels != wanted || lists != levels * k {
            let k_of_scene = lists / levels.max(1);
            let found = format!("was prepared for {k_of_scene} neighbours in each of {levels} levels");
            return Err(Error::Scene(format!("{found}, the configuration asks for {k} in each of {wanted}")));
        }
        let field = Field::new(&config, scene.canonical_box)?;
        let volume = match config.motion.kind {
            MotionKind::Surface => None,
            MotionKind::Volume => Some(WeightVolume::diffused(&scene.model, &scene.canonical, &Default::default())),
            MotionKind::Gaussian => Some(WeightVolume::gaussian(&scene.model, &scene.canonical, &Default::default())),
        };
        let vertices = scene.canonical.vertices.len();
        let motion = volume.as_ref().map_or(0, |v| v.delta.len());
        Ok(Self {
            parameters: Parameters::new(&config, &field, vertices, motion),
            counts: VisibilityCounts::new(vertices),
            stage: Stage::new(scene)?,
            batch: Batch::default(),
            groups: (0..GROUPS).map(|_| GroupState::default()).collect(),
            vertex_code: VertexCode::default(),
            transposed: Vec::new(),
            all_at: Coordinates::default(),
            all_d_features: Vec::new(),
            steps_done: 0,
            config,
            scene,
            field,
            volume,
        })
    }

    /// The run's configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Steps taken so far.
    pub fn steps_done(&self) -> u64 {
        self.steps_done
    }

    /// Changes the length of the run, and with it the fall of the learning rates.
    pub fn set_steps(&mut self, steps: u64) {
        self.config.steps = steps;
    }

    /// Learnable numbers, padding not counted.
    pub fn num_parameters(&self) -> usize {
        PARTS[1..].iter().map(|&(part, _)| self.parameters.get(part).len()).sum::<usize>()
            + self.field.mlp.num_true_parameters()
    }

    /// How often each vertex was near a termination point.
    pub fn visibility_counts(&self) -> &[u64] {
        self.counts.counts()
    }

    /// Encodes the vertices with the current parameters, as rendering needs them.
    pub(crate) fn encode_vertices(&self, code: &mut VertexCode) {
        if self.field.surface_term {
            let (table, offsets) = (self.parameters.get(Part::Table), self.parameters.get(Part::Vertices));
            code.encode(self.scene, &self.config, &self.field.encoder, table, offsets);
        }
    }

    /// Takes the volume's log-weights from the parameters.
    pub(crate) fn refresh_volume(&mut self) {
        if let Some(volume) = &mut self.volume {
            volume.delta.copy_from_slice(self.parameters.get(Part::Motion));
            volume.update();
        }
    }

    pub(crate) fn tracer<'b>(&'b self, stage: &'b Stage, frame: &'b PreparedFrame) -> Tracer<'b> {
        Tracer {
            scene: self.scene,
            config: &self.config,
            stage,
            posed: &frame.posed,
            to_canonical: &frame.to_canonical,
            volume: self.volume.as_ref(),
            neighbours: self.field.surface_term || self.config.surface.distance == DistanceKind::Blended,
        }
    }

    /// One optimisation step.
    pub fn step(&mut self) -> StepReport {
        let step = self.steps_done;
        let mut batch = std::mem::take(&mut self.batch);
        batch.draw(self.scene, &self.config, step);
        let frame = &self.scene.train[batch.frame];
        let mut stage_code = std::mem::take(&mut self.vertex_code);
        self.stage.set(self.scene, &frame.posed, &self.config);
        self.encode_vertices(&mut stage_code);
        self.vertex_code = stage_code;
        let mut groups = std::mem::take(&mut self.groups);
        for (index, state) in groups.iter_mut().enumerate() {
            state.rays.clear();
            state.rays.extend((0..batch.pixels.len()).filter(|ray| ray / batch.size % GROUPS == index));
        }
        groups.par_iter_mut().for_each(|state| self.forward(state, &batch, frame));
        let mut report = StepReport { step: step + 1, rays: batch.pixels.len(), ..StepReport::default() };
        let d_colors = self.photometric(&groups, &batch, frame, &mut report);
        self.field.mlp.transposed_weights(self.parameters.get(Part::Field), &mut self.transposed);
        groups.par_iter_mut().for_each(|state| self.backward(state, &batch, frame, &d_colors));
        let nominal = (batch.pixels.len() * self.config.samples) as f64;
        report.completeness = groups.iter().map(|g| g.completeness).sum::<f64>() / nominal;
        report.live_samples = groups.iter().map(|g| g.group.samples.len()).sum();
        let loss = &self.config.loss;
        report.loss = f64::from(loss.mse) * report.mse
            + f64::from(loss.perceptual) * report.perceptual
            + f64::from(loss.completeness) * report.completeness;
        self.reduce(&groups);
        for state in &groups {
            self.counts.add(&state.terminations);
        }
        let decay = self.config.rates.final_fraction.powf(step as f32 / self.config.steps.max(1) as f32);
        report.bad_gradients = self.parameters.step(&self.config.rates, decay);
        self.refresh_volume();
        (self.groups, self.batch) = (groups, batch);
        self.steps_done += 1;
        report
    }

    /// Traces, encodes, evaluates and composites the rays of a group.
    fn forward(&self, state: &mut GroupState, batch: &Batch, frame: &PreparedFrame) {
        let tracer = self.tracer(&self.stage, frame);
        state.group.samples.clear();
        for &ray in &state.rays {
            let pixel = batch.pixels[ray];
            let jitter = Stream::new(&[self.config.seed, JITTER, self.steps_done, ray as u64]);
            state.group.samples.trace(&tracer, &pixel_ray(frame, pixel), Some(jitter));
        }
        let (field, table) = (self.parameters.get(Part::Field), self.parameters.get(Part::Table));
        self.field.forward(field, table, &self.vertex_code.features, &self.counts, &mut state.group);
        composite_group(&state.group, batch.background, &mut state.weights, &mut state.composites);
        state.terminations.clear();
        let samples = &state.group.samples;
        if samples.neighbours.is_empty() {
            return;
        }
        let per_sample = samples.neighbours.len() / samples.len();
        for (index, &ray) in state.rays.iter().enumerate() {
            let composite = &state.composites[index];
            let visible = frame.labels[batch.pixels[ray] as usize] == Label::Subject && composite.opacity > 0.5;
            if let Some(t) = composite.termination.filter(|_| visible) {
                let first = (samples.starts[index] + t as usize) * per_sample;
                state.terminations.extend_from_slice(&samples.neighbours[first..][..self.config.surface.k]);
            }
        }
    }

    /// Photometric losses over the patches; returns d loss / d colour of each ray of the batch.
    fn photometric(
        &self,
        groups: &[GroupState],
        batch: &Batch,
        frame: &PreparedFrame,
        report: &mut StepReport,
    ) -> Vec<Vec3> {
        let mut colors = vec![Vec3::ZERO; batch.pixels.len()];
        for state in groups {
            for (&ray, composite) in state.rays.iter().zip(&state.composites) {
                colors[ray] = composite.color;
            }
        }
        let targets: Vec<Option<Vec3>> = batch.pixels.iter().map(|&p| target(frame, p, batch.background)).collect();
        let known = targets.iter().flatten().count();
        let loss = &self.config.loss;
        let mut d_colors = vec![Vec3::ZERO; colors.len()];
        let mut squares = 0.0f64;
        for ((color, target), d) in colors.iter().zip(&targets).zip(&mut d_colors) {
            if let Some(target) = target {
                let error = *color - *target;
                squares += f64::from(error.length_squared());
                *d = loss.mse * 2.0 / (3 * known) as f32 * error;
            }
        }
        report.mse = squares / (3 * known.max(1)) as f64;
        report.psnr = -10.0 * report.mse.max(1e-12).log10();
        if loss.perceptual > 0.0 {
            let patch = batch.size * batch.size;
            let scale = loss.perceptual / self.config.patches as f32;
            let values: Vec<f64> = d_colors
                .par_chunks_mut(patch)
                .zip(colors.par_chunks(patch).zip(targets.par_chunks(patch)))
                .map(|(d_colors, (colors, targets))| perceptual(colors, targets, batch.size, scale, d_colors))
                .collect();
            report.perceptual = values.iter().sum::<f64>() / self.config.patches as f64;
        }
        d_colors
    }

    /// Backward of [`Trainer::forward`] with the completeness term added.
    fn backward(&self, state: &mut GroupState, batch: &Batch, frame: &PreparedFrame, d_colors: &[Vec3]) {
        let group = &mut state.group;
        let n = group.samples.len();
        group.d_sigma.resize(n, 0.0);
        group.d_rgb.resize(n, Vec3::ZERO);
        group.d_likelihood.resize(n, 0.0);
        let loss = &self.config.loss;
        for (index, &ray) in state.rays.iter().enumerate() {
            let range = group.samples.starts[index]..group.samples.starts[index + 1];
            composite_backward(
                &group.sigma[range.clone()],
                &group.samples.likelihood[range.clone()],
                &group.samples.delta[range.clone()],
                &group.rgb[range.clone()],
                batch.background,
                &state.weights[range.clone()],
                d_colors[ray],
                0.0,
                &mut group.d_sigma[range.clone()],
                &mut group.d_rgb[range.clone()],
                &mut group.d_likelihood[range],
            );
        }
        state.completeness = 0.0;
        if loss.completeness > 0.0 {
            let scale = loss.completeness / (batch.pixels.len() * self.config.samples) as f32;
            for s in (0..n).filter(|&s| group.samples.distance[s] < 0.0) {
                let (value, slope) = completeness(group.sigma[s], loss.beta);
                state.completeness += f64::from(value);
                group.d_sigma[s] += scale * slope;
            }
        }
        zero(&mut state.d_mlp, self.parameters.get(Part::Field).len());
        zero(&mut state.d_vertices, self.vertex_code.features.len());
        self.field.backward(&self.transposed, group, &mut state.d_mlp, &mut state.d_vertices);
        if let Some(volume) = &self.volume {
            zero(&mut state.d_volume, volume.weights.len());
            self.motion_backward(volume, group, frame, &mut state.d_volume);
        }
    }

    /// Carries the gradients of the encoding's coordinates and of f into the weight volume.
    fn motion_backward(&self, volume: &WeightVolume, group: &Group, frame: &PreparedFrame, d_volume: &mut [f32]) {
        let (table, region) = (self.parameters.get(Part::Table), &self.scene.canonical_box);
        let d_points = self.field.encoder.encode_backward_points(table, &group.at, &group.d_features, region);
        let samples = &group.samples;
        let per_sample = samples.neighbours.len().checked_div(samples.len()).unwrap_or(0);
        for (s, (d_point, d_coordinate)) in d_points.into_iter().enumerate() {
            let d_distance = group.d_distance[s]
                + if crate::encoder::distance_is_inside(samples.distance[s]) { d_coordinate } else { 0.0 };
            let x = samples.canonical[s];
            let on_surface = !group.at.surface.is_empty();
            let d_closest = if on_surface { d_point } else { Vec3::ZERO };
            let through_surface = match self.config.surface.distance {
                DistanceKind::Blended => {
                    let finest = &samples.neighbours[s * per_sample..][..self.config.surface.k];
                    self.scene.query.blend_backward(x, finest, d_closest, d_distance)
                }
                DistanceKind::Exact => {
                    let away = (x - samples.closest[s]) * samples.distance[s].signum();
                    let normal = away.normalize_or_zero();
                    d_distance * normal + d_closest - normal.dot(d_closest) * normal
                }
            };
            let d_canonical = through_surface + if on_surface { Vec3::ZERO } else { d_point };
            let d_likelihood = group.d_likelihood[s];
            volume.map_backward(&frame.to_canonical, samples.world[s], d_canonical, d_likelihood, d_volume);
        }
    }

    /// Sums the groups' gradients in order and runs the parts of the backward pass that all samples share.
    fn reduce(&mut self, groups: &[GroupState]) {
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
        self.all_at.clear();
        self.all_d_features.clear();
        for state in groups {
            self.all_at.extend(&state.group.at);
            self.all_d_features.extend_from_slice(&state.group.d_features);
        }
        if self.field.surface_term {
            let mut d_vertices = vec![0.0; self.vertex_code.features.len()];
            sum(&mut d_vertices, &|g| &g.d_vertices);
            let (table, d_offsets) = self.parameters.value_and_gradient(Part::Table, Part::Vertices);
            self.vertex_code.backward(self.scene, &self.field.encoder, table, &d_vertices, d_offsets);
            self.all_at.extend(&self.vertex_code.at);
            self.all_d_features.extend_from_slice(&d_vertices);
        }
        let d_table = self.parameters.gradient(Part::Table);
        self.field.encoder.encode_backward(&self.all_at, &self.all_d_features, d_table);
        if let Some(volume) = &self.volume {
            let mut d_weights = vec![0.0; volume.weights.len()];
            sum(&mut d_weights, &|g| &g.d_volume);
            volume.softmax_backward(&d_weights, self.parameters.gradient(Part::Motion));
        }
    }
}

/// The ray through a pixel's centre.
pub(crate) fn pixel_ray(frame: &PreparedFrame, pixel: u32) -> volrender::Ray {
    let width = frame.camera.width;
    frame.camera.ray((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5)
}

/// Composites every ray of a group.
pub(crate) fn composite_group(
    group: &Group,
    background: Vec3,
    weights: &mut Vec<f32>,
    composites: &mut Vec<Composite>,
) {
    let samples = &group.samples;
    weights.resize(samples.len(), 0.0);
    composites.clear();
    for ends in samples.starts.windows(2) {
        let range = ends[0]..ends[1];
        composites.push(composite(
            &group.sigma[range.clone()],
            &samples.likelihood[range.clone()],
            &samples.delta[range.clone()],
            &samples.t[range.clone()],
            &group.rgb[range.clone()],
            background,
            &mut weights[range],
        ));
    }
}

/// The perceptual term of one patch; unknown pixels show the prediction on both sides and get no gradient.
fn perceptual(colors: &[Vec3], targets: &[Option<Vec3>], size: usize, scale: f32, d_colors: &mut [Vec3]) -> f64 {
    let flat = |c: Vec3| c.to_array();
    let a: Vec<f32> = colors.iter().flat_map(|&c| flat(c)).collect();
    let b: Vec<f32> = colors.iter().zip(targets).flat_map(|(&c, t)| flat(t.unwrap_or(c))).collect();
    let mut d = vec![0.0; a.len()];
    let value = multiscale_dissimilarity(&a, &b, size, scale, &mut d);
    for ((d_color, d), target) in d_colors.iter_mut().zip(d.chunks_exact(3)).zip(targets) {
        if target.is_some() {
            *d_color += Vec3::from_slice(d);
        }
    }
    value
}

fn zero(buffer: &mut Vec<f32>, len: usize) {
    buffer.clear();
    buffer.resize(len, 0.0);
}
