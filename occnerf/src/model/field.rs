//! The field F: [point term ‖ surface term] → density and colour of a batch of samples; and the
//! learnable arrays, in the paper's groups.

use std::ops::Range;

use glam::Vec3;
use visibility::VisibilityCounts;
use volrender::Aabb;

use crate::config::Config;
use crate::model::encoder::{Coordinates, Encoder, fit};
use crate::model::perceptron::{Activations, Mlp};
use crate::model::samples::Samples;

/// Samples that pass through the perceptron together; their activations fit a second-level cache.
pub(crate) const BLOCK: usize = 256;
/// Widest layers whose activations are recomputed for the backward pass: writing them to memory and
/// reading them again takes as long, and as much memory as all else that is known of a sample. With
/// wider layers it takes less time.
const NARROW: usize = 64;
/// Outputs of the head: raw density, raw red, green, blue.
const OUTPUTS: usize = 4;
/// Shape of the field; its parameters are the caller's.
#[derive(Clone, Debug)]
pub(crate) struct Field {
    pub encoder: Encoder,
    pub mlp: Mlp,
    /// Whether the backward pass recomputes activations.
    pub narrow: bool,
    /// Whether the input has the surface term beside the point term.
    pub surface_term: bool,
    /// Whether visibility counts weight the surface term.
    attention: bool,
    pub density_scale: f32,
    /// Bias at d ≤ 0 and its change per metre up to the reach.
    pub density_bias: (f32, f32),
    pub reach: f32,
    region: Aabb,
}

/// Samples, their densities and colours, and all that the field's backward pass needs.
#[derive(Clone, Debug, Default)]
pub(crate) struct SampleBatch {
    pub samples: Samples,
    pub at: Coordinates,
    /// Share of each neighbour of each sample.
    pub attention: Vec<f32>,
    /// The point term, as it lies ([`Encoder::layout`]); after the backward pass its gradient.
    pub features: Vec<f32>,
    /// Activations of each block, or of the last one where they are recomputed.
    pub blocks: Vec<Activations>,
    /// Activated density and colour of each sample.
    pub sigma: Vec<f32>,
    pub rgb: Vec<Vec3>,
    /// Cotangents, filled by the caller.
    pub d_sigma: Vec<f32>,
    pub d_rgb: Vec<Vec3>,
    pub d_likelihood: Vec<f32>,
    /// Gradient of d through the density's bias.
    pub d_distance: Vec<f32>,
    /// Gradient of `at`, where it is asked for.
    pub d_at: Coordinates,
    pub d_output: Vec<f32>,
    pub d_input: Vec<f32>,
}

/// Parameters that evaluating a field reads.
#[derive(Clone, Copy)]
pub(crate) struct Learnt<'a> {
    /// Weights of the perceptron.
    pub perceptron: &'a [f32],
    /// The hash table.
    pub table: &'a [f32],
    /// Features of the vertices, V × F; empty without a surface term.
    pub vertices: &'a [f32],
    /// How often each vertex was seen.
    pub counts: &'a VisibilityCounts,
}

impl Field {
    pub fn new(encoder: Encoder, config: &Config, region: Aabb) -> Self {
        let surface_term = config.has_surface_term();
        let inputs = encoder.num_features() * (1 + usize::from(surface_term));
        let reach = config.motion.reach();
        let slope = (config.field.density_bias_outside - config.field.density_bias) / reach;
        Self {
            mlp: Mlp::new(inputs, &vec![config.field.width; config.field.depth], OUTPUTS),
            narrow: config.field.width <= NARROW,
            encoder,
            surface_term,
            attention: config.surface.attention,
            density_scale: config.field.density_scale,
            density_bias: (config.field.density_bias, slope),
            reach,
            region,
        }
    }

    /// Evaluates density and colour of every sample of the batch.
    pub fn forward(&self, learnt: &Learnt<'_>, batch: &mut SampleBatch) {
        let (n, width) = (batch.samples.len(), self.encoder.num_features());
        self.encoder.coordinates(&batch.samples, &self.region, &mut batch.at);
        fit(&mut batch.features, n * width);
        self.encoder.encode(learnt.table, batch.at.all(), &mut batch.features);
        self.attend(learnt.counts, batch);
        batch.sigma.resize(n, 0.0);
        batch.rgb.resize(n, Vec3::ZERO);
        let stored = if self.narrow { 1 } else { n.div_ceil(BLOCK) };
        batch.blocks.resize_with(stored.max(batch.blocks.len()), Activations::default);
        for (block, range) in self.blocks(n) {
            self.activate(learnt.perceptron, learnt.vertices, range.clone(), batch, block);
            for (s, raw) in range.zip(batch.blocks[block].outputs()) {
                batch.sigma[s] = self.density_scale * softplus(raw[0] + self.bias(batch.samples.distance[s]));
                let base = batch.samples.base(s);
                batch.rgb[s] = (base.truncate() + base.w * Vec3::from_slice(&raw[1..4])).map(sigmoid);
            }
        }
    }

    /// Index in [`SampleBatch::blocks`], and range, of the samples that pass through the perceptron
    /// together.
    pub fn blocks(&self, samples: usize) -> impl Iterator<Item = (usize, Range<usize>)> {
        let stride = usize::from(!self.narrow);
        (0..samples).step_by(BLOCK).map(move |start| (stride * start / BLOCK, start..(start + BLOCK).min(samples)))
    }

    /// Fills the activations `block` with those of the samples in `range`.
    pub fn activate(
        &self,
        mlp: &[f32],
        vertex_features: &[f32],
        range: Range<usize>,
        batch: &mut SampleBatch,
        block: usize,
    ) {
        let (n, width) = (batch.samples.len(), self.encoder.num_features());
        let (row, activations) = (self.mlp.input_width(), &mut batch.blocks[block]);
        self.mlp.resize(activations, range.len());
        let input = &mut activations.layers[0];
        self.encoder.layout(n).to_rows(&batch.features, range.clone(), input, row);
        input.chunks_exact_mut(row).for_each(|input| input[width..].fill(0.0));
        if self.surface_term {
            let mix = Mix::new(width, row, range.clone(), &batch.samples, &batch.attention);
            pulp::Arch::new().dispatch(Gather { mix, rows: vertex_features, input });
        }
        self.mlp.forward(mlp, activations, range.len());
    }

    /// The shares of each sample's neighbours in the surface term, which add up to 1.
    fn attend(&self, counts: &VisibilityCounts, batch: &mut SampleBatch) {
        let SampleBatch { samples, attention, .. } = batch;
        attention.clear();
        if !self.surface_term {
            return;
        }
        let per_sample = samples.neighbours.len().checked_div(samples.len()).unwrap_or(1).max(1);
        attention.resize(samples.neighbours.len(), 1.0 / per_sample as f32);
        if self.attention {
            let rows = samples.neighbours.chunks_exact(per_sample).zip(attention.chunks_exact_mut(per_sample));
            rows.for_each(|(neighbours, out)| counts.attention(neighbours, out));
        }
    }

    pub fn bias(&self, distance: f32) -> f32 {
        self.density_bias.0 + self.density_bias.1 * distance.clamp(0.0, self.reach)
    }
}

/// Which rows each sample mixes, and where the mix stands in its input row: after the point term.
pub(crate) struct Mix<'a> {
    pub width: usize,
    pub per_sample: usize,
    pub neighbours: &'a [u32],
    pub attention: &'a [f32],
    pub row: usize,
}

impl<'a> Mix<'a> {
    pub fn new(width: usize, row: usize, range: Range<usize>, samples: &'a Samples, attention: &'a [f32]) -> Self {
        let per_sample = attention.len().checked_div(samples.len()).unwrap_or(0);
        let range = range.start * per_sample..range.end * per_sample;
        Self { width, per_sample, neighbours: &samples.neighbours[range.clone()], attention: &attention[range], row }
    }
}

/// Adds Σ a_i · row i to the surface term of each input row.
pub(crate) struct Gather<'a> {
    pub mix: Mix<'a>,
    pub rows: &'a [f32],
    pub input: &'a mut [f32],
}

impl pulp::WithSimd for Gather<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Mix { width, per_sample, neighbours, attention, row } = self.mix;
        let each = neighbours.chunks_exact(per_sample).zip(attention.chunks_exact(per_sample));
        for ((neighbours, attention), input) in each.zip(self.input.chunks_exact_mut(row)) {
            let out = &mut input[width..2 * width];
            for (&v, &a) in neighbours.iter().zip(attention) {
                let from = &self.rows[v as usize * width..][..width];
                for (out, &x) in out.iter_mut().zip(from) {
                    *out = a.mul_add(x, *out);
                }
            }
        }
    }
}

/// ln(1 + eˣ) without overflow.
pub(crate) fn softplus(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// A part of the parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// The perceptron F.
    Field,
    /// The hash table, or the parameters of a [`PointEncoder`](crate::PointEncoder).
    Table,
    /// Offsets of the vertices, V × 3; none where they are not learnt.
    Vertices,
    /// Log-weights of the motion volume.
    Motion,
}

/// Every part with its name in checkpoints.
pub(crate) const PARTS: [(Part, &str); 4] =
    [(Part::Field, "field"), (Part::Table, "table"), (Part::Vertices, "vertices"), (Part::Motion, "motion")];

/// An array for each part: values, or their gradients.
#[derive(Clone, Debug)]
pub(crate) struct Parameters(pub [Vec<f32>; 4]);

impl Parameters {
    /// The values that training starts from, for `vertices` vertices and `motion` log-weights.
    pub fn new(config: &Config, field: &Field, vertices: usize, motion: usize) -> Self {
        let moved = field.surface_term && config.rates.vertices > 0.0;
        let offsets = if moved { 3 * vertices } else { 0 };
        let table = field.encoder.initial_table(config.seed);
        Self([field.mlp.initial(config.seed), table, vec![0.0; offsets], vec![0.0; motion]])
    }

    pub fn get(&self, part: Part) -> &[f32] {
        &self.0[part as usize]
    }

    pub fn get_mut(&mut self, part: Part) -> &mut Vec<f32> {
        &mut self.0[part as usize]
    }

    /// Zeros of the same lengths.
    pub fn zeros(&self) -> Self {
        Self(self.0.each_ref().map(|values| vec![0.0; values.len()]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn softplus_and_sigmoid_stay_finite_and_agree_with_each_other() {
        for x in [-1e30, -200.0, -3.0f32, -0.1, 0.0, 0.1, 3.0, 200.0] {
            assert!(softplus(x).is_finite() && sigmoid(x).is_finite());
            let (x, h) = (f64::from(x), 1e-4);
            let exact = |x: f64| x.max(0.0) + (-x.abs()).exp().ln_1p();
            let slope = (exact(x + h) - exact(x - h)) / (2.0 * h);
            assert!((slope - f64::from(sigmoid(x as f32))).abs() < 1e-5);
        }
    }
}
