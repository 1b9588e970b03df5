//! One small matrix kernel for every layer of the field, forward and backward.

/// Columns are handled in lanes of 16, so that a row of a block is two AVX2 or one AVX-512 register.
pub(crate) const LANES: usize = 16;
const ROWS: usize = 4;

/// A left operand that is read element by element, so that a transpose is only a swap of strides.
#[derive(Clone, Copy)]
pub(crate) struct Strided<'a> {
    pub data: &'a [f32],
    pub row: usize,
    pub column: usize,
}

impl<'a> Strided<'a> {
    pub fn rows(data: &'a [f32], width: usize) -> Self {
        Self { data, row: width, column: 1 }
    }

    pub fn transposed(data: &'a [f32], width: usize) -> Self {
        Self { data, row: 1, column: width }
    }
}

/// `c (m × n) += a (m × k) · b (k × n)`, `b` and `c` row-major, `n` a multiple of 16.
///
/// The order of the additions into an element does not depend on `m`, so a block of rows gives the same bits
/// wherever it is cut.
pub(crate) fn multiply_add(m: usize, n: usize, k: usize, a: Strided<'_>, b: &[f32], c: &mut [f32]) {
    assert!(n.is_multiple_of(LANES), "columns {n} must be a multiple of {LANES}");
    assert!(b.len() >= k * n && c.len() >= m * n, "operands too short for {m}x{k} by {k}x{n}");
    pulp::Arch::new().dispatch(Product { m, n, k, a, b, c });
}

/// A struct and not a closure: the shim through which a closure is called is compiled without the wide
/// instructions, and a fused multiply-add becomes a function call there.
struct Product<'a> {
    m: usize,
    n: usize,
    k: usize,
    a: Strided<'a>,
    b: &'a [f32],
    c: &'a mut [f32],
}

impl pulp::WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        kernel(self.m, self.n, self.k, self.a, self.b, self.c);
    }
}

#[inline(always)]
fn kernel(m: usize, n: usize, k: usize, a: Strided<'_>, b: &[f32], c: &mut [f32]) {
    let mut row = 0;
    while row + ROWS <= m {
        for column in (0..n).step_by(LANES) {
            block::<ROWS>(row, column, n, k, a, b, c);
        }
        row += ROWS;
    }
    while row < m {
        for column in (0..n).step_by(LANES) {
            block::<1>(row, column, n, k, a, b, c);
        }
        row += 1;
    }
}

#[inline(always)]
fn block<const R: usize>(row: usize, column: usize, n: usize, k: usize, a: Strided<'_>, b: &[f32], c: &mut [f32]) {
    let mut sum = [[0.0f32; LANES]; R];
    for (r, lanes) in sum.iter_mut().enumerate() {
        lanes.copy_from_slice(&c[(row + r) * n + column..][..LANES]);
    }
    let mut a_index: [usize; R] = std::array::from_fn(|r| (row + r) * a.row);
    for b_row in b[..k * n].chunks_exact(n) {
        let Some(b_lanes) = b_row[column..].first_chunk::<LANES>() else { return };
        for r in 0..R {
            let x = a.data[a_index[r]];
            a_index[r] += a.column;
            for lane in 0..LANES {
                sum[r][lane] = x.mul_add(b_lanes[lane], sum[r][lane]);
            }
        }
    }
    for (r, lanes) in sum.iter().enumerate() {
        c[(row + r) * n + column..][..LANES].copy_from_slice(lanes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn product_equals_the_triple_loop_for_both_strides(
            m in 1usize..11, lanes in 1usize..4, k in 1usize..20, seed in any::<u64>()
        ) {
            let n = lanes * LANES;
            let mut random = crate::random::Stream::new(&[seed]);
            let mut fill = |count: usize| (0..count).map(|_| random.uniform() * 2.0 - 1.0).collect::<Vec<f32>>();
            let (a, b, c) = (fill(m * k), fill(k * n), fill(m * n));
            let transposed: Vec<f32> = (0..k * m).map(|i| a[(i % m) * k + i / m]).collect();
            for view in [Strided::rows(&a, k), Strided::transposed(&transposed, m)] {
                let mut out = c.clone();
                multiply_add(m, n, k, view, &b, &mut out);
                for i in 0..m {
                    for j in 0..n {
                        let exact = (0..k).fold(f64::from(c[i * n + j]), |sum, l| {
                            sum + f64::from(a[i * k + l]) * f64::from(b[l * n + j])
                        });
                        prop_assert!((f64::from(out[i * n + j]) - exact).abs() < 1e-5 * (k as f64 + 1.0));
                    }
                }
            }
        }
    }
}
