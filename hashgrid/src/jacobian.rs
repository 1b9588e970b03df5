use crate::corners::{BLOCK, Corners, MAX_CORNERS, for_widths, interpolate_with_slopes};
use crate::encode::CHUNK;
use crate::grid::{HashGrid, Level};
use crate::simd::{Kernel, arch};

impl<const D: usize> HashGrid<D> {
    /// Length L·Q·D·F of the Jacobian of `points` points.
    pub fn jacobian_len(&self, points: usize) -> usize {
        self.num_features() * D * points
    }

    /// [`HashGrid::encode`], up to rounding, that also writes the derivatives of the features with
    /// respect to the coordinates, (L, Q, D, F), overwritten. [`HashGrid::jacobian_backward`] then
    /// gives the gradient of the points without reading the table again. Runs on the calling thread.
    ///
    /// On cell faces and outside \[0, 1\] the derivatives are those of
    /// [`HashGrid::encode_backward_points`].
    ///
    /// ```
    /// let grid = hashgrid::HashGrid::<2>::with_resolutions(&[2], 1, 4)?;
    /// // Corner (i, j) of the 3 × 3 holds x + 2 y, so that the encoding is this function.
    /// let table: Vec<f32> = (0..9).map(|c| 0.5 * (c % 3 + 2 * (c / 3)) as f32).collect();
    /// let (mut features, mut jacobian) = ([0.0], [0.0; 2]);
    /// grid.encode_jacobian(&table, &[[0.25, 0.75]], &mut features, &mut jacobian);
    /// assert_eq!((features, jacobian), ([1.75], [1.0, 2.0]));
    ///
    /// let mut d_points = [[0.0; 2]];
    /// grid.jacobian_backward(&jacobian, &[10.0], &mut d_points);
    /// assert_eq!(d_points, [[10.0, 20.0]]);
    /// # Ok::<(), hashgrid::Error>(())
    /// ```
    ///
    /// # Panics
    /// If the length of a slice is wrong.
    pub fn encode_jacobian(&self, table: &[f32], points: &[[f32; D]], features: &mut [f32], jacobian: &mut [f32]) {
        self.assert_table("table", table);
        self.assert_features("features", features, points.len());
        self.assert_jacobian(jacobian, points.len());
        let arch = arch();
        for pass in self.passes(points.len(), CHUNK) {
            let jacobian = &mut jacobian[pass.features.start * D..pass.features.end * D];
            let (table, points, features) = (&table[pass.table], &points[pass.points], &mut features[pass.features]);
            arch.dispatch(Kernel(
                #[inline(always)]
                || for_widths!(self.features, level_jacobian::<D>(pass.level, table, points, features, jacobian)),
            ));
        }
    }

    /// Adds the gradient of the coordinates to `d_points` (Q, D), given the Jacobian written by
    /// [`HashGrid::encode_jacobian`] and the gradient of the features `d_features` (L, Q, F).
    /// Runs on the calling thread.
    ///
    /// # Panics
    /// If the length of a slice is wrong.
    pub fn jacobian_backward(&self, jacobian: &[f32], d_features: &[f32], d_points: &mut [[f32; D]]) {
        /// Points per pass, so that their gradients stay in the first-level cache.
        const CHUNK: usize = 512;
        self.assert_jacobian(jacobian, d_points.len());
        self.assert_features("d_features", d_features, d_points.len());
        for pass in self.passes(d_points.len(), CHUNK) {
            let jacobian = &jacobian[pass.features.start * D..pass.features.end * D];
            let (d_features, d_points) = (&d_features[pass.features], &mut d_points[pass.points]);
            for_widths!(self.features, level_jacobian_backward::<D>(jacobian, d_features, d_points));
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
    stride: usize,
    offset: usize,
) {
    let n = level.resolution as f32;
    let mut corners = Corners::new();
    let mut values = [[[0.0f32; W]; BLOCK]; MAX_CORNERS];
    let blocks = points.chunks(BLOCK).zip(features.chunks_mut(BLOCK * stride));
    for ((points, features), jacobian) in blocks.zip(jacobian.chunks_mut(BLOCK * D * stride)) {
        corners.fill(level, points);
        corners.gather::<D, W>(table, stride, offset, &mut values);
        let slopes = interpolate_with_slopes::<D, W>(&mut values, &corners.fraction);
        let rows = features.chunks_exact_mut(stride).zip(jacobian.chunks_exact_mut(D * stride));
        for (b, (point, (features, jacobian))) in points.iter().zip(rows).enumerate() {
            features[offset..][..W].copy_from_slice(&values[0][b]);
            for j in 0..D {
                let scale = if (0.0..=1.0).contains(&point[j]) { n } else { 0.0 };
                let out = &mut jacobian[j * stride + offset..][..W];
                for f in 0..W {
                    out[f] = scale * slopes[j][b][f];
                }
            }
        }
    }
}

/// Adds Jᵀ d_features of one level to `d_points`.
#[inline(always)]
fn level_jacobian_backward<const D: usize, const W: usize>(
    jacobian: &[f32],
    d_features: &[f32],
    d_points: &mut [[f32; D]],
    stride: usize,
    offset: usize,
) {
    let rows = d_features.chunks_exact(stride).zip(jacobian.chunks_exact(D * stride));
    for (d_point, (d_features, jacobian)) in d_points.iter_mut().zip(rows) {
        let d_features: &[f32; W] = &d_features[offset..].as_chunks::<W>().0[0];
        for (d, slopes) in d_point.iter_mut().zip(jacobian.chunks_exact(stride)) {
            let slopes: &[f32; W] = &slopes[offset..].as_chunks::<W>().0[0];
            *d += slopes.iter().zip(d_features).map(|(slope, d)| slope * d).sum::<f32>();
        }
    }
}
