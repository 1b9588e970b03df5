//! Table rows, interpolation weights and gradient at the 2^D cell corners of a block of points.

use crate::grid::Level;

/// Points per block, so that index arithmetic runs in SIMD lanes.
pub(crate) const BLOCK: usize = 16;
pub(crate) const MAX_CORNERS: usize = 16;

const PRIMES: [u32; 4] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// One value for every point of a block.
pub(crate) type Lanes<T> = [T; BLOCK];

/// Corner k lies at c_j + 1 where bit j of k is set, at c_j where it is not.
pub(crate) struct Corners {
    /// Row indices in the level's table.
    pub row: [Lanes<u32>; MAX_CORNERS],
    /// Position of the point within its cell along each axis, in [0, 1].
    pub fraction: [Lanes<f32>; 4],
}

impl Corners {
    pub fn new() -> Self {
        Self { row: [[0; BLOCK]; MAX_CORNERS], fraction: [[0.0; BLOCK]; 4] }
    }

    /// Computes rows and fractions of up to [`BLOCK`] `points`; unused lanes get those of the
    /// origin.
    #[inline(always)]
    pub fn fill<const D: usize>(&mut self, level: &Level, points: &[[f32; D]]) {
        if level.hashed {
            let mask = (level.rows - 1) as u32;
            self.fill_with(level, points, PRIMES, |a, b| a ^ b);
            for row in &mut self.row[..1 << D] {
                for lane in row {
                    *lane &= mask;
                }
            }
        } else {
            // Strides do not exceed the number of rows, so they fit u32.
            let side = level.resolution + 1;
            let mut strides = [1; 4];
            for j in 1..D {
                strides[j] = strides[j - 1] * side;
            }
            self.fill_with(level, points, strides, u32::wrapping_add);
        }
    }

    #[inline(always)]
    fn fill_with<const D: usize>(
        &mut self,
        level: &Level,
        points: &[[f32; D]],
        factors: [u32; 4],
        combine: impl Fn(u32, u32) -> u32,
    ) {
        let n = f64::from(level.resolution);
        let last = level.resolution as i32 - 1;
        let mut x = [[0.0f32; BLOCK]; D];
        for (b, point) in points.iter().enumerate().take(BLOCK) {
            for j in 0..D {
                x[j][b] = point[j];
            }
        }
        for j in 0..D {
            let mut low = [0u32; BLOCK];
            let mut high = [0u32; BLOCK];
            let fraction = &mut self.fraction[j];
            for b in 0..BLOCK {
                // x · N is exact in f64, so cells and fractions are too.
                let p = f64::from(clamp_unit(x[j][b])) * n;
                let cell = (p as i32).min(last);
                fraction[b] = (p - f64::from(cell)) as f32;
                low[b] = (cell as u32).wrapping_mul(factors[j]);
                high[b] = (cell as u32 + 1).wrapping_mul(factors[j]);
            }
            if j == 0 {
                self.row[0] = low;
                self.row[1] = high;
                continue;
            }
            let half = 1 << j;
            let (row_low, row_high) = self.row.split_at_mut(half);
            for k in 0..half {
                for b in 0..BLOCK {
                    row_high[k][b] = combine(row_low[k][b], high[b]);
                    row_low[k][b] = combine(row_low[k][b], low[b]);
                }
            }
        }
    }

    /// d-linear interpolation weights of the corners; their sum is 1.
    #[inline(always)]
    pub fn weights<const D: usize>(&self) -> [Lanes<f32>; MAX_CORNERS] {
        let mut weight = [[1.0; BLOCK]; MAX_CORNERS];
        for j in 0..D {
            let (low, high) = weight.split_at_mut(1 << j);
            for k in 0..1 << j {
                for b in 0..BLOCK {
                    high[k][b] = low[k][b] * self.fraction[j][b];
                    low[k][b] *= 1.0 - self.fraction[j][b];
                }
            }
        }
        weight
    }
}

/// d-linear interpolation of the corners' `values` into `values[0]`; returns its derivatives along
/// the axes in units of 1/cell.
#[inline(always)]
pub(crate) fn interpolate_with_gradient<const D: usize>(
    values: &mut [Lanes<f32>; MAX_CORNERS],
    fraction: &[Lanes<f32>; 4],
) -> [Lanes<f32>; D] {
    let mut gradient = [[[0.0f32; BLOCK]; MAX_CORNERS / 2]; D];
    for axis in (0..D).rev() {
        let (half, t) = (1 << axis, &fraction[axis]);
        // Derivatives along the axes done before are interpolated along this one.
        for partial in &mut gradient[axis + 1..] {
            let (low, high) = partial.split_at_mut(half);
            for k in 0..half {
                for b in 0..BLOCK {
                    low[k][b] += t[b] * (high[k][b] - low[k][b]);
                }
            }
        }
        let (low, high) = values.split_at_mut(half);
        for k in 0..half {
            for b in 0..BLOCK {
                let difference = high[k][b] - low[k][b];
                gradient[axis][k][b] = difference;
                low[k][b] += t[b] * difference;
            }
        }
    }
    gradient.map(|partial| partial[0])
}

/// Clamped to [0, 1]; NaN is 0.
#[inline(always)]
fn clamp_unit(x: f32) -> f32 {
    let above = if x > 0.0 { x } else { 0.0 };
    if above < 1.0 { above } else { 1.0 }
}

/// Features `offset..offset + W` of row `row` in a level with `stride` features per row.
#[inline(always)]
pub(crate) fn row<const W: usize>(table: &[f32], stride: usize, offset: usize, row: u32) -> &[f32; W] {
    if stride == W {
        // Constant in the specialised kernels: one bounds check instead of two.
        return &table.as_chunks::<W>().0[row as usize];
    }
    let start = row as usize * stride + offset;
    &table[start..].as_chunks::<W>().0[0]
}

/// [`row`] for writing.
#[inline(always)]
pub(crate) fn row_mut<const W: usize>(table: &mut [f32], stride: usize, offset: usize, row: u32) -> &mut [f32; W] {
    if stride == W {
        return &mut table.as_chunks_mut::<W>().0[row as usize];
    }
    let start = row as usize * stride + offset;
    &mut table[start..].as_chunks_mut::<W>().0[0]
}

/// Runs `$kernel::<D, W>(.., stride, offset)` for all F features: one pass for F of 1, 2, 4 or 8,
/// else one a feature.
macro_rules! for_widths {
    ($features:expr, $kernel:ident::<$d:ident>($($argument:expr),*)) => {
        match $features {
            1 => $kernel::<$d, 1>($($argument,)* 1, 0),
            2 => $kernel::<$d, 2>($($argument,)* 2, 0),
            4 => $kernel::<$d, 4>($($argument,)* 4, 0),
            8 => $kernel::<$d, 8>($($argument,)* 8, 0),
            features => (0..features).for_each(|offset| $kernel::<$d, 1>($($argument,)* features, offset)),
        }
    };
}
pub(crate) use for_widths;
