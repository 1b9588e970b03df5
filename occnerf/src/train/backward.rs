//! Backward passes of the field and of the weight volume over a batch of samples.

use glam::Vec3;
use smpl::{MotionFrame, WeightVolume};

use crate::model::body::{SurfacePoint, surface_point_backward};
use crate::model::field::{Field, Learnt, Mix, Part, SampleBatch, sigmoid};
use crate::model::perceptron::LANES;
use crate::model::trained::Model;

impl Field {
    /// Backward of [`Field::forward`], with the same parameters, from `d_sigma` and `d_rgb`:
    /// accumulates into `d_mlp` and `d_vertices` (V × F), overwrites `features` by their gradient,
    /// and `d_distance`. Samples at the end that have no gradient are passed over.
    ///
    /// `transposed` are the perceptron's weights as [`Mlp::transposed_weights`] has them.
    ///
    /// [`Mlp::transposed_weights`]: crate::model::perceptron::Mlp::transposed_weights
    pub fn backward(
        &self,
        learnt: &Learnt<'_>,
        transposed: &[f32],
        batch: &mut SampleBatch,
        d_mlp: &mut [f32],
        d_vertices: &mut [f32],
    ) {
        let (n, width, row) = (batch.samples.len(), self.encoder.num_features(), self.mlp.input_width());
        batch.d_distance.resize(n, 0.0);
        let reached = |s: &usize| batch.d_sigma[*s] != 0.0 || batch.d_rgb[*s] != Vec3::ZERO;
        let ends = (0..n).rev().find(reached).map_or(0, |s| s + 1);
        batch.d_distance[ends..n].fill(0.0);
        let layout = self.encoder.layout(n);
        layout.clear(ends..n, &mut batch.features);
        for (block, range) in self.blocks(ends) {
            if self.narrow {
                self.activate(learnt.perceptron, learnt.vertices, range.clone(), batch, block);
            }
            batch.d_output.clear();
            batch.d_output.resize(range.len() * LANES, 0.0);
            let outputs = batch.blocks[block].outputs();
            for ((s, raw), d_raw) in range.clone().zip(outputs).zip(batch.d_output.chunks_exact_mut(LANES)) {
                let distance = batch.samples.distance[s];
                d_raw[0] = batch.d_sigma[s] * self.density_scale * sigmoid(raw[0] + self.bias(distance));
                let sloped = distance > 0.0 && distance < self.reach;
                batch.d_distance[s] = if sloped { d_raw[0] * self.density_bias.1 } else { 0.0 };
                let (rgb, d_rgb) = (batch.rgb[s], batch.d_rgb[s]);
                let share = batch.samples.base(s).w;
                (share * d_rgb * rgb * (Vec3::ONE - rgb)).write_to_slice(&mut d_raw[1..4]);
            }
            let (d_output, d_input) = (&mut batch.d_output, &mut batch.d_input);
            self.mlp.backward(transposed, &batch.blocks[block], range.len(), d_output, d_input, d_mlp);
            layout.from_rows(&batch.d_input, row, range.clone(), &mut batch.features);
            if self.surface_term {
                let mix = Mix::new(width, row, range, &batch.samples, &batch.attention);
                pulp::Arch::new().dispatch(Scatter { mix, d_rows: d_vertices, d_input: &batch.d_input });
            }
        }
    }
}

/// Transpose of [`Gather`].
pub(crate) struct Scatter<'a> {
    pub mix: Mix<'a>,
    pub d_rows: &'a mut [f32],
    pub d_input: &'a [f32],
}

impl pulp::WithSimd for Scatter<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Mix { width, per_sample, neighbours, attention, row } = self.mix;
        let each = neighbours.chunks_exact(per_sample).zip(attention.chunks_exact(per_sample));
        for ((neighbours, attention), d_input) in each.zip(self.d_input.chunks_exact(row)) {
            let from = &d_input[width..2 * width];
            for (&v, &a) in neighbours.iter().zip(attention) {
                let d_row = &mut self.d_rows[v as usize * width..][..width];
                for (d, &x) in d_row.iter_mut().zip(from) {
                    *d = a.mul_add(x, *d);
                }
            }
        }
    }
}

/// Carries the gradients of the encoding's coordinates and of f into the weight volume.
pub(crate) fn volume_backward(
    model: &Model,
    volume: &WeightVolume,
    frame: &MotionFrame<'_>,
    batch: &mut SampleBatch,
    d_volume: &mut [f32],
) {
    let encoder = &model.field.encoder;
    let table = model.parameters.get(Part::Table);
    encoder.encode_backward_points(table, batch.at.all(), &batch.features, &mut batch.d_at);
    let samples = &batch.samples;
    let per_sample = samples.neighbours.len().checked_div(samples.len()).unwrap_or(0);
    let on_surface = !batch.at.surface.is_empty();
    for s in 0..samples.len() {
        let (d_point, d_coordinate) = encoder.d_metres(&batch.d_at, s, &model.body.canonical_box);
        let d_likelihood = batch.d_likelihood[s];
        if d_point == Vec3::ZERO && [d_coordinate, batch.d_distance[s], d_likelihood] == [0.0; 3] {
            continue;
        }
        let at = SurfacePoint { closest: samples.closest[s], distance: samples.distance[s] };
        let inside = encoder.distance_is_inside(at.distance);
        let d_at = SurfacePoint {
            closest: if on_surface { d_point } else { Vec3::ZERO },
            distance: batch.d_distance[s] + if inside { d_coordinate } else { 0.0 },
        };
        let (x, neighbours) = (samples.canonical[s], &samples.neighbours[s * per_sample..]);
        let config = &model.config.surface;
        let through_surface = surface_point_backward(&model.body, config, (x, neighbours), at, d_at, Vec3::ZERO);
        let d_canonical = through_surface + if on_surface { Vec3::ZERO } else { d_point };
        volume.map_backward(&frame.to_canonical, samples.world[s], d_canonical, d_likelihood, d_volume);
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec4;
    use visibility::VisibilityCounts;
    use volrender::Aabb;

    use super::*;
    use crate::config::{Config, Method, Preset};
    use crate::model::encoder::Encoder;
    use volrender::RandomStream;

    fn group(n: usize, vertices: usize, per_sample: usize, random: &mut RandomStream) -> SampleBatch {
        let mut group = SampleBatch::default();
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
    fn stored_and_recomputed_activations_give_the_same_bits() {
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        config.surface.surface_term = true;
        let region = Aabb { min: Vec3::splat(-0.1), max: Vec3::splat(1.1) };
        let mut field = Field::new(Encoder::new(&config).unwrap(), &config, region);
        let (n, vertices) = (3 * crate::model::field::BLOCK - 100, 12);
        let mut random = RandomStream::new(&[4]);
        let mut normal = |n: usize| (0..n).map(|_| random.normal()).collect::<Vec<f32>>();
        let (mlp, table) = (field.mlp.initial(1), normal(field.encoder.initial_table(1).len()));
        let features = normal(vertices * field.encoder.num_features());
        let (d_sigma, d_rgb) = (normal(n), normal(3 * n));
        let mut transposed = Vec::new();
        field.mlp.transposed_weights(&mlp, &mut transposed);
        let [recomputed, stored] = [true, false].map(|narrow| {
            field.narrow = narrow;
            let mut group = group(n, vertices, 20, &mut RandomStream::new(&[5]));
            let counts = VisibilityCounts::new(vertices);
            let learnt = Learnt { perceptron: &mlp, table: &table, vertices: &features, counts: &counts };
            field.forward(&learnt, &mut group);
            group.d_sigma.clone_from(&d_sigma);
            group.d_rgb = d_rgb.chunks(3).map(Vec3::from_slice).collect();
            let (mut d_mlp, mut d_features) = (vec![0.0; mlp.len()], vec![0.0; features.len()]);
            field.backward(&learnt, &transposed, &mut group, &mut d_mlp, &mut d_features);
            assert_eq!(group.blocks.len(), if narrow { 1 } else { 3 });
            (group.features, d_mlp, d_features)
        });
        assert!(recomputed == stored && recomputed.1.iter().any(|&d| d != 0.0));
    }
}
