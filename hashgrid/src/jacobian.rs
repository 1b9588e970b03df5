use crate::corners::{BLOCK, Corners, MAX_CORNERS, for_widths, row};
use crate::encode::CHUNK;
use crate::grid::{HashGrid, Level};
use crate::simd::Kernel;

impl<const D: usize> HashGrid<D> {
    /// Length of the Jacobian of `points` points: L·Q·D·F.
    #[must_use]
    pub fn jacobian_len(&self, points: usize) -> usize {
        self.num_features() * D * points
    }

    /// [`HashGrid::encode`], up to rounding, that also writes the derivatives of the features by the coordinates, (L, Q, D, F),
    /// overwritten: where a backward pass to the points follows, [`HashGrid::jacobian_backward`] need not read the table
    /// again, which costs most where it is larger than the cache. Runs on the calling thread.
    ///
    /// On the faces of cells and outside \[0, 1\] the derivatives are those of [`HashGrid::encode_backward_points`].
    ///
    /// # Panics
    /// Where a slice has another length.
    pub fn encode_jacobian(&self, table: &[f32], points: &[[f32; D]], features: &mut [f32], jacobian: &mut [f32]) {
        self.assert_table("table", table);
        self.assert_features("features", features, points.len());
        self.assert_jacobian(jacobian, points.len());
        let (width, block) = (self.num_features(), self.features * D);
        let arch = pulp::Arch::new();
        let chunks = points.chunks(CHUNK).zip(features.chunks_mut(CHUNK * width));
        for (chunk, (points_of, features)) in chunks.enumerate() {
            for (l, level) in self.levels.iter().enumerate() {
                let table = &table[self.level_range(l)];
                let first = l * self.features;
                let start = (l * points.len() + chunk * CHUNK) * block;
                let jacobian = &mut jacobian[start..][..points_of.len() * block];
                arch.dispatch(Kernel(
                    #[inline(always)]
                    || {
                        for_widths!(
                            self.features,
                            level_jacobian::<D>(level, table, points_of, features, jacobian, width, first)
                        )
                    },
                ));
            }
        }
    }

    /// Adds the gradient of the coordinates to `d_points` (Q, D), given what [`HashGrid::encode_jacobian`] wrote and the gradient
    /// of the features `d_features` (Q, L·F). Runs on the calling thread.
    ///
    /// # Panics
    /// Where a slice has another length.
    pub fn jacobian_backward(&self, jacobian: &[f32], d_features: &[f32], d_points: &mut [[f32; D]]) {
        /// Rows of `d_features` that stay in the first-level cache while all levels pass over them.
        const ROWS: usize = 128;
        self.assert_jacobian(jacobian, d_points.len());
        self.assert_features("d_features", d_features, d_points.len());
        let (points, width, block) = (d_points.len(), self.num_features(), self.features * D);
        for (part, (d_points, d_features)) in d_points.chunks_mut(ROWS).zip(d_features.chunks(ROWS * width)).enumerate()
        {
            for l in 0..self.levels.len() {
                let jacobian = &jacobian[(l * points + part * ROWS) * block..];
                let rows = d_features.chunks_exact(width).zip(jacobian.chunks_exact(block));
                for (d_point, (d_row, jacobian)) in d_points.iter_mut().zip(rows) {
                    let d_row = &d_row[l * self.features..][..self.features];
                    for (d, slopes) in d_point.iter_mut().zip(jacobian.chunks_exact(self.features)) {
                        *d += slopes.iter().zip(d_row).map(|(slope, d)| slope * d).sum::<f32>();
                    }
                }
            }
        }
    }

    fn assert_jacobian(&self, jacobian: &[f32], points: usize) {
        let expected = self.jacobian_len(points);
        assert_eq!(jacobian.len(), expected, "jacobian has {} numbers, expected {expected}", jacobian.len());
    }
}

#[inline(always)]
fn level_jacobian<const D: usize, const W: usize>(
    level: &Level,
    table: &[f32],
    points: &[[f32; D]],
    features: &mut [f32],
    jacobian: &mut [f32],
    width: usize,
    first: usize,
    stride: usize,
    offset: usize,
) {
    let n = level.resolution as f32;
    let mut corners = Corners::new();
    let blocks = points.chunks(BLOCK).zip(features.chunks_mut(BLOCK * width));
    for ((points, features), jacobian) in blocks.zip(jacobian.chunks_mut(BLOCK * D * stride)) {
        corners.fill(level, points);
        let rows = features.chunks_exact_mut(width).zip(jacobian.chunks_exact_mut(D * stride));
        for (b, (point, (features, jacobian))) in points.iter().zip(rows).enumerate() {
            let mut values = [[0.0f32; W]; MAX_CORNERS];
            for k in 0..1 << D {
                values[k] = *row::<W>(table, stride, offset, corners.row[k][b]);
            }
            let mut fraction = [0.0; D];
            for j in 0..D {
                fraction[j] = corners.fraction[j][b];
            }
            let slopes = fold(&mut values, fraction);
            features[first + offset..][..W].copy_from_slice(&values[0]);
            for j in 0..D {
                let scale = if (0.0..=1.0).contains(&point[j]) { n } else { 0.0 };
                let out = &mut jacobian[j * stride + offset..][..W];
                for f in 0..W {
                    out[f] = scale * slopes[j][f];
                }
            }
        }
    }
}

/// Interpolates the corners' values into `values[0]`; returns its derivatives along the axes, a cell's side being 1.
#[inline(always)]
fn fold<const D: usize, const W: usize>(values: &mut [[f32; W]; MAX_CORNERS], fraction: [f32; D]) -> [[f32; W]; D] {
    let mut slopes = [[[0.0f32; W]; MAX_CORNERS / 2]; D];
    for axis in (0..D).rev() {
        let (half, t) = (1 << axis, fraction[axis]);
        // The derivatives along the axes that are folded already are interpolated along this one.
        for slope in &mut slopes[axis + 1..] {
            for k in 0..half {
                for f in 0..W {
                    slope[k][f] += t * (slope[half + k][f] - slope[k][f]);
                }
            }
        }
        for k in 0..half {
            for f in 0..W {
                let difference = values[half + k][f] - values[k][f];
                slopes[axis][k][f] = difference;
                values[k][f] += t * difference;
            }
        }
    }
    let mut first = [[0.0; W]; D];
    for j in 0..D {
        first[j] = slopes[j][0];
    }
    first
}
