use crate::corners::{BLOCK, Corners, MAX_CORNERS, for_widths, spread};
use crate::grid::{HashGrid, Level};
use crate::simd::{Kernel, arch};

/// Points that go through one level before the next level starts: enough to share what it takes to
/// bring a level's table to the cache, few enough for their coordinates to stay there from level to
/// level.
pub(crate) const CHUNK: usize = 1 << 15;

impl<const D: usize> HashGrid<D> {
    /// Encodes `points` (Q, D) with `table` ([`HashGrid::num_parameters`]) into `features` (L, Q,
    /// F), overwritten.
    ///
    /// Runs on the calling thread; split the points to use more. Thousands of points a call are
    /// faster a point than a few, because a level's part of the table then stays in the cache (a
    /// third faster with 16 k than with 4 k where the table is far larger than the cache), and is
    /// brought there once for all of them.
    ///
    /// # Panics
    /// Where a slice has another length.
    pub fn encode(&self, table: &[f32], points: &[[f32; D]], features: &mut [f32]) {
        self.assert_table("table", table);
        self.assert_features("features", features, points.len());
        let arch = arch();
        for (chunk, part) in points.chunks(CHUNK).enumerate() {
            for (l, level) in self.levels.iter().enumerate() {
                let table = &table[self.level_range(l)];
                let features = &mut features[self.features_range(l, points.len(), chunk * CHUNK, part.len())];
                arch.dispatch(Kernel(
                    #[inline(always)]
                    || for_widths!(self.features, encode_level::<D>(level, table, part, features)),
                ));
            }
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
        corners.gather::<D, W>(table, stride, offset, &mut values);
        let weight = corners.weights::<D>();
        let mut sum = [[0.0f32; W]; BLOCK];
        for k in 0..1 << D {
            let weight = spread::<W>(&weight[k]);
            let terms = weight.as_flattened().iter().zip(values[k].as_flattened());
            for (sum, (weight, value)) in sum.as_flattened_mut().iter_mut().zip(terms) {
                *sum += weight * value;
            }
        }
        for (features, sum) in features.chunks_exact_mut(stride).zip(&sum) {
            features[offset..][..W].copy_from_slice(sum);
        }
    }
}
