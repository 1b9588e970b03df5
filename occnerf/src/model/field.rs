//! The field F: [point term ‖ surface term] → density and colour of a batch of samples.

use std::ops::Range;

use glam::Vec3;
use hashgrid::Layout;
use visibility::VisibilityCounts;
use volrender::Aabb;

use crate::Error;
use crate::config::{Config, Method};
use crate::model::arena::Arena;
use crate::model::encoder::{Coordinates, Encoder, fit};
use crate::model::perceptron::{Activations, Mlp};
use crate::model::samples::Samples;
use crate::model::surface_term::{Gather, Mix};
use crate::model::times::{StepTimes, Stopwatch};

/// Samples that pass through the perceptron together; their activations fit a second-level cache.
pub(crate) const BLOCK: usize = 256;
/// Widest layers whose activations are recomputed for the backward pass: writing them to memory and
/// reading them again takes as long, and as much memory as all else that is known of a sample. With
/// wider layers it takes less time.
const NARROW: usize = 64;
/// Outputs of the head: raw density, raw red, green, blue.
const OUTPUTS: usize = 4;
/// Added to distances before they are inverted, normalised metres: a sample may lie on a vertex.
const NEAREST: f32 = 1e-3;

/// What rows of vertices a sample mixes into the second half of F's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum VertexRows {
    /// None: there is no second half.
    None,
    /// γ([v_i, d_i]) of the learnable vertices, the surface term.
    Encoded,
    /// A learnt code a vertex.
    Learnt,
}

/// What a neighbour's share of a sample follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Shares {
    Equal,
    /// How often the vertex was seen: the attention.
    Counts,
    /// The inverse distance of x̂ from the vertex.
    Nearness,
}

/// Shape of the field; its parameters are the caller's.
#[derive(Clone, Debug)]
pub(crate) struct Field {
    pub encoder: Encoder,
    pub mlp: Mlp,
    /// Whether the backward pass recomputes activations.
    pub narrow: bool,
    /// The rows that the input has beside the point term.
    pub vertex_rows: VertexRows,
    shares: Shares,
    /// What counts are multiplied by, V; empty for 1.
    pub count_scale: Vec<f32>,
    /// Nearest vertices whose encodings are blended into the point term; `None` where the sample's
    /// own place is encoded.
    blended: Option<usize>,
    pub density_scale: f32,
    /// Bias at d ≤ 0 and its change per metre up to the reach.
    pub density_bias: (f32, f32),
    pub reach: f32,
    region: Aabb,
}

/// Samples with what the field says of them, and everything that its backward pass needs.
#[derive(Clone, Debug, Default)]
pub(crate) struct SampleBatch {
    pub samples: Samples,
    pub at: Coordinates,
    /// Share of each neighbour of each sample.
    pub attention: Vec<f32>,
    /// Encodings of neighbours, or their gradient, before they are blended.
    blended: Vec<f32>,
    /// The point term, as it lies ([`Encoder::layout`]); after the backward pass its gradient.
    pub features: Vec<f32>,
    /// Where the derivatives of the features by the coordinates are in the arena that
    /// [`Field::forward`] was given.
    pub jacobian: Range<usize>,
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
    /// Where the time of this step went.
    pub times: StepTimes,
}

/// What a field has learnt, as evaluating it reads it.
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
    /// Where each vertex is, and its unit normal.
    pub surface: (&'a [Vec3], &'a [Vec3]),
}

impl Field {
    pub fn new(config: &Config, region: Aabb) -> Result<Self, Error> {
        let encoder = Encoder::new(config)?;
        let (vertex_rows, shares, blended) = match config.method {
            Method::NeuralBody => (VertexRows::Learnt, Shares::Nearness, None),
            Method::SelfNerf => (VertexRows::None, Shares::Nearness, Some(config.surface.k)),
            Method::Occnerf if config.surface.surface_term => {
                let shares = if config.surface.attention { Shares::Counts } else { Shares::Equal };
                (VertexRows::Encoded, shares, None)
            }
            _ => (VertexRows::None, Shares::Equal, None),
        };
        let inputs = encoder.num_features() * (1 + usize::from(vertex_rows != VertexRows::None));
        let reach = config.motion.reach();
        let slope = (config.field.density_bias_outside - config.field.density_bias) / reach;
        Ok(Self {
            mlp: Mlp::new(inputs, &vec![config.field.width; config.field.depth], OUTPUTS),
            narrow: config.field.width <= NARROW,
            encoder,
            vertex_rows,
            shares,
            count_scale: Vec::new(),
            blended,
            density_scale: config.field.density_scale,
            density_bias: (config.field.density_bias, slope),
            reach,
            region,
        })
    }

    /// Evaluates density and colour of every sample of the batch. Where gradients of the
    /// coordinates will be asked for, the derivatives that they take are left in `jacobians`.
    pub fn forward(&self, learnt: &Learnt<'_>, batch: &mut SampleBatch, jacobians: Option<&mut Arena>) {
        let (n, width) = (batch.samples.len(), self.encoder.num_features());
        let mut watch = Stopwatch::start();
        match self.blended {
            None => self.encoder.coordinates(&batch.samples, &self.region, &mut batch.at),
            Some(k) => self.neighbour_coordinates(k, learnt, batch),
        }
        fit(&mut batch.features, self.points(n) * width);
        if let Some(arena) = jacobians {
            batch.jacobian = arena.take(n * self.encoder.jacobian_width());
            let jacobian = arena.piece_mut(&batch.jacobian);
            self.encoder.encode_jacobian(learnt.table, batch.at.all(), &mut batch.features, jacobian);
        } else {
            self.encoder.encode(learnt.table, batch.at.all(), &mut batch.features);
        }
        watch.lap(&mut batch.times.encode);
        self.share(learnt, batch);
        batch.sigma.resize(n, 0.0);
        batch.rgb.resize(n, Vec3::ZERO);
        let kept = if self.narrow { 1 } else { n.div_ceil(BLOCK) };
        batch.blocks.resize_with(kept.max(batch.blocks.len()), Activations::default);
        for (block, range) in self.blocks(n) {
            self.activate(learnt.perceptron, learnt.vertices, range.clone(), batch, block);
            for (s, raw) in range.zip(batch.blocks[block].outputs()) {
                batch.sigma[s] = self.density_scale * softplus(raw[0] + self.bias(batch.samples.distance[s]));
                let base = batch.samples.base(s);
                batch.rgb[s] = (base.truncate() + base.w * Vec3::from_slice(&raw[1..4])).map(sigmoid);
            }
        }
        watch.lap(&mut batch.times.perceptron);
    }

    /// Samples that pass through the perceptron together, and which of [`SampleBatch::blocks`] is
    /// theirs.
    pub fn blocks(&self, samples: usize) -> impl Iterator<Item = (usize, Range<usize>)> {
        let kept = usize::from(!self.narrow);
        (0..samples).step_by(BLOCK).map(move |start| (kept * start / BLOCK, start..(start + BLOCK).min(samples)))
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
        match self.blended {
            None => self.encoder.layout(n).to_rows(&batch.features, range.clone(), input, row),
            Some(k) => {
                let points = k * range.start..k * range.end;
                fit(&mut batch.blended, points.len() * width);
                self.encoder.layout(k * n).to_rows(&batch.features, points.clone(), &mut batch.blended, width);
                let each = batch.blended.chunks_exact(k * width).zip(batch.attention[points].chunks_exact(k));
                for (input, (rows, shares)) in input.chunks_exact_mut(row).zip(each) {
                    input[..width].fill(0.0);
                    for (row, &share) in rows.chunks_exact(width).zip(shares) {
                        input.iter_mut().zip(row).for_each(|(sum, x)| *sum = share.mul_add(*x, *sum));
                    }
                }
            }
        }
        input.chunks_exact_mut(row).for_each(|input| input[width..].fill(0.0));
        if self.vertex_rows != VertexRows::None {
            let mix = Mix::new(width, row, range.clone(), &batch.samples, &batch.attention);
            pulp::Arch::new().dispatch(Gather { mix, rows: vertex_features, input });
        }
        self.mlp.forward(mlp, activations, range.len());
    }

    /// Gradient of the point term, as it lies, from that of the input rows of the samples in
    /// `range`.
    pub fn point_term_backward(&self, range: Range<usize>, batch: &mut SampleBatch) {
        let (width, row, layout) = (self.encoder.num_features(), self.mlp.input_width(), self.layout(batch));
        let SampleBatch { features, d_input, blended, attention, .. } = batch;
        let Some(k) = self.blended else { return layout.from_rows(d_input, row, range, features) };
        let points = k * range.start..k * range.end;
        fit(blended, points.len() * width);
        let each = blended.chunks_exact_mut(k * width).zip(attention[points.clone()].chunks_exact(k));
        for (d_input, (d_rows, shares)) in d_input.chunks_exact(row).zip(each) {
            for (d_row, &share) in d_rows.chunks_exact_mut(width).zip(shares) {
                d_row.iter_mut().zip(d_input).for_each(|(d, x)| *d = share * x);
            }
        }
        layout.from_rows(blended, width, points, features);
    }

    /// Whether samples are to have their neighbours.
    pub fn reads_neighbours(&self) -> bool {
        self.vertex_rows != VertexRows::None || self.blended.is_some()
    }

    /// Number of points that are encoded for `samples` samples.
    pub fn points(&self, samples: usize) -> usize {
        samples * self.blended.unwrap_or(1)
    }

    /// How the point term of a batch lies.
    pub fn layout(&self, batch: &SampleBatch) -> Layout {
        self.encoder.layout(self.points(batch.samples.len()))
    }

    /// Where the `k` nearest vertices of each sample are encoded, d_i the height of x̂ over the
    /// tangent plane of v_i.
    fn neighbour_coordinates(&self, k: usize, learnt: &Learnt<'_>, batch: &mut SampleBatch) {
        let (samples, (vertices, normals)) = (&batch.samples, learnt.surface);
        let stored = samples.neighbours.len().checked_div(samples.len()).unwrap_or(0).max(1);
        batch.at.clear();
        for (&x, neighbours) in samples.canonical.iter().zip(samples.neighbours.chunks_exact(stored)) {
            for v in neighbours[..k].iter().map(|&v| v as usize) {
                let height = (x - vertices[v]).dot(normals[v]);
                self.encoder.push_vertex(vertices[v], height, &self.region, &mut batch.at);
            }
        }
    }

    /// The shares of the neighbours of each sample, which add up to 1: of all of them for rows of
    /// vertices, of the nearest for a blend.
    fn share(&self, learnt: &Learnt<'_>, batch: &mut SampleBatch) {
        let SampleBatch { samples, attention, .. } = batch;
        attention.clear();
        if !self.reads_neighbours() {
            return;
        }
        let stored = samples.neighbours.len().checked_div(samples.len()).unwrap_or(1).max(1);
        let used = self.blended.unwrap_or(stored);
        attention.resize(samples.len() * used, 1.0 / used as f32);
        let rows = samples.neighbours.chunks_exact(stored).zip(attention.chunks_exact_mut(used));
        match self.shares {
            Shares::Equal => {}
            Shares::Counts if self.count_scale.is_empty() => {
                rows.for_each(|(neighbours, out)| learnt.counts.attention(neighbours, out));
            }
            Shares::Counts => {
                let scale = &self.count_scale;
                rows.for_each(|(neighbours, out)| learnt.counts.attention_scaled(scale, neighbours, out));
            }
            Shares::Nearness => {
                for ((neighbours, out), x) in rows.zip(&samples.canonical) {
                    let each = out.iter_mut().zip(neighbours);
                    each.for_each(|(w, &v)| *w = (x.distance(learnt.surface.0[v as usize]) + NEAREST).recip());
                    let sum: f32 = out.iter().sum();
                    out.iter_mut().for_each(|w| *w /= sum);
                }
            }
        }
    }

    pub fn bias(&self, distance: f32) -> f32 {
        self.density_bias.0 + self.density_bias.1 * distance.clamp(0.0, self.reach)
    }
}

/// ln(1 + eˣ) without overflow.
pub(crate) fn softplus(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
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
