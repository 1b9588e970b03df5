//! The field F: [point term ‖ surface term] → density and colour, forward and backward over a group of rays.

use std::ops::Range;

use glam::Vec3;
use visibility::VisibilityCounts;
use volrender::Aabb;

use crate::Error;
use crate::config::{AttentionKind, Config, Method};
use crate::model::arena::Arena;
use crate::model::encoder::{Coordinates, Encoder, fit};
use crate::model::gemm::LANES;
use crate::model::perceptron::{Activations, Mlp};
use crate::model::samples::Samples;
use crate::model::surface_term::{Gather, Mix, Scatter};
use crate::model::times::{StepTimes, Stopwatch};

/// Samples that pass through the perceptron together; their activations fit a second-level cache.
const BLOCK: usize = 256;
/// Widest layers whose activations are worked out anew for the backward pass: to write them to memory and to read them again
/// takes as long, and as much memory as all else that is known of a sample. Of wider ones it takes less time.
const NARROW: usize = 64;
/// Outputs of the head: raw density, raw red, green, blue.
const OUTPUTS: usize = 4;

/// Shape of the field; its parameters are the caller's.
#[derive(Clone, Debug)]
pub(crate) struct Field {
    pub encoder: Encoder,
    pub mlp: Mlp,
    /// Whether the backward pass works out the activations anew.
    narrow: bool,
    /// Whether the input has a surface term.
    pub surface_term: bool,
    attention: Option<AttentionKind>,
    density_scale: f32,
    /// Bias at d ≤ 0 and its change per metre up to the reach.
    density_bias: (f32, f32),
    reach: f32,
    region: Aabb,
}

/// A group's samples with everything that its backward pass needs.
#[derive(Clone, Debug, Default)]
pub(crate) struct Group {
    pub samples: Samples,
    pub at: Coordinates,
    /// Attention of each neighbour of each sample.
    attention: Vec<f32>,
    /// The point term, as it lies ([`Encoder::layout`]); after the backward pass its gradient.
    pub features: Vec<f32>,
    /// Where the derivatives of the features by the coordinates are in the arena that [`Field::forward`] was given.
    pub jacobian: Range<usize>,
    /// Of each block, or of the last one where they are worked out anew.
    blocks: Vec<Activations>,
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
    d_output: Vec<f32>,
    d_input: Vec<f32>,
    /// Where the time of this step went.
    pub times: StepTimes,
}

impl Field {
    pub fn new(config: &Config, region: Aabb) -> Result<Self, Error> {
        let encoder = Encoder::new(config)?;
        let surface_term = config.method == Method::Occnerf && config.surface.surface_term;
        let inputs = encoder.num_features() * (1 + usize::from(surface_term));
        let reach = config.motion.margin + config.motion.falloff;
        let slope = (config.field.density_bias_outside - config.field.density_bias) / reach;
        Ok(Self {
            mlp: Mlp::new(inputs, &vec![config.field.width; config.field.depth], OUTPUTS),
            narrow: config.field.width <= NARROW,
            encoder,
            surface_term,
            attention: config.surface.attention.then_some(config.surface.attention_kind),
            density_scale: config.field.density_scale,
            density_bias: (config.field.density_bias, slope),
            reach,
            region,
        })
    }

    /// Density and colour of every sample of the group. `vertex_features` (V × F) is read if there is a surface term. Where
    /// gradients of the coordinates will be asked for, the derivatives that they take are left in `jacobians`.
    pub fn forward(
        &self,
        mlp: &[f32],
        table: &[f32],
        vertex_features: &[f32],
        counts: &VisibilityCounts,
        group: &mut Group,
        jacobians: Option<&mut Arena>,
    ) {
        let (n, width) = (group.samples.len(), self.encoder.num_features());
        let mut watch = Stopwatch::start();
        self.encoder.coordinates(&group.samples, &self.region, &mut group.at);
        fit(&mut group.features, n * width);
        if let Some(arena) = jacobians {
            group.jacobian = arena.take(n * self.encoder.jacobian_width());
            let jacobian = arena.piece_mut(&group.jacobian);
            self.encoder.encode_jacobian(table, group.at.all(), &mut group.features, jacobian);
        } else {
            self.encoder.encode(table, group.at.all(), &mut group.features);
        }
        watch.lap(&mut group.times.encode);
        self.attend(counts, group);
        group.sigma.resize(n, 0.0);
        group.rgb.resize(n, Vec3::ZERO);
        let kept = if self.narrow { 1 } else { n.div_ceil(BLOCK) };
        group.blocks.resize_with(kept.max(group.blocks.len()), Activations::default);
        for (block, range) in self.blocks(n) {
            self.activate(mlp, vertex_features, range.clone(), group, block);
            for (s, raw) in range.zip(group.blocks[block].outputs()) {
                group.sigma[s] = self.density_scale * softplus(raw[0] + self.bias(group.samples.distance[s]));
                let base = group.samples.base(s);
                group.rgb[s] = (base.truncate() + base.w * Vec3::from_slice(&raw[1..4])).map(sigmoid);
            }
        }
        watch.lap(&mut group.times.perceptron);
    }

    /// Samples that pass through the perceptron together, and which of [`Group::blocks`] is theirs.
    fn blocks(&self, samples: usize) -> impl Iterator<Item = (usize, Range<usize>)> {
        let kept = usize::from(!self.narrow);
        (0..samples).step_by(BLOCK).map(move |start| (kept * start / BLOCK, start..(start + BLOCK).min(samples)))
    }

    /// Fills the activations `block` with those of the samples in `range`.
    fn activate(&self, mlp: &[f32], vertex_features: &[f32], range: Range<usize>, group: &mut Group, block: usize) {
        let (n, width) = (group.samples.len(), self.encoder.num_features());
        let (row, activations) = (self.mlp.input_width(), &mut group.blocks[block]);
        self.mlp.resize(activations, range.len());
        let input = &mut activations.layers[0];
        self.encoder.layout(n).to_rows(&group.features, range.clone(), input, row);
        input.chunks_exact_mut(row).for_each(|input| input[width..].fill(0.0));
        if self.surface_term {
            let mix = Mix::new(width, row, range.clone(), &group.samples, &group.attention);
            pulp::Arch::new().dispatch(Gather { mix, rows: vertex_features, input });
        }
        self.mlp.forward(mlp, activations, range.len());
    }

    /// Backward of [`Field::forward`], with the same parameters, from `d_sigma` and `d_rgb`: accumulates into `d_mlp` and
    /// `d_vertices` (V × F), overwrites `features` by their gradient, and `d_distance`. Samples at the end that have no gradient are
    /// passed over.
    pub fn backward(
        &self,
        mlp: &[f32],
        transposed: &[f32],
        vertex_features: &[f32],
        group: &mut Group,
        d_mlp: &mut [f32],
        d_vertices: &mut [f32],
    ) {
        let (n, width) = (group.samples.len(), self.encoder.num_features());
        let (row, layout) = (self.mlp.input_width(), self.encoder.layout(n));
        group.d_distance.resize(n, 0.0);
        let reached = |s: &usize| group.d_sigma[*s] != 0.0 || group.d_rgb[*s] != Vec3::ZERO;
        let ends = (0..n).rev().find(reached).map_or(0, |s| s + 1);
        group.d_distance[ends..n].fill(0.0);
        layout.clear(ends..n, &mut group.features);
        for (block, range) in self.blocks(ends) {
            if self.narrow {
                self.activate(mlp, vertex_features, range.clone(), group, block);
            }
            group.d_output.clear();
            group.d_output.resize(range.len() * LANES, 0.0);
            let outputs = group.blocks[block].outputs();
            for ((s, raw), d_raw) in range.clone().zip(outputs).zip(group.d_output.chunks_exact_mut(LANES)) {
                let distance = group.samples.distance[s];
                d_raw[0] = group.d_sigma[s] * self.density_scale * sigmoid(raw[0] + self.bias(distance));
                let slopes = distance > 0.0 && distance < self.reach;
                group.d_distance[s] = if slopes { d_raw[0] * self.density_bias.1 } else { 0.0 };
                let (rgb, d_rgb) = (group.rgb[s], group.d_rgb[s]);
                let share = group.samples.base(s).w;
                (share * d_rgb * rgb * (Vec3::ONE - rgb)).write_to_slice(&mut d_raw[1..4]);
            }
            let (d_output, d_input) = (&mut group.d_output, &mut group.d_input);
            self.mlp.backward(transposed, &group.blocks[block], range.len(), d_output, d_input, d_mlp);
            layout.from_rows(d_input, row, range.clone(), &mut group.features);
            if self.surface_term {
                let mix = Mix::new(width, row, range, &group.samples, &group.attention);
                pulp::Arch::new().dispatch(Scatter { mix, d_rows: d_vertices, d_input });
            }
        }
    }

    /// a_i / Σ a over the neighbours of each sample.
    fn attend(&self, counts: &VisibilityCounts, group: &mut Group) {
        group.attention.clear();
        if !self.surface_term {
            return;
        }
        let total = group.samples.neighbours.len();
        let per_sample = total.checked_div(group.samples.len()).unwrap_or(1).max(1);
        group.attention.resize(total, 1.0 / per_sample as f32);
        let Some(kind) = self.attention else { return };
        let rows = group.samples.neighbours.chunks_exact(per_sample);
        for (neighbours, out) in rows.zip(group.attention.chunks_exact_mut(per_sample)) {
            match kind {
                AttentionKind::Share => counts.attention(neighbours, out),
                AttentionKind::Softmax => counts.softmax_attention(neighbours, out),
            }
        }
    }

    fn bias(&self, distance: f32) -> f32 {
        self.density_bias.0 + self.density_bias.1 * distance.clamp(0.0, self.reach)
    }
}

/// ln(1 + eˣ) without overflow.
fn softplus(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use glam::Vec4;

    use super::*;
    use crate::config::Preset;
    use crate::random::Stream;

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

    fn group(n: usize, vertices: usize, per_sample: usize, random: &mut Stream) -> Group {
        let mut group = Group::default();
        let s = &mut group.samples;
        for _ in 0..n {
            s.t.push(1.0);
            s.canonical.push(Vec3::new(random.uniform(), random.uniform(), random.uniform()));
            s.closest.push(Vec3::new(random.uniform(), random.uniform(), random.uniform()));
            s.distance.push(random.uniform() * 0.06 + 0.005);
            s.neighbours.extend((0..per_sample).map(|_| random.below(vertices) as u32));
            s.base.push(Vec4::new(random.normal(), random.normal(), random.normal(), random.uniform()));
        }
        group
    }

    #[test]
    fn activations_that_are_kept_and_those_worked_out_anew_give_the_same_bits() {
        let config = Config::preset(Preset::Fast, Method::Occnerf);
        let mut field = Field::new(&config, Aabb { min: Vec3::splat(-0.1), max: Vec3::splat(1.1) }).unwrap();
        let (n, vertices) = (3 * BLOCK - 100, 12);
        let mut random = Stream::new(&[4]);
        let mut normal = |n: usize| (0..n).map(|_| random.normal()).collect::<Vec<f32>>();
        let (mlp, table) = (field.mlp.initial(1), normal(field.encoder.num_parameters()));
        let features = normal(vertices * field.encoder.num_features());
        let (d_sigma, d_rgb) = (normal(n), normal(3 * n));
        let mut transposed = Vec::new();
        field.mlp.transposed_weights(&mlp, &mut transposed);
        let [anew, kept] = [true, false].map(|narrow| {
            field.narrow = narrow;
            let mut group = group(n, vertices, 20, &mut Stream::new(&[5]));
            field.forward(&mlp, &table, &features, &VisibilityCounts::new(vertices), &mut group, None);
            group.d_sigma.clone_from(&d_sigma);
            group.d_rgb = d_rgb.chunks(3).map(Vec3::from_slice).collect();
            let (mut d_mlp, mut d_features) = (vec![0.0; mlp.len()], vec![0.0; features.len()]);
            field.backward(&mlp, &transposed, &features, &mut group, &mut d_mlp, &mut d_features);
            assert_eq!(group.blocks.len(), if narrow { 1 } else { 3 });
            (group.features, d_mlp, d_features)
        });
        assert!(anew == kept && anew.1.iter().any(|&d| d != 0.0));
    }

    /// Every parameter group of every method at once, along random directions.
    #[test]
    fn gradients_of_weights_table_vertices_and_bias_agree_with_central_differences() {
        let region = Aabb { min: Vec3::splat(-0.1), max: Vec3::splat(1.1) };
        for method in [Method::Occnerf, Method::HashPoint, Method::Humannerf] {
            let mut config = Config::preset(Preset::Fast, method);
            (config.field.width, config.field.depth) = (20, 2);
            (config.encoding.levels, config.encoding.n_max, config.encoding.log2_table_size) = (3, 20, 10);
            let field = Field::new(&config, region).unwrap();
            let mut random = Stream::new(&[3, method as u64]);
            let (n, vertices) = (40, 12);
            let mut group = group(n, vertices, 20, &mut random);
            let mut counts = VisibilityCounts::new(vertices);
            counts.add(&[1, 1, 1, 5, 7, 7]);
            let width = field.encoder.num_features();
            let mlp = field.mlp.initial(1);
            let normal = |n: usize, random: &mut Stream| (0..n).map(|_| random.normal()).collect::<Vec<f32>>();
            let table: Vec<f32> = normal(field.encoder.num_parameters(), &mut random);
            let features = normal(vertices * width, &mut random);
            let (c_sigma, c_rgb) = (normal(n, &mut random), normal(3 * n, &mut random));
            let value = |group: &mut Group, mlp: &[f32], table: &[f32], features: &[f32]| -> f64 {
                field.forward(mlp, table, features, &counts, group, None);
                let sigma = group.sigma.iter().zip(&c_sigma).map(|(s, c)| f64::from(s * c) * 0.04);
                let rgb = group.rgb.iter().zip(c_rgb.chunks(3)).map(|(s, c)| f64::from(s.dot(Vec3::from_slice(c))));
                sigma.chain(rgb).sum()
            };
            value(&mut group, &mlp, &table, &features);
            group.d_sigma = c_sigma.iter().map(|c| c * 0.04).collect();
            group.d_rgb = c_rgb.chunks(3).map(Vec3::from_slice).collect();
            let (mut transposed, mut d_mlp) = (Vec::new(), vec![0.0; mlp.len()]);
            field.mlp.transposed_weights(&mlp, &mut transposed);
            let mut d_features = vec![0.0; features.len()];
            field.backward(&mlp, &transposed, &features, &mut group, &mut d_mlp, &mut d_features);
            field.mlp.clear_padding(&mut d_mlp);
            let mut d_table = vec![0.0; table.len()];
            field.encoder.encode_backward(std::iter::once((group.at.all(), &group.features[..])), &mut d_table);
            for direction in 0..6 {
                let mut random = Stream::new(&[17, direction]);
                let mut u_mlp = normal(mlp.len(), &mut random);
                field.mlp.clear_padding(&mut u_mlp);
                let (u_table, u_features) = (normal(table.len(), &mut random), normal(features.len(), &mut random));
                let parts: [(&[f32], &[f32]); 3] = [(&d_mlp, &u_mlp), (&d_table, &u_table), (&d_features, &u_features)];
                for part in 0..3 {
                    let dot = parts[part].0.iter().zip(parts[part].1).map(|(a, b)| f64::from(a * b)).sum::<f64>();
                    let mut at = |h: f32| {
                        let moved = |which: usize, x: &[f32], u: &[f32]| -> Vec<f32> {
                            x.iter().zip(u).map(|(x, u)| x + if which == part { h * u } else { 0.0 }).collect()
                        };
                        let (m, t) = (moved(0, &mlp, &u_mlp), moved(1, &table, &u_table));
                        value(&mut group, &m, &t, &moved(2, &features, &u_features))
                    };
                    let h = 2e-4;
                    let numeric = (at(h) - at(-h)) / (2.0 * f64::from(h));
                    // Some ReLU of some sample switches within any step; their share of the derivative is small.
                    let scale = 0.03 * dot.abs().max(1.0);
                    assert!((numeric - dot).abs() < scale, "{method:?} part {part}: {numeric} {dot}");
                }
            }
        }
    }
}
