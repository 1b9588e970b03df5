use crate::corners::{BLOCK, Corners, MAX_CORNERS, for_widths, row};
use crate::grid::{HashGrid, Level};
use crate::simd::{Kernel, arch};

impl<const D: usize> HashGrid<D> {
    /// Encodes `points` (Q, D) with `table` ([`HashGrid::num_parameters`]) into `features` (L, Q,
    /// F), overwritten.
    ///
    /// Runs on the calling thread; split the points to use more. Calls with thousands of points
    /// take less time per point, because each level's table is loaded into the cache once per call
    /// (a third less with 16 k than with 4 k points, if the table is far larger than the cache).
    ///
    /// # Panics
    /// If the length of a slice is wrong.
    pub fn encode(&self, table: &[f32], points: &[[f32; D]], features: &mut [f32]) {
        self.assert_table("table", table);
        self.assert_features("features", features, points.len());
        let arch = arch();
        for pass in self.passes(points.len()) {
            let (table, points, features) = (&table[pass.table], &points[pass.points], &mut features[pass.features]);
            arch.dispatch(Kernel(
                #[inline(always)]
                || for_widths!(self.features, encode_level::<D>(pass.level, table, points, features)),
            ));
        }
    }
}

#[inline(always)]
fn encode_level<const D: usize, const W: usize>(
    level: &Level,
    table: &[f32],
    points: &[[f32; D]],
    features: &mut [f32],
    stride: usize,
    offset: usize,
) {
    let mut corners = Corners::new();
    let mut values = [[[0.0f32; W]; BLOCK]; MAX_CORNERS];
    let blocks = points.chunks(BLOCK).zip(features.chunks_mut(BLOCK * stride));
    for (points, features) in blocks {
        corners.fill(level, points);
        // Loaded up front, which overlaps more cache misses than loading each where it is used.
        for k in 0..1 << D {
            for b in 0..BLOCK {
                values[k][b] = *row::<W>(table, stride, offset, corners.row[k][b]);
            }
        }
        let weight = corners.weights::<D>();
        let mut sum = [[0.0f32; W]; BLOCK];
        for k in 0..1 << D {
            let mut wide = [[0.0; W]; BLOCK];
            for b in 0..BLOCK {
                wide[b] = [weight[k][b]; W];
            }
            let terms = wide.as_flattened().iter().zip(values[k].as_flattened());
            for (sum, (weight, value)) in sum.as_flattened_mut().iter_mut().zip(terms) {
                *sum += weight * value;
            }
        }
        for (features, sum) in features.chunks_exact_mut(stride).zip(&sum) {
            features[offset..][..W].copy_from_slice(sum);
        }
    }
}
