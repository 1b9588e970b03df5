//! The two halves of a training step that rays go through, group by group.

use glam::Vec3;
use smpl::MotionFrame;
use volrender::{Composite, RandomStream, RaySamples, SampleGradients, composite_backward};

use crate::model::encoder::VertexCode;
use crate::model::field::SampleBatch;
use crate::model::march::{March, MarchOptions, PosedSurface, Segment, Segments, Tracer, composite_rays};
use crate::model::trained::Model;
use crate::scene::labels::Label;
use crate::scene::prepared::PreparedFrame;
use crate::train::backward::volume_backward;
use crate::train::batch::Batch;
use crate::train::loss::completeness;

const JITTER: u64 = 0x4A49_5454;

/// Losses and counts of a training step.
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
    /// PSNR over the known pixels of the step, decibels.
    pub psnr: f64,
    /// Live samples that were evaluated.
    pub live_samples: usize,
    /// Rays traced.
    pub rays: usize,
    /// Gradients that were not finite and were left out.
    pub bad_gradients: usize,
}

/// Rays that one thread takes through a step, with gradient buffers of their own.
#[derive(Default)]
pub(crate) struct RayGroup {
    /// Indices into the batch of this group's rays.
    pub rays: Vec<usize>,
    /// Samples evaluated together, front to back.
    pub segments: Segments,
    /// The samples of all segments, ray by ray.
    pub ordered: OrderedSamples,
    pub composites: Vec<Composite>,
    pub d_mlp: Vec<f32>,
    pub d_vertices: Vec<f32>,
    pub d_volume: Vec<f32>,
    /// Sum of the completeness terms.
    pub completeness: f64,
    /// Finest neighbours of the termination points.
    pub terminations: Vec<u32>,
}

/// Choices of a step that do not change its result, which tests vary.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StepOptions {
    pub march: MarchOptions,
    /// Whether rays at unknown pixels evaluate only samples inside the prior: others have no
    /// gradient.
    pub skips_unknown: bool,
}

/// Inputs of every group of a step.
pub(crate) struct Step<'a> {
    pub model: &'a Model,
    pub surface: &'a PosedSurface,
    pub motion: &'a MotionFrame<'a>,
    pub frame: &'a PreparedFrame,
    pub batch: &'a Batch,
    pub vertex_code: &'a VertexCode,
    pub options: StepOptions,
}

impl Step<'_> {
    /// Traces, encodes, evaluates and composites the rays of a group. Samples outside the prior at
    /// an unknown pixel are dead: no photometric term reads that ray, and completeness only the
    /// inside.
    pub fn forward(&self, group: &mut RayGroup) {
        let Self { model, frame, batch, .. } = *self;
        let config = &model.config;
        let tracer = Tracer { model, surface: self.surface, extent: &model.extent, frame: self.motion };
        let RayGroup { rays, segments, ordered, composites, terminations, .. } = group;
        let label = |ray: usize| frame.labels.at(batch.pixels[ray]);
        let marches = rays.iter().map(|&ray| {
            let jitter = RandomStream::new(&[config.seed, JITTER, model.steps_done, ray as u64]);
            let hidden = label(ray) == Label::Unknown && self.options.skips_unknown;
            March::new(frame.view.pixel_ray(batch.pixels[ray]), Some(jitter)).only_inside(hidden)
        });
        segments.march(&tracer, marches, self.options.march, |samples| {
            model.evaluate(self.vertex_code, samples);
        });
        ordered.gather(segments);
        ordered.composite(batch.background, composites);
        terminations.clear();
        for (index, &ray) in rays.iter().enumerate() {
            let composite = &composites[index];
            let visible = label(ray) == Label::Subject && composite.opacity > 0.5;
            if let Some(t) = composite.termination.filter(|_| visible) {
                let nearest = ordered.neighbours(segments, index, t as usize, config.surface.k);
                terminations.extend_from_slice(nearest);
            }
        }
    }

    /// Backward of [`Step::forward`] with the completeness term added. `transposed` are the
    /// perceptron's weights, `d_colors` the gradients of the batch's rays.
    pub fn backward(&self, group: &mut RayGroup, transposed: &[f32], d_colors: &[Vec3]) {
        let Self { model, batch, .. } = *self;
        let RayGroup { rays, segments, ordered, .. } = group;
        ordered.composite_backward(batch.background, rays.iter().map(|&ray| d_colors[ray]), segments);
        let learnt = model.learnt(self.vertex_code);
        zero(&mut group.d_mlp, learnt.perceptron.len());
        zero(&mut group.d_vertices, learnt.vertices.len());
        if let Some(volume) = model.volume() {
            zero(&mut group.d_volume, volume.weights.len());
        }
        group.completeness = 0.0;
        let loss = &model.config.loss;
        let scale = loss.completeness / (batch.pixels.len() * model.config.samples) as f32;
        for Segment { batch, .. } in segments.all_mut() {
            if loss.completeness > 0.0 {
                for s in (0..batch.samples.len()).filter(|&s| batch.samples.distance[s] < 0.0) {
                    let (value, slope) = completeness(batch.sigma[s]);
                    group.completeness += f64::from(value);
                    batch.d_sigma[s] += scale * slope;
                }
            }
            model.field.backward(&learnt, transposed, batch, &mut group.d_mlp, &mut group.d_vertices);
            if let Some(volume) = model.volume() {
                volume_backward(model, volume, self.motion, batch, &mut group.d_volume);
            }
        }
    }
}

/// Makes `buffer` `len` zeros.
pub(crate) fn zero(buffer: &mut Vec<f32>, len: usize) {
    buffer.clear();
    buffer.resize(len, 0.0);
}

/// The samples of segments, ray by ray, and their gradients.
#[derive(Default)]
pub(crate) struct OrderedSamples {
    /// First sample of each ray, and the end of the last.
    starts: Vec<usize>,
    /// Number of finished rays of each segment.
    done: Vec<usize>,
    /// Segment, and place in it, of each sample.
    places: Vec<(usize, usize)>,
    sigma: Vec<f32>,
    likelihood: Vec<f32>,
    delta: Vec<f32>,
    t: Vec<f32>,
    rgb: Vec<Vec3>,
    weights: Vec<f32>,
    d_sigma: Vec<f32>,
    d_rgb: Vec<Vec3>,
    d_likelihood: Vec<f32>,
}

impl OrderedSamples {
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// Takes the samples from their segments.
    pub fn gather(&mut self, segments: &Segments) {
        self.starts.clear();
        self.starts.push(0);
        self.places.clear();
        let done = &mut self.done;
        done.clear();
        done.resize(segments.all().len(), 0);
        for ray in 0..segments.num_rays() {
            for (r, segment) in segments.all().iter().enumerate() {
                if segment.rays.get(done[r]) != Some(&ray) {
                    break;
                }
                let samples = segment.batch.samples.starts[done[r]]..segment.batch.samples.starts[done[r] + 1];
                self.places.extend(samples.map(|s| (r, s)));
                done[r] += 1;
            }
            self.starts.push(self.places.len());
        }
        let places = &self.places;
        let batch = |r: usize| &segments.all()[r].batch;
        let fill = |to: &mut Vec<f32>, from: &dyn Fn(&SampleBatch) -> &[f32]| {
            to.clear();
            to.extend(places.iter().map(|&(r, s)| from(batch(r))[s]));
        };
        fill(&mut self.sigma, &|b| &b.sigma);
        fill(&mut self.likelihood, &|b| &b.samples.likelihood);
        fill(&mut self.delta, &|b| &b.samples.delta);
        fill(&mut self.t, &|b| &b.samples.t);
        self.rgb.clear();
        self.rgb.extend(places.iter().map(|&(r, s)| batch(r).rgb[s]));
    }

    /// Composites every ray.
    pub fn composite(&mut self, background: Vec3, composites: &mut Vec<Composite>) {
        let Self { starts, sigma, likelihood, delta, t, rgb, weights, .. } = self;
        let samples = RaySamples { sigma, likelihood, delta, t, rgb };
        composite_rays(starts, samples, background, weights, composites);
    }

    /// Backward of [`OrderedSamples::composite`], into the segments' batches; `d_colors` of each
    /// ray.
    pub fn composite_backward(
        &mut self,
        background: Vec3,
        d_colors: impl Iterator<Item = Vec3>,
        segments: &mut Segments,
    ) {
        let n = self.places.len();
        self.d_sigma.resize(n, 0.0);
        self.d_rgb.resize(n, Vec3::ZERO);
        self.d_likelihood.resize(n, 0.0);
        let Self { starts, sigma, likelihood, delta, t, rgb, weights, d_sigma, d_rgb, d_likelihood, .. } = self;
        let samples = RaySamples { sigma, likelihood, delta, t, rgb };
        for (ends, d_color) in starts.windows(2).zip(d_colors) {
            let range = ends[0]..ends[1];
            let gradients = SampleGradients {
                d_sigma: &mut d_sigma[range.clone()],
                d_rgb: &mut d_rgb[range.clone()],
                d_likelihood: &mut d_likelihood[range.clone()],
            };
            let weights = &weights[range.clone()];
            composite_backward(samples.slice(range), background, weights, d_color, 0.0, gradients);
        }
        for Segment { batch, .. } in segments.all_mut() {
            let n = batch.samples.len();
            batch.d_sigma.resize(n, 0.0);
            batch.d_rgb.resize(n, Vec3::ZERO);
            batch.d_likelihood.resize(n, 0.0);
        }
        for (i, &(r, s)) in self.places.iter().enumerate() {
            let batch = &mut segments.all_mut()[r].batch;
            batch.d_sigma[s] = self.d_sigma[i];
            batch.d_rgb[s] = self.d_rgb[i];
            batch.d_likelihood[s] = self.d_likelihood[i];
        }
    }

    /// The finest `k` neighbours of a ray's sample; none where samples have no neighbours.
    pub fn neighbours<'a>(&self, segments: &'a Segments, ray: usize, sample: usize, k: usize) -> &'a [u32] {
        let (r, s) = self.places[self.starts[ray] + sample];
        let samples = &segments.all()[r].batch.samples;
        let per_sample = samples.neighbours.len() / samples.len();
        if per_sample == 0 { &[] } else { &samples.neighbours[s * per_sample..][..k] }
    }
}

#[cfg(test)]
mod tests {
    use synth::{DemoConfig, demo};

    use super::StepReport;
    use crate::config::{Config, Method, MotionKind, Preset};
    use crate::model::field::Part;
    use crate::model::march::MarchOptions;
    use crate::scene::prepared::Scene;
    use crate::train::step::StepOptions;
    use crate::train::trainer::Trainer;

    /// Some steps with all samples, to make the surface opaque, and one more as `config` has it:
    /// its report, the colours of its rays and the gradients.
    fn step(scene: &Scene, config: &Config) -> (StepReport, Vec<glam::Vec3>, [Vec<f32>; 2]) {
        let mut trainer = Trainer::new(scene, Config { min_transmittance: 0.0, ..config.clone() }).unwrap();
        for _ in 0..60 {
            trainer.step().unwrap();
        }
        let march = MarchOptions { segment: 6, min_transmittance: config.min_transmittance };
        let report = trainer.step_with(StepOptions { march, skips_unknown: true }).unwrap();
        let colors = trainer.buffers.groups.iter().flat_map(|g| g.composites.iter().map(|c| c.color)).collect();
        let gradients = [Part::Field, Part::Table].map(|part| trainer.optimiser.gradients.get(part).to_vec());
        (report, colors, gradients)
    }

    /// One step of the volume motion, whose gradients pass through everything, and of the surface
    /// motion.
    #[test]
    fn what_lies_outside_the_prior_at_unknown_pixels_has_no_gradient() {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 40, frames: 4, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        let (surface, volume) = ((Preset::Fast, MotionKind::Surface), (Preset::Paper, MotionKind::Volume));
        for ((preset, motion), density_scale) in [(surface, 25.0), (volume, 25.0), (volume, 4.0)] {
            let mut config = Config::preset(preset, Method::Occnerf);
            config.motion.kind = motion;
            config.surface.surface_term = true;
            config.field.prior_colors &= motion == MotionKind::Surface;
            (config.patches, config.patch_size, config.samples, config.seed) = (4, 24, 48, 2);
            (config.loss.perceptual, config.min_transmittance) = (0.0, 0.0);
            config.encoding.log2_table_size = 12;
            // The smaller one has densities below β inside, which completeness pushes up.
            config.field.density_scale = density_scale;
            let scene = Scene::new(&capture, &body, &config).unwrap();
            let [all, few] = [false, true].map(|skips_unknown| {
                let mut trainer = Trainer::new(&scene, config.clone()).unwrap();
                let march = MarchOptions::training(config.min_transmittance);
                let report = trainer.step_with(StepOptions { march, skips_unknown }).unwrap();
                let parts = [Part::Field, Part::Table, Part::Vertices, Part::Motion];
                (
                    report,
                    parts.map(|part| trainer.optimiser.gradients.get(part).to_vec()),
                    trainer.model().visibility_counts().to_vec(),
                )
            });
            let (live, less) = (all.0.live_samples, few.0.live_samples);
            assert!(live > 1000 && 20 * less < 19 * live, "{preset:?}: {less} of {live} samples");
            assert!((all.0.loss - few.0.loss).abs() < 1e-6 * all.0.loss, "{} {}", all.0.loss, few.0.loss);
            assert_eq!(all.2, few.2);
            for (all, few) in all.1.iter().zip(&few.1).filter(|(all, _)| !all.is_empty()) {
                let difference = largest_difference(all, few);
                assert!(difference < 1e-5, "{preset:?}: {difference}");
            }
        }
    }

    fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
        assert_eq!(a.len(), b.len());
        let largest = a.iter().map(|x| x.abs()).fold(0.0, f32::max);
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / largest
    }

    #[test]
    fn segments_change_nothing_and_samples_behind_an_opaque_surface_next_to_nothing() {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 40, frames: 4, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        (config.patches, config.patch_size, config.steps) = (2, 16, 100);
        config.field.density_scale *= 30.0;
        config.surface.surface_term = true;
        // That of the samples that are evaluated is another one.
        config.loss.completeness = 0.0;
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let at = |min_transmittance| step(&scene, &Config { min_transmittance, ..config.clone() });
        let (all, all_colors, all_gradients) = at(0.0);
        // In many segments, until nothing at all shines through.
        let (same, same_colors, same_gradients) = at(f32::MIN_POSITIVE);
        assert!(same.live_samples <= all.live_samples && all.live_samples > 1000, "{}", same.live_samples);
        for (a, b) in all_colors.iter().zip(&same_colors) {
            assert!((*a - *b).abs().max_element() < 1e-6, "{a} {b}");
        }
        assert!((same.loss - all.loss).abs() < 1e-4 * all.loss, "{} {}", same.loss, all.loss);
        for (all, same) in all_gradients.iter().zip(&same_gradients) {
            let difference = largest_difference(all, same);
            assert!(difference < 1e-4, "{difference}");
        }
        let (less, less_colors, less_gradients) = at(1e-3);
        let share = less.live_samples as f64 / all.live_samples as f64;
        assert!(share < 0.9, "{share} of the samples");
        for (a, b) in all_colors.iter().zip(&less_colors) {
            assert!((*a - *b).abs().max_element() < 1.1e-3, "{a} {b}");
        }
        for (all, less) in all_gradients.iter().zip(&less_gradients) {
            let difference = largest_difference(all, less);
            assert!(difference < 0.02, "{difference}");
        }
    }
}
