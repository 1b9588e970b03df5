use crate::corners::{BLOCK, Corners, Lanes, MAX_CORNERS, Values, for_widths, spread};
use crate::encode::CHUNK;
use crate::grid::{HashGrid, Level};
use crate::simd::{Kernel, arch};

impl<const D: usize> HashGrid<D> {
    /// Length of the Jacobian of `points` points: L·Q·D·F.
    #[must_use]
    pub fn jacobian_len(&self, points: usize) -> usize {
        self.num_features() * D * points
    }

    /// [`HashGrid::encode`], up to rounding, that also writes the derivatives of the features by
    /// the coordinates, (L, Q, D, F), overwritten: where a backward pass to the points follows,
    /// [`HashGrid::jacobian_backward`] need not read the table again, which costs most where it is
    /// larger than the cache. Runs on the calling thread.
    ///
    /// On the faces of cells and outside \[0, 1\] the derivatives are those of
    /// [`HashGrid::encode_backward_points`].
    ///
    /// # Panics
    /// Where a slice has another length.
    pub fn encode_jacobian(&self, table: &[f32], points: &[[f32; D]], features: &mut [f32], jacobian: &mut [f32]) {
        self.assert_table("table", table);
        self.assert_features("features", features, points.len());
        self.assert_jacobian(jacobian, points.len());
        let arch = arch();
        for (chunk, part) in points.chunks(CHUNK).enumerate() {
            for (l, level) in self.levels.iter().enumerate() {
                let table = &table[self.level_range(l)];
                let range = self.features_range(l, points.len(), chunk * CHUNK, part.len());
                let jacobian = &mut jacobian[range.start * D..range.end * D];
                let features = &mut features[range];
                arch.dispatch(Kernel(
                    #[inline(always)]
                    || for_widths!(self.features, level_jacobian::<D>(level, table, part, features, jacobian)),
                ));
            }
        }
    }

    /// Adds the gradient of the coordinates to `d_points` (Q, D), given what
    /// [`HashGrid::encode_jacobian`] wrote and the gradient of the features `d_features` (L, Q, F).
    /// Runs on the calling thread.
    ///
    /// # Panics
    /// Where a slice has another length.
    pub fn jacobian_backward(&self, jacobian: &[f32], d_features: &[f32], d_points: &mut [[f32; D]]) {
        /// Points whose gradients stay in the first-level cache while all levels pass over them.
        const PART: usize = 512;
        self.assert_jacobian(jacobian, d_points.len());
        self.assert_features("d_features", d_features, d_points.len());
        let points = d_points.len();
        for (part, d_points) in d_points.chunks_mut(PART).enumerate() {
            for l in 0..self.levels.len() {
                let range = self.features_range(l, points, part * PART, d_points.len());
                let jacobian = &jacobian[range.start * D..range.end * D];
                let d_features = &d_features[range];
                for_widths!(self.features, project::<D>(jacobian, d_features, d_points));
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
        let slopes = fold::<D, W>(&mut values, &corners.fraction);
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

/// Adds the Jacobian of one level, transposed, times the gradients of its features.
#[inline(always)]
fn project<const D: usize, const W: usize>(
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

/// Interpolates the corners' values into `values[0]`; returns its derivatives along the axes, a
/// cell's side being 1.
#[inline(always)]
fn fold<const D: usize, const W: usize>(values: &mut Values<W>, fraction: &[Lanes<f32>; 4]) -> [Lanes<[f32; W]>; D] {
    let mut slopes = [[[[0.0f32; W]; BLOCK]; MAX_CORNERS / 2]; D];
    for axis in (0..D).rev() {
        let half = 1 << axis;
        let t = spread::<W>(&fraction[axis]);
        let t = t.as_flattened();
        // The derivatives along the axes that are folded already are interpolated along this one.
        for slope in &mut slopes[axis + 1..] {
            let (low, high) = slope.split_at_mut(half);
            for k in 0..half {
                let (low, high) = (low[k].as_flattened_mut(), high[k].as_flattened());
                for i in 0..BLOCK * W {
                    low[i] += t[i] * (high[i] - low[i]);
                }
            }
        }
        let (low, high) = values.split_at_mut(half);
        for k in 0..half {
            let (low, high) = (low[k].as_flattened_mut(), high[k].as_flattened());
            let slope = slopes[axis][k].as_flattened_mut();
            for i in 0..BLOCK * W {
                let difference = high[i] - low[i];
                slope[i] = difference;
                low[i] += t[i] * difference;
            }
        }
    }
    let mut first = [[[0.0; W]; BLOCK]; D];
    for j in 0..D {
        first[j] = slopes[j][0];
    }
    first
}
