use crate::corners::{BLOCK, Corners, for_widths, row};
use crate::grid::{HashGrid, Level};
use crate::simd::Kernel;

/// Points that go through one level before the next level starts: enough for the level's table to stay in the
/// cache from point to point, few enough for the features written to stay there too.
pub(crate) const CHUNK: usize = 16_384;

impl<const D: usize> HashGrid<D> {
    /// Encodes `points` (Q, D) with `table` ([`HashGrid::num_parameters`]) into `features` (Q, L·F), overwritten.
    ///
    /// Runs on the calling thread; split the points to use more. Thousands of points a call are faster a point
    /// than a few, because a level's part of the table then stays in the cache (a third faster with 16 k than with 4 k
    /// where the table is far larger than the cache).
    ///
    /// # Panics
    /// Where a slice has another length.
    pub fn encode(&self, table: &[f32], points: &[[f32; D]], features: &mut [f32]) {
        self.assert_table("table", table);
        self.assert_features("features", features, points.len());
        let width = self.num_features();
        let arch = pulp::Arch::new();
        let chunks = points.chunks(CHUNK).zip(features.chunks_mut(CHUNK * width));
        for (points, features) in chunks {
            for (l, level) in self.levels.iter().enumerate() {
                let table = &table[self.level_range(l)];
                let first = l * self.features;
                arch.dispatch(Kernel(
                    #[inline(always)]
                    || for_widths!(self.features, encode_level::<D>(level, table, points, features, width, first)),
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
    width: usize,
    first: usize,
    stride: usize,
    offset: usize,
) {
    let mut corners = Corners::new();
    let blocks = points.chunks(BLOCK).zip(features.chunks_mut(BLOCK * width));
    for (points, features) in blocks {
        corners.fill(level, points);
        for (b, features) in features.chunks_exact_mut(width).enumerate() {
            let mut sum = [0.0f32; W];
            for k in 0..1 << D {
                let weight = corners.weight[k][b];
                let values = row::<W>(table, stride, offset, corners.row[k][b]);
                for f in 0..W {
                    sum[f] += weight * values[f];
                }
            }
            features[first + offset..][..W].copy_from_slice(&sum);
        }
    }
}
