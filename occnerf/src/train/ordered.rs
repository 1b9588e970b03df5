//! The samples of a march put back into the order of their rays, for compositing and its backward.

use glam::Vec3;
use volrender::{Composite, RaySamples, SampleGradients, composite_backward};

use crate::model::field::SampleBatch;
use crate::model::march::{Segment, Segments, composite_rays};

/// The samples of segments, ray by ray, and their gradients.
#[derive(Default)]
pub(crate) struct OrderedSamples {
    /// First sample of each ray, and the end of the last.
    starts: Vec<usize>,
    /// How many rays of each segment have had their turn.
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
