//! Training: a model, an optimiser and the buffers of a step, deterministic whatever the number of
//! threads; and its checkpoints, the model with the state of training, replaced atomically.

use std::path::Path;
use std::sync::Arc;

use lpips::Lpips;
use rayon::prelude::*;
use smpl::MotionFrame;

use crate::Error;
use crate::config::Config;
use crate::model::colors::PriorColors;
use crate::model::encoder::{Encoder, PointEncoder, VertexCode};
use crate::model::field::{Field, PARTS, Part};
use crate::model::march::{CELL, MarchOptions, PosedSurface};
use crate::model::saved::{array, config_of, parse, read, write};
use crate::model::trained::Model;
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::train::adam::Optimiser;
use crate::train::batch::Batch;
use crate::train::photometric::Photometric;
use crate::train::step::{RayGroup, Step, StepOptions, StepReport, zero};

/// Rays are dealt row by row to this many groups, each with its own gradient buffers, summed in
/// order: the result does not depend on who computes a group. Eight keep two to eight threads busy.
const GROUPS: usize = 8;

/// A model in training.
pub struct Trainer<'a> {
    pub(crate) scene: &'a Scene,
    pub(crate) model: Model,
    pub(crate) optimiser: Optimiser,
    /// The perceptual term, where it is not the embedded one.
    lpips: Option<Lpips>,
    pub(crate) buffers: Buffers,
}

/// Buffers of a step, kept for the next one.
pub(crate) struct Buffers {
    pub batch: Batch,
    pub groups: Vec<RayGroup>,
    pub vertex_code: VertexCode,
    pub surface: PosedSurface,
    photometric: Photometric,
    /// Weights of the perceptron, transposed.
    transposed: Vec<f32>,
    d_volume: Vec<f32>,
}

impl<'a> Trainer<'a> {
    /// Begins training at step 0.
    ///
    /// # Errors
    /// A configuration that is not valid or not the one that `scene` was prepared for.
    pub fn new(scene: &'a Scene, config: Config) -> Result<Self, Error> {
        let base = if config.field.prior_colors { scene.colors()?.clone() } else { PriorColors::default() };
        let frames = scene.train.iter().map(|frame| frame.view.clone()).collect();
        let model = Model::new(config, scene.body.clone(), frames, base)?;
        let buffers = Buffers {
            batch: Batch::default(),
            groups: (0..GROUPS).map(|_| RayGroup::default()).collect(),
            vertex_code: VertexCode::default(),
            surface: PosedSurface::new(&scene.body, CELL)?,
            photometric: Photometric::default(),
            transposed: Vec::new(),
            d_volume: Vec::new(),
        };
        let optimiser = Optimiser::new(&model.parameters);
        Ok(Self { scene, model, optimiser, lpips: None, buffers })
    }

    /// Feeds the perceptron with the features of `encoder` in place of the method's, and begins at
    /// step 0. A checkpoint does not hold the encoder: such a run cannot be resumed, nor its model
    /// loaded.
    ///
    /// # Panics
    /// With the surface term, whose vertices no encoder of points encodes.
    #[must_use]
    pub fn with_encoder(mut self, encoder: Arc<dyn PointEncoder>) -> Self {
        let Model { config, body, field, .. } = &mut self.model;
        assert!(!config.has_surface_term(), "the surface term of {} has no encoder", config.method.name());
        *field = Field::new(Encoder::Custom(encoder), config, body.canonical_box);
        self.model.forget();
        self.optimiser = Optimiser::new(&self.model.parameters);
        self
    }

    /// The model as it is now.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The model without optimiser and buffers.
    pub fn into_model(self) -> Model {
        self.model
    }

    /// Loads the weights that `loss.perceptual_weights` names, if it names any: before the first
    /// [`Trainer::step`], also of a resumed run.
    ///
    /// # Errors
    /// Those of [`Lpips::load`] and, for patches too small for the network, of
    /// [`Lpips::check_size`].
    pub fn load_perceptual(&mut self) -> Result<(), Error> {
        let config = &self.model.config;
        if config.loss.perceptual > 0.0 && !config.loss.perceptual_weights.is_empty() {
            let lpips = Lpips::load(config.loss.perceptual_weights.as_ref())?;
            let sides = self.scene.train.iter().map(|f| f.view.camera.width.min(f.view.camera.height));
            let side = sides.min().unwrap_or(0).min(config.patch_size) as usize;
            lpips.check_size(side, side)?;
            self.lpips = Some(lpips);
        }
        Ok(())
    }

    /// Which perceptual term the run is trained with: `ms-ssim`, `lpips` with the network's name,
    /// or `none`.
    pub fn perceptual(&self) -> String {
        match &self.lpips {
            Some(lpips) => format!("lpips {}", lpips.name()),
            None => self.model.config.loss.perceptual_name(),
        }
    }

    /// Steps taken so far.
    pub fn steps_done(&self) -> u64 {
        self.model.steps_done
    }

    /// Changes the number of steps and with it the decay of the learning rates.
    pub fn set_steps(&mut self, steps: u64) {
        self.model.config.steps = steps;
    }

    /// Takes one optimisation step.
    ///
    /// # Errors
    /// [`Error::Data`] where the step's picture cannot be decoded; [`Error::Perceptual`] where
    /// the configuration names weights of the perceptual term and [`Trainer::load_perceptual`] was
    /// not called. The model is then as it was before.
    pub fn step(&mut self) -> Result<StepReport, Error> {
        let march = MarchOptions::training(self.model.config.min_transmittance);
        self.step_with(StepOptions { march, skips_unknown: true })
    }

    pub(crate) fn step_with(&mut self, options: StepOptions) -> Result<StepReport, Error> {
        let Self { scene, model, optimiser, lpips, buffers } = self;
        let Buffers { batch, groups, vertex_code, surface, photometric, transposed, d_volume } = buffers;
        let loss = &model.config.loss;
        if lpips.is_none() && !loss.perceptual_weights.is_empty() && loss.perceptual > 0.0 {
            return Err(Error::Perceptual("its weights were not loaded".to_owned()));
        }
        let step = model.steps_done;
        batch.draw(scene, &model.config, step);
        let frame = &scene.train[batch.frame];
        let shown = frame.reader()?;
        let posed = &frame.view.posed;
        model.encode_vertices(vertex_code);
        let interval = model.config.motion.shell_interval as u64;
        if interval > 0 && step > 0 && step.is_multiple_of(interval) {
            model.extent = model.measure_extent(vertex_code);
        }
        surface.refit(&model.body, posed, &model.extent, &model.config, model.base.light);
        deal(batch, frame, groups);
        let motion = MotionFrame::new(&scene.body.model, posed);
        let pass = Step { model: &*model, surface, motion: &motion, frame, batch, vertex_code, options };
        groups.par_iter_mut().with_max_len(1).for_each(|group| pass.forward(group));
        let mut report = StepReport { step: step + 1, rays: batch.pixels.len(), ..StepReport::default() };
        photometric.measure(loss, lpips.as_ref(), groups, batch, (&frame.labels, &shown), &mut report)?;
        model.field.mlp.transposed_weights(model.parameters.get(Part::Field), transposed);
        let d_colors = &photometric.d_colors;
        groups.par_iter_mut().with_max_len(1).for_each(|group| pass.backward(group, transposed, d_colors));
        let nominal = (batch.pixels.len() * model.config.samples) as f64;
        report.completeness = groups.iter().map(|g| g.completeness).sum::<f64>() / nominal;
        report.live_samples = groups.iter().map(|g| g.ordered.len()).sum();
        report.loss = f64::from(loss.mse) * report.mse
            + f64::from(loss.perceptual) * report.perceptual
            + f64::from(loss.completeness) * report.completeness;
        reduce(model, optimiser, groups, vertex_code, d_volume);
        groups.iter().for_each(|group| model.counts.add(&group.terminations));
        let decay = model.config.rates.final_fraction.powf(step as f32 / model.config.steps.max(1) as f32);
        let rates = &model.config.rates;
        report.bad_gradients = optimiser.step(&mut model.parameters, rates, decay);
        self.model.refresh_volume();
        self.model.steps_done += 1;
        Ok(report)
    }
}

/// Deals the rays of a batch to the groups, row by row. Those at unknown pixels come last in each,
/// so that samples without a gradient are next to each other.
fn deal(batch: &Batch, frame: &PreparedFrame, groups: &mut [RayGroup]) {
    for (index, group) in groups.iter_mut().enumerate() {
        group.rays.clear();
        for unknown in [false, true] {
            let is_due = |&ray: &usize| (frame.labels.at(batch.pixels[ray]) == Label::Unknown) == unknown;
            let rays = (0..batch.pixels.len()).filter(|ray| ray / batch.size % GROUPS == index);
            group.rays.extend(rays.filter(is_due));
        }
    }
}

/// Sums the groups' gradients in order and runs the parts of the backward pass that all samples
/// share.
fn reduce(
    model: &Model,
    optimiser: &mut Optimiser,
    groups: &[RayGroup],
    vertex_code: &mut VertexCode,
    d_volume: &mut Vec<f32>,
) {
    optimiser.clear_gradients();
    let gradients = &mut optimiser.gradients;
    let sum = |to: &mut [f32], from: &(dyn Fn(&RayGroup) -> &[f32] + Sync)| {
        to.par_chunks_mut(1 << 12).enumerate().for_each(|(chunk, to)| {
            for group in groups {
                let from = &from(group)[chunk << 12..][..to.len()];
                to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
            }
        });
    };
    let d_mlp = gradients.get_mut(Part::Field);
    sum(d_mlp, &|g| &g.d_mlp);
    model.field.mlp.clear_padding(d_mlp);
    if model.field.surface_term {
        zero(&mut vertex_code.d_rows, vertex_code.rows.len());
        sum(&mut vertex_code.d_rows, &|g| &g.d_vertices);
        let (table, d_offsets) = (model.parameters.get(Part::Table), gradients.get_mut(Part::Vertices));
        vertex_code.backward(&model.body, &model.field.encoder, table, d_offsets);
    }
    let samples = groups.iter().flat_map(|group| group.segments.all()).map(|segment| &segment.batch);
    let parts = samples.map(|batch| (batch.at.all(), &batch.features[..])).chain(vertex_code.parts());
    model.field.encoder.encode_backward(parts, gradients.get_mut(Part::Table));
    if let Some(volume) = model.volume() {
        zero(d_volume, volume.weights.len());
        sum(d_volume, &|g| &g.d_volume);
        volume.softmax_backward(d_volume, gradients.get_mut(Part::Motion));
    }
}

impl<'a> Trainer<'a> {
    /// Writes the model and the state of training. An old file survives until the new one is
    /// complete and on the disk.
    ///
    /// # Errors
    /// [`Error::Diverged`] where a number is not finite: the old file stays; [`Error::Io`].
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        self.check_finite()?;
        let header = self.model.header(&self.scene.name)?;
        let mut arrays = self.model.arrays();
        for ((_, name), adam) in PARTS.into_iter().zip(&self.optimiser.moments) {
            for (order, moment) in [("first", &adam.first), ("second", &adam.second)] {
                arrays.push(array(format!("{name}.{order}_moment"), &moment[..]));
            }
        }
        write(path, &header, arrays)
    }

    fn check_finite(&self) -> Result<(), Error> {
        for ((part, name), adam) in PARTS.into_iter().zip(&self.optimiser.moments) {
            let values = self.model.parameters.get(part);
            for (suffix, array) in [("", values), (".first_moment", &adam.first), (".second_moment", &adam.second)] {
                if let Some(at) = array.iter().position(|v| !v.is_finite()) {
                    let (step, key) = (self.model.steps_done, format!("{name}{suffix}"));
                    return Err(Error::Diverged { step, key, value: array[at] });
                }
            }
        }
        Ok(())
    }

    /// Resumes from a checkpoint of the same scene and configuration; the number of steps may
    /// differ.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Array`] and [`Error::File`] for a damaged checkpoint, or one of
    /// another scene.
    pub fn resume(scene: &'a Scene, path: &Path) -> Result<Self, Error> {
        let bytes = read(path)?;
        let contents = parse(path, &bytes)?;
        let trained_on = contents.require("scene")?;
        if trained_on != scene.name {
            let what = format!("was trained on scene {trained_on:?}, expected {:?}", scene.name);
            return Err(contents.corrupt(what));
        }
        let config = config_of(&contents)?;
        let mut trainer = Self::new(scene, config).map_err(|e| contents.corrupt(e.to_string()))?;
        trainer.model.restore(&contents)?;
        let steps_done = trainer.model.steps_done;
        for ((part, name), adam) in PARTS.into_iter().zip(&mut trainer.optimiser.moments) {
            let count = trainer.model.parameters.get(part).len();
            adam.first = contents.floats(&format!("{name}.first_moment"), count)?;
            adam.second = contents.floats(&format!("{name}.second_moment"), count)?;
            if let Some(at) = adam.second.iter().position(|&v| v < 0.0) {
                let what = format!("`{name}.second_moment` is {} at {at}, expected at least 0", adam.second[at]);
                return Err(contents.corrupt(what));
            }
            adam.steps = steps_done;
        }
        Ok(trainer)
    }
}
