//! Training: the step from rays to gradients, deterministic whatever the number of threads.

use std::borrow::Cow;

use glam::{Vec3, Vec4};
use rayon::prelude::*;
use smpl::{Posed, WeightVolume};
use visibility::VisibilityCounts;
use volrender::{Composite, Occupancy};

use crate::Error;
use crate::config::{Config, DistanceKind, MotionKind, VisibilityKind};
use crate::lpips::Lpips;
use crate::model::arena::Arena;
use crate::model::correction::{Corrections, Wrench, correct, corrected};
use crate::model::extent::Shell;
use crate::model::field::Field;
use crate::model::march::{Along, Runs, run_length};
use crate::model::parameters::{PARTS, Parameters, Part};
use crate::model::samples::{CELL, Stage, Tracer, near_canonical};
use crate::model::times::{StepTimes, Stopwatch};
use crate::model::vertices::VertexCode;
use crate::scene::colors::VertexColors;
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::train::batch::Batch;
use crate::train::photometric::Photometric;
use crate::train::restarts::Restarts;

/// Rays are dealt row by row to this many groups, each with its own gradient buffers, summed in order: the result
/// does not depend on who computes a group. Eight keep two to eight threads busy.
const GROUPS: usize = 8;
/// Part of a run after which poses are corrected.
const SETTLED: f32 = 0.1;

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
    /// Live samples that were evaluated.
    pub live_samples: usize,
    /// Rays traced.
    pub rays: usize,
    /// Gradients that were not finite and were left out.
    pub bad_gradients: usize,
    /// How often training has begun anew so far, each time at a tenth of the rates, because the field had become empty.
    pub restarts: u32,
    /// Where the time went.
    pub times: StepTimes,
}

/// A model in training, or trained.
pub struct Trainer<'a> {
    pub(crate) config: Config,
    pub(crate) scene: &'a Scene,
    pub(crate) field: Field,
    pub(crate) parameters: Parameters,
    pub(crate) counts: VisibilityCounts,
    pub(crate) volume: Option<WeightVolume>,
    /// [`near_canonical`] where there is a volume, else empty.
    near_canonical: Occupancy,
    pub(crate) corrections: Corrections,
    /// The perceptual term, where it is not the embedded one.
    pub(crate) lpips: Option<Lpips>,
    pub(crate) steps_done: u64,
    pub(crate) restarts: Restarts,
    /// [`run_length`], but in tests.
    pub(crate) run: usize,
    /// Whether rays at unknown pixels have all their samples evaluated; for tests.
    pub(crate) evaluates_all: bool,
    pub(crate) stage: Stage,
    /// Where the field ended when it was last looked at.
    pub(crate) shell: Shell,
    /// What colours start from, V; empty where they start from nothing.
    pub(crate) base: Vec<Vec4>,
    pub(crate) batch: Batch,
    pub(crate) groups: Vec<GroupState>,
    pub(crate) vertex_code: VertexCode,
    pub(crate) transposed: Vec<f32>,
    pub(crate) d_volume: Vec<f32>,
    photometric: Photometric,
    /// The corrected prior of a step.
    posed: Posed,
}

#[derive(Default)]
pub(crate) struct GroupState {
    /// Indices into the batch of this group's rays.
    pub rays: Vec<usize>,
    /// Samples evaluated together, front to back.
    pub runs: Runs,
    /// The same ray by ray.
    pub along: Along,
    pub composites: Vec<Composite>,
    /// Derivatives of the encoding of all runs.
    pub jacobians: Arena,
    pub times: StepTimes,
    pub d_mlp: Vec<f32>,
    pub d_vertices: Vec<f32>,
    pub d_volume: Vec<f32>,
    /// What the samples ask of each bone.
    pub wrenches: Vec<Wrench>,
    /// Sum of the completeness terms.
    pub completeness: f64,
    /// Finest neighbours of the termination points.
    pub terminations: Vec<u32>,
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
        let exact = config.surface.attention && config.surface.visibility == VisibilityKind::Exact;
        let counts = if exact { scene.vertex_frequencies()? } else { vec![0; vertices] };
        let motion = volume.as_ref().map_or(0, |v| v.delta.len());
        let spacing = config.motion.correction_spacing;
        let corrections = Corrections::new(scene.train.len(), spacing, scene.model.num_joints());
        Ok(Self {
            parameters: Parameters::new(&config, &field, vertices, motion, corrections.len()),
            counts: VisibilityCounts::from_counts(counts),
            stage: Stage::new(scene, CELL)?,
            shell: Shell::whole(scene, &config),
            base: if config.field.prior_colors { VertexColors::measure(scene)?.before_sigmoid() } else { Vec::new() },
            batch: Batch::default(),
            groups: (0..GROUPS).map(|_| GroupState::default()).collect(),
            vertex_code: VertexCode::default(),
            transposed: Vec::new(),
            d_volume: Vec::new(),
            photometric: Photometric::default(),
            posed: Posed::default(),
            steps_done: 0,
            restarts: Restarts::default(),
            run: run_length(config.min_transmittance),
            evaluates_all: false,
            near_canonical: if volume.is_some() { near_canonical(scene, &config) } else { Occupancy::default() },
            config,
            scene,
            field,
            volume,
            corrections,
            lpips: None,
        })
    }

    /// Loads the weights that `loss.perceptual_weights` names, if it names any: before the first [`Trainer::step`], also of a
    /// resumed run. Drawing and scoring do not need them.
    ///
    /// # Errors
    /// Those of [`Lpips::load`]; [`Error::Lpips`] for patches too small for the network.
    pub fn load_perceptual(&mut self) -> Result<(), Error> {
        if self.config.loss.perceptual > 0.0 && !self.config.loss.perceptual_weights.is_empty() {
            let lpips = Lpips::load(self.config.loss.perceptual_weights.as_ref())?;
            let sides = self.scene.train.iter().map(|f| f.camera.width.min(f.camera.height));
            let side = sides.min().unwrap_or(0).min(self.config.patch_size) as usize;
            lpips.check_size(side, side)?;
            self.lpips = Some(lpips);
        }
        Ok(())
    }

    /// Which perceptual term the run is trained with: `ms-ssim`, `lpips` with the network's name, or `none`.
    pub fn perceptual(&self) -> String {
        match &self.lpips {
            Some(lpips) => format!("lpips {}", lpips.trunk().name()),
            None if self.config.loss.perceptual == 0.0 => "none".to_owned(),
            None => "ms-ssim".to_owned(),
        }
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
        PARTS[1..].iter().map(|&(part, _)| self.parameters.count(part)).sum::<usize>()
            + self.field.mlp.num_true_parameters()
    }

    /// How often each vertex was near a termination point, or in how many frames it is seen: see [`VisibilityKind`].
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

    /// Shift and turns that training has found for the moment of a frame.
    pub(crate) fn correction(&self, frame: &PreparedFrame) -> Option<Vec<Vec3>> {
        let pose = self.parameters.get(Part::Pose);
        frame.instant.filter(|_| !pose.is_empty()).map(|instant| self.corrections.at(pose, instant))
    }

    /// The posed prior of a frame as training has corrected it; as handed in where nothing is corrected.
    pub fn corrected<'b>(&self, frame: &'b PreparedFrame) -> Cow<'b, Posed> {
        match self.correction(frame) {
            Some(correction) => Cow::Owned(corrected(&self.scene.model, &frame.shape, &frame.posed, &correction)),
            None => Cow::Borrowed(&frame.posed),
        }
    }

    /// Whether samples are to have their neighbours.
    pub(crate) fn needs_neighbours(&self) -> bool {
        self.field.surface_term || self.config.surface.distance != DistanceKind::Exact
    }

    pub(crate) fn tracer<'b>(
        &'b self,
        stage: &'b Stage,
        shell: &'b Shell,
        frame: &'b PreparedFrame,
        posed: &'b Posed,
    ) -> Tracer<'b> {
        Tracer {
            scene: self.scene,
            config: &self.config,
            stage,
            posed,
            to_canonical: &frame.to_canonical,
            volume: self.volume.as_ref(),
            near_canonical: &self.near_canonical,
            shell,
            base: &self.base,
            faces: !self.parameters.get(Part::Pose).is_empty(),
            neighbours: self.needs_neighbours(),
        }
    }

    /// Whether this step teaches the poses: what a field says of them before it has taken shape would lead them astray.
    pub(crate) fn teaches_poses(&self) -> bool {
        let settled = (self.steps_done - self.restarts.begun) as f32 >= SETTLED * self.config.steps as f32;
        settled && !self.parameters.get(Part::Pose).is_empty()
    }

    /// Forgets what was learnt.
    fn begin_anew(&mut self) {
        let (motion, pose) = (self.parameters.get(Part::Motion).len(), self.parameters.get(Part::Pose).len());
        let vertices = self.scene.canonical.vertices.len();
        self.parameters = Parameters::new(&self.config, &self.field, vertices, motion, pose);
        self.shell = Shell::whole(self.scene, &self.config);
        if self.config.surface.visibility == VisibilityKind::Counted {
            self.counts = VisibilityCounts::from_counts(vec![0; vertices]);
        }
    }

    /// One optimisation step.
    ///
    /// # Errors
    /// [`Error::Data`] where the step's picture cannot be decoded (any more); [`Error::Lpips`] where the configuration names
    /// weights of the perceptual term and [`Trainer::load_perceptual`] was not called. The trainer is then as it was before.
    pub fn step(&mut self) -> Result<StepReport, Error> {
        let loss = &self.config.loss;
        let loaded = self.lpips.is_some() || loss.perceptual_weights.is_empty() || loss.perceptual == 0.0;
        if !loaded {
            return Err(Error::Lpips("the weights of the perceptual term were not loaded".to_owned()));
        }
        let step = self.steps_done;
        let (mut times, mut watch) = (StepTimes::default(), Stopwatch::start());
        self.batch.draw(self.scene, &self.config, step);
        let frame = &self.scene.train[self.batch.frame];
        let shown = frame.pixels()?;
        let batch = std::mem::take(&mut self.batch);
        let mut stage_code = std::mem::take(&mut self.vertex_code);
        let mut own_posed = std::mem::take(&mut self.posed);
        let posed = match self.correction(frame) {
            Some(correction) => {
                correct(&self.scene.model, &frame.shape, &frame.posed, &correction, &mut own_posed);
                &own_posed
            }
            None => &frame.posed,
        };
        self.encode_vertices(&mut stage_code);
        self.vertex_code = stage_code;
        let interval = self.config.motion.shell_interval as u64;
        if interval > 0 && step > 0 && step.is_multiple_of(interval) {
            self.shell = self.measure_shell(&self.vertex_code.rows);
        }
        self.stage.set(self.scene, posed, &self.shell, &self.config);
        let mut groups = std::mem::take(&mut self.groups);
        for (index, state) in groups.iter_mut().enumerate() {
            state.rays.clear();
            // Those at unknown pixels come last, so that samples without a gradient are next to each other.
            for unknown in [false, true] {
                let is_due = |&ray: &usize| (frame.labels.at(batch.pixels[ray]) == Label::Unknown) == unknown;
                let rays = (0..batch.pixels.len()).filter(|ray| ray / batch.size % GROUPS == index);
                state.rays.extend(rays.filter(is_due));
            }
        }
        watch.lap(&mut times.prepare);
        groups.par_iter_mut().with_max_len(1).for_each(|state| self.forward(state, &batch, frame, posed));
        let mut watch = Stopwatch::start();
        let mut report = StepReport { step: step + 1, rays: batch.pixels.len(), ..StepReport::default() };
        let mut photometric = std::mem::take(&mut self.photometric);
        let measured =
            photometric.measure(loss, self.lpips.as_ref(), &groups, &batch, (&frame.labels, &shown), &mut report);
        if let Err(error) = measured {
            (self.groups, self.batch, self.photometric, self.posed) = (groups, batch, photometric, own_posed);
            return Err(error);
        }
        let d_colors = &photometric.d_colors;
        self.field.mlp.transposed_weights(self.parameters.get(Part::Field), &mut self.transposed);
        watch.lap(&mut times.losses);
        let each = groups.par_iter_mut().with_max_len(1);
        each.for_each(|state| self.backward(state, &batch, frame, posed, d_colors));
        groups.iter().for_each(|state| times += state.times);
        let nominal = (batch.pixels.len() * self.config.samples) as f64;
        report.completeness = groups.iter().map(|g| g.completeness).sum::<f64>() / nominal;
        report.live_samples = groups.iter().map(|g| g.along.len()).sum();
        let loss = &self.config.loss;
        report.loss = f64::from(loss.mse) * report.mse
            + f64::from(loss.perceptual) * report.perceptual
            + f64::from(loss.completeness) * report.completeness;
        self.reduce(&groups, frame, posed, &mut times);
        let mut watch = Stopwatch::start();
        if self.config.surface.visibility == VisibilityKind::Counted {
            groups.iter().for_each(|state| self.counts.add(&state.terminations));
        }
        let decay = self.config.rates.final_fraction.powf(step as f32 / self.config.steps.max(1) as f32);
        report.bad_gradients = self.parameters.step(&self.config.rates, decay * self.restarts.rates());
        for state in &groups {
            let subject = |ray: &&usize| frame.labels.at(batch.pixels[**ray]) == Label::Subject;
            let composites = state.rays.iter().zip(&state.composites).filter(|(ray, _)| subject(ray));
            composites.for_each(|(_, composite)| self.restarts.note(composite.opacity));
        }
        if self.restarts.due(step + 1) {
            self.begin_anew();
        }
        report.restarts = self.restarts.count;
        self.refresh_volume();
        watch.lap(&mut times.update);
        report.times = times;
        (self.groups, self.batch, self.photometric, self.posed) = (groups, batch, photometric, own_posed);
        self.steps_done += 1;
        Ok(report)
    }
}

/// The ray through a pixel's centre.
pub(crate) fn pixel_ray(frame: &PreparedFrame, pixel: u32) -> volrender::Ray {
    let width = frame.camera.width;
    frame.camera.ray((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5)
}
