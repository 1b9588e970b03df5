use crate::corners::{BLOCK, Corners, MAX_CORNERS, for_widths, interpolate_with_gradient, row};
use crate::grid::{HashGrid, Level};
use crate::simd::{Kernel, arch};

impl<const D: usize> HashGrid<D> {
    /// Adds the gradient of the coordinates to `d_points` (Q, D), given `table`, `points` (Q, D)
    /// and the gradient of their features `d_features` (L, Q, F). Runs on the calling thread.
    ///
    /// The encoding is d-linear within a cell and continuous across cells: on a face the derivative
    /// is that of the upper cell (at x = 1, of the last cell). Coordinates outside \[0, 1\] and NaN
    /// get no gradient.
    ///
    /// # Panics
    /// If the length of a slice is wrong.
    pub fn encode_backward_points(
        &self,
        table: &[f32],
        points: &[[f32; D]],
        d_features: &[f32],
        d_points: &mut [[f32; D]],
    ) {
        self.assert_table("table", table);
        self.assert_features("d_features", d_features, points.len());
        assert_eq!(d_points.len(), points.len(), "d_points has {} points, expected {}", d_points.len(), points.len());
        let arch = arch();
        for pass in self.passes(points.len()) {
            let (points, d_points) = (&points[pass.points.clone()], &mut d_points[pass.points]);
            let (level, table, d_features) = (pass.level, &table[pass.table], &d_features[pass.features]);
            arch.dispatch(Kernel(
                #[inline(always)]
                || for_widths!(self.features, level_backward_points::<D>(level, table, points, d_features, d_points)),
            ));
        }
    }
}

#[inline(always)]
fn level_backward_points<const D: usize, const W: usize>(
    level: &Level,
    table: &[f32],
    points: &[[f32; D]],
    d_features: &[f32],
    d_points: &mut [[f32; D]],
    stride: usize,
    offset: usize,
) {
    let n = level.resolution as f32;
    let mut corners = Corners::new();
    let mut dots = [[0.0f32; BLOCK]; MAX_CORNERS];
    let blocks = points.chunks(BLOCK).zip(d_features.chunks(BLOCK * stride)).zip(d_points.chunks_mut(BLOCK));
    for ((points, d_features), d_points) in blocks {
        corners.fill(level, points);
        for (b, d_features) in d_features.chunks_exact(stride).enumerate() {
            let d_sum: &[f32; W] = &d_features[offset..].as_chunks::<W>().0[0];
            for k in 0..1 << D {
                let values = row::<W>(table, stride, offset, corners.row[k][b]);
                let mut dot = 0.0;
                for f in 0..W {
                    dot += values[f] * d_sum[f];
                }
                dots[k][b] = dot;
            }
        }
        let gradient = interpolate_with_gradient::<D>(&mut dots, &corners.fraction);
        for j in 0..D {
            for ((point, d_point), partial) in points.iter().zip(&mut *d_points).zip(gradient[j]) {
                if (0.0..=1.0).contains(&point[j]) {
                    d_point[j] += n * partial;
                }
            }
        }
    }
}
