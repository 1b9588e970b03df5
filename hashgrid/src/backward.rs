use rayon::prelude::*;

use crate::corners::{BLOCK, Corners, for_widths, row_mut};
use crate::grid::{HashGrid, Level};
use crate::simd::{Kernel, arch};

impl<const D: usize> HashGrid<D> {
    /// Adds the gradient of the table to `d_table` ([`HashGrid::num_parameters`]), given `points`
    /// (Q, D) and the gradient of their features `d_features` (L, Q, F).
    ///
    /// Levels run in parallel on the current rayon pool; each adds its points in their order, so
    /// that the result does not depend on the number of threads. The encoding is linear in the
    /// table, so its gradient does not depend on the table.
    ///
    /// # Panics
    /// If the length of a slice is wrong.
    pub fn encode_backward(&self, points: &[[f32; D]], d_features: &[f32], d_table: &mut [f32]) {
        self.encode_backward_parts(std::iter::once((points, d_features)), d_table);
    }

    /// [`HashGrid::encode_backward`] for points in several slices, in their order: each level's
    /// table is loaded into the cache once for all of them.
    ///
    /// # Panics
    /// As [`HashGrid::encode_backward`].
    pub fn encode_backward_parts<'a>(
        &self,
        parts: impl Iterator<Item = (&'a [[f32; D]], &'a [f32])> + Clone + Sync,
        d_table: &mut [f32],
    ) {
        self.assert_table("d_table", d_table);
        for (points, d_features) in parts.clone() {
            self.assert_features("d_features", d_features, points.len());
        }
        if parts.clone().all(|(points, _)| points.is_empty()) {
            return;
        }
        let mut levels = Vec::with_capacity(self.levels.len());
        let mut rest = d_table;
        for (l, level) in self.levels.iter().enumerate() {
            let (d_table, after) = rest.split_at_mut(level.rows * self.features);
            levels.push((l, d_table));
            rest = after;
        }
        let arch = arch();
        levels.into_par_iter().with_max_len(1).for_each(|(l, d_table)| {
            let level = &self.levels[l];
            for (points, d_features) in parts.clone() {
                let width = points.len() * self.features;
                let d_features = &d_features[l * width..][..width];
                arch.dispatch(Kernel(
                    #[inline(always)]
                    || for_widths!(self.features, backward_level::<D>(level, points, d_features, d_table)),
                ));
            }
        });
    }
}

#[inline(always)]
fn backward_level<const D: usize, const W: usize>(
    level: &Level,
    points: &[[f32; D]],
    d_features: &[f32],
    d_table: &mut [f32],
    stride: usize,
    offset: usize,
) {
    let mut corners = Corners::new();
    let blocks = points.chunks(BLOCK).zip(d_features.chunks(BLOCK * stride));
    for (points, d_features) in blocks {
        if d_features.iter().all(|&d| d == 0.0) {
            continue;
        }
        corners.fill(level, points);
        let weight = corners.weights::<D>();
        for (b, d_features) in d_features.chunks_exact(stride).enumerate() {
            let d_sum: &[f32; W] = &d_features[offset..].as_chunks::<W>().0[0];
            for k in 0..1 << D {
                let weight = weight[k][b];
                let d_values = row_mut::<W>(d_table, stride, offset, corners.row[k][b]);
                for f in 0..W {
                    d_values[f] += weight * d_sum[f];
                }
            }
        }
    }
}
