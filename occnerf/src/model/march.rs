//! The march along rays: samples are traced and evaluated front to back, a segment of every ray at
//! a time, with early termination.

use glam::Vec3;
use volrender::{Composite, RaySamples, composite};

use crate::model::field::SampleBatch;
use crate::model::samples::Samples;
use crate::model::trace::{March, Tracer};

/// How far rays are marched.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MarchOptions {
    /// Live samples of a ray between two tests for termination.
    pub segment: usize,
    /// Transmittance behind which a ray ends; with 0 none does, and all samples are one segment.
    pub min_transmittance: f32,
}

impl MarchOptions {
    /// Segments for training: the samples across a surface. Where few rays terminate, longer
    /// segments make larger batches, which read a table larger than the cache faster.
    pub fn training(min_transmittance: f32) -> Self {
        Self { segment: if min_transmittance < 1e-6 { 24 } else { 6 }, min_transmittance }
    }
}

/// The next samples of some rays.
#[derive(Default)]
pub(crate) struct Segment {
    /// Which of the rays these are, in order.
    pub rays: Vec<usize>,
    pub batch: SampleBatch,
    weights: Vec<f32>,
    composites: Vec<Composite>,
}

impl Segment {
    /// Traces the next samples of every ray that goes on; `evaluate` gives them density and colour.
    /// False where no ray goes on.
    pub fn advance(
        &mut self,
        tracer: &Tracer<'_>,
        marches: &mut [March],
        options: MarchOptions,
        mut evaluate: impl FnMut(&mut SampleBatch),
    ) -> bool {
        let Self { rays, batch, weights, composites } = self;
        let MarchOptions { segment, min_transmittance } = options;
        rays.clear();
        rays.extend((0..marches.len()).filter(|&ray| marches[ray].goes_on(min_transmittance)));
        if rays.is_empty() {
            return false;
        }
        let most = if min_transmittance > 0.0 { segment } else { usize::MAX };
        batch.samples.clear();
        for &ray in &*rays {
            tracer.trace(&mut batch.samples, most, &mut marches[ray]);
        }
        evaluate(batch);
        if min_transmittance > 0.0 {
            composite_batch(batch, Vec3::ZERO, weights, composites);
            for (&ray, composite) in rays.iter().zip(&*composites) {
                marches[ray].pass(composite);
            }
        }
        true
    }
}

/// The segments of rays that have been marched to their ends, kept for the backward pass.
#[derive(Default)]
pub(crate) struct Segments {
    /// Those of this step come first; the others are room for steps that need more.
    all: Vec<Segment>,
    count: usize,
    marches: Vec<March>,
}

impl Segments {
    /// Marches `rays` until all of them have ended.
    pub fn march(
        &mut self,
        tracer: &Tracer<'_>,
        rays: impl Iterator<Item = March>,
        options: MarchOptions,
        mut evaluate: impl FnMut(&mut SampleBatch),
    ) {
        self.count = 0;
        self.marches.clear();
        self.marches.extend(rays);
        loop {
            if self.count == self.all.len() {
                self.all.push(Segment::default());
            }
            if !self.all[self.count].advance(tracer, &mut self.marches, options, &mut evaluate) {
                return;
            }
            self.count += 1;
        }
    }

    /// How many rays there are.
    pub fn num_rays(&self) -> usize {
        self.marches.len()
    }

    /// Front to back.
    pub fn all(&self) -> &[Segment] {
        &self.all[..self.count]
    }

    /// [`Segments::all`], to be changed.
    pub fn all_mut(&mut self) -> &mut [Segment] {
        &mut self.all[..self.count]
    }
}

/// Composites every ray of a batch.
pub(crate) fn composite_batch(
    batch: &SampleBatch,
    background: Vec3,
    weights: &mut Vec<f32>,
    composites: &mut Vec<Composite>,
) {
    let Samples { starts, likelihood, delta, t, .. } = &batch.samples;
    let samples = RaySamples { sigma: &batch.sigma, likelihood, delta, t, rgb: &batch.rgb };
    composite_rays(starts, samples, background, weights, composites);
}

/// Composites rays whose samples stand ray by ray; `starts` has the first sample of each ray, and
/// the end of the last.
pub(crate) fn composite_rays(
    starts: &[usize],
    samples: RaySamples<'_>,
    background: Vec3,
    weights: &mut Vec<f32>,
    composites: &mut Vec<Composite>,
) {
    weights.resize(samples.t.len(), 0.0);
    composites.clear();
    for ends in starts.windows(2) {
        let range = ends[0]..ends[1];
        composites.push(composite(samples.slice(range.clone()), background, &mut weights[range]));
    }
}
