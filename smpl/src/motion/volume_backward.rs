//! Gradients of the weight volumes.

use glam::{Affine3A, Vec3, Vec3A};

use super::volume::{Cell, WeightVolume};

impl WeightVolume {
    /// Propagates the gradient of [`WeightVolume::map`] to the softmaxed weights: ∂x̂/∂w_i = (y_i −
    /// x̂)/Σw, and ∂f/∂w_i = 1 where Σ w < 1, else 0. Adds to `d_weights`, laid out like `weights`.
    ///
    /// Nothing is added for a sample that is dead at any threshold. The gradient with respect to
    /// the point is that of [`super::MotionField::map_backward`]; that with respect to the
    /// transforms is not computed.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn map_backward(
        &self,
        to_canonical: &[Affine3A],
        point: Vec3,
        d_canonical: Vec3,
        d_likelihood: f32,
        d_weights: &mut [f32],
    ) {
        assert_eq!(to_canonical.len(), self.channels - 1, "map_backward: transforms of bones");
        assert_eq!(d_weights.len(), self.weights.len(), "map_backward: d_weights");
        let samples = self.resolution.pow(3);
        let (mut sum, mut mean) = (0.0f32, Vec3A::ZERO);
        let point = Vec3A::from(point);
        // Few bones reach a point; where more do, the rest are looked up again.
        const KEPT: usize = 8;
        let mut kept = [const { None }; KEPT];
        let mut reached = 0;
        for (bone, transform) in to_canonical.iter().enumerate() {
            let y = transform.transform_point3a(point);
            if let Some(cell) = self.cell(bone, y) {
                let w = self.sample(&self.weights[bone * samples..][..samples], &cell);
                sum += w;
                mean += w * y;
                if let Some(slot) = kept.get_mut(reached) {
                    *slot = Some((bone, y, cell));
                }
                reached += 1;
            }
        }
        if sum.is_nan() || sum <= 0.0 {
            return;
        }
        let canonical = mean / sum;
        let d_sum = if sum < 1.0 { d_likelihood } else { 0.0 };
        let d_canonical = Vec3A::from(d_canonical);
        let mut push = |bone: usize, y: Vec3A, cell: &Cell| {
            let d_w = d_canonical.dot(y - canonical) / sum + d_sum;
            let channel = &mut d_weights[bone * samples..][..samples];
            for (corner, mix) in self.corners(cell.corner).into_iter().zip(cell.mix) {
                channel[corner] += mix * d_w;
            }
        };
        for (bone, y, cell) in kept.iter().flatten() {
            push(*bone, *y, cell);
        }
        if reached > KEPT {
            let again = to_canonical.iter().enumerate().filter_map(|(bone, transform)| {
                let y = transform.transform_point3a(point);
                Some((bone, y, self.cell(bone, y)?))
            });
            again.skip(KEPT).for_each(|(bone, y, cell)| push(bone, y, &cell));
        }
    }

    /// Propagates the gradient of [`WeightVolume::update`]: adds w_c (d_c − Σ_k w_k d_k) to
    /// `d_delta`. All three arrays share one layout.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn softmax_backward(&self, d_weights: &[f32], d_delta: &mut [f32]) {
        assert_eq!(d_weights.len(), self.weights.len(), "softmax_backward: d_weights");
        assert_eq!(d_delta.len(), self.weights.len(), "softmax_backward: d_delta");
        let samples = self.resolution.pow(3);
        let mut mean = vec![0.0f32; samples];
        for (w, d) in (self.weights.chunks_exact(samples)).zip(d_weights.chunks_exact(samples)) {
            for i in 0..samples {
                mean[i] += w[i] * d[i];
            }
        }
        let channels = self.weights.chunks_exact(samples).zip(d_weights.chunks_exact(samples));
        for (out, (w, d)) in d_delta.chunks_exact_mut(samples).zip(channels) {
            for i in 0..samples {
                out[i] += w[i] * (d[i] - mean[i]);
            }
        }
    }
}
