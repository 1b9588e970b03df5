use std::ops::Range;

/// Memory layout (L, Q, F) of encoded points, which an encoder reads and writes level by level, and
/// its conversion to and from rows of one point each, Q × (L·F), as perceptrons take them. Both
/// convert a range of points at a time, so that the rows fit a cache.
///
/// ```
/// let layout = hashgrid::Layout { levels: 2, points: 3, features: 1 };
/// let mut features = [1.0, 2.0, 3.0, 10.0, 20.0, 30.0];
/// let mut rows = [0.0; 4];
/// layout.to_rows(&features, 1..3, &mut rows, 2);
/// assert_eq!(rows, [2.0, 20.0, 3.0, 30.0]);
///
/// layout.clear(0..3, &mut features);
/// layout.from_rows(&rows, 2, 1..3, &mut features);
/// assert_eq!(features, [0.0, 2.0, 3.0, 0.0, 20.0, 30.0]);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// L, levels.
    pub levels: usize,
    /// Q, points.
    pub points: usize,
    /// F, features per level.
    pub features: usize,
}

impl Layout {
    fn len(&self) -> usize {
        self.levels * self.points * self.features
    }

    /// Copies the features of the points in `range` to `rows`, which start `stride` numbers apart.
    ///
    /// # Panics
    /// If the length of a slice is wrong, the range exceeds the points, `stride` is less than L·F,
    /// or L·F is 0.
    pub fn to_rows(&self, features: &[f32], range: Range<usize>, rows: &mut [f32], stride: usize) {
        self.check(features.len(), &range, rows.len(), stride);
        for l in 0..self.levels {
            let from = &features[(l * self.points + range.start) * self.features..][..range.len() * self.features];
            let rows = rows.chunks_mut(stride);
            match self.features {
                // Constant lengths are copied without a call to memcpy.
                2 => from.as_chunks::<2>().0.iter().zip(rows).for_each(|(x, row)| row[2 * l..][..2].copy_from_slice(x)),
                f => from.chunks_exact(f).zip(rows).for_each(|(x, row)| row[f * l..][..f].copy_from_slice(x)),
            }
        }
    }

    /// Inverse of [`Layout::to_rows`]: copies `rows` to the `features` of the points in `range`.
    ///
    /// # Panics
    /// As [`Layout::to_rows`].
    pub fn from_rows(&self, rows: &[f32], stride: usize, range: Range<usize>, features: &mut [f32]) {
        self.check(features.len(), &range, rows.len(), stride);
        for l in 0..self.levels {
            let start = (l * self.points + range.start) * self.features;
            let to = &mut features[start..][..range.len() * self.features];
            let rows = rows.chunks(stride);
            match self.features {
                2 => to.as_chunks_mut::<2>().0.iter_mut().zip(rows).for_each(|(x, row)| {
                    x.copy_from_slice(&row[2 * l..][..2]);
                }),
                f => to.chunks_exact_mut(f).zip(rows).for_each(|(x, row)| x.copy_from_slice(&row[f * l..][..f])),
            }
        }
    }

    /// Zeroes `features` of the points in `range`.
    ///
    /// # Panics
    /// If the length of the slice is wrong or the range exceeds the points.
    pub fn clear(&self, range: Range<usize>, features: &mut [f32]) {
        assert_eq!(features.len(), self.len(), "features of {self:?}");
        assert!(range.end <= self.points, "points {range:?} of {}", self.points);
        for l in 0..self.levels {
            let first = l * self.points;
            features[(first + range.start) * self.features..(first + range.end) * self.features].fill(0.0);
        }
    }

    /// Asserts the lengths of both slices.
    fn check(&self, features: usize, range: &Range<usize>, rows: usize, stride: usize) {
        assert_eq!(features, self.len(), "features of {self:?}");
        assert!(range.start <= range.end && range.end <= self.points, "points {range:?} of {}", self.points);
        let width = self.levels * self.features;
        assert!(stride >= width && width > 0, "rows {stride} apart, {width} numbers each");
        let least = if range.is_empty() { 0 } else { (range.len() - 1) * stride + width };
        assert!(rows >= least, "rows have {rows} numbers, expected at least {least}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn rows_hold_the_features_of_their_points_and_convert_back(
            levels in 1usize..5, points in 0usize..20, features in 1usize..5, gap in 0usize..3,
            cut in (0usize..=20, 0usize..=20),
        ) {
            let layout = Layout { levels, points, features };
            let values: Vec<f32> = (0..layout.len()).map(|i| i as f32).collect();
            let (start, end) = (cut.0.min(cut.1).min(points), cut.0.max(cut.1).min(points));
            let stride = levels * features + gap;
            let mut rows = vec![-1.0; (end - start) * stride];
            layout.to_rows(&values, start..end, &mut rows, stride);
            for (i, row) in rows.chunks(stride).enumerate() {
                for l in 0..levels {
                    for f in 0..features {
                        prop_assert_eq!(row[l * features + f], values[(l * points + start + i) * features + f]);
                    }
                }
                prop_assert!(row[levels * features..].iter().all(|&x| x == -1.0));
            }
            let mut back = values.clone();
            layout.clear(start..end, &mut back);
            for (i, (&cleared, value)) in back.iter().zip(&values).enumerate() {
                let inside = (start..end).contains(&(i / features % points));
                prop_assert_eq!(cleared, if inside { 0.0 } else { *value });
            }
            layout.from_rows(&rows, stride, start..end, &mut back);
            prop_assert_eq!(back, values);
        }
    }
}
