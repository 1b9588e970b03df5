//! One small matrix kernel for every layer of the field, forward and backward.

/// Widths are padded to this: two AVX2 registers, or one of AVX-512.
pub(crate) const LANES: usize = 16;

/// A left operand (m × k), the transpose of a matrix (k × m) that lies in memory row by row, or
/// ones everywhere.
#[derive(Clone, Copy)]
pub(crate) enum Left<'a> {
    Rows(&'a [f32]),
    Transposed(&'a [f32]),
    Ones,
}

/// Initial value of an element of the result.
#[derive(Clone, Copy)]
pub(crate) enum Start<'a> {
    /// Its present value.
    Held,
    Zero,
    /// The number of its column (n).
    Row(&'a [f32]),
}

/// Function applied to the sums.
#[derive(Clone, Copy)]
pub(crate) enum Finish<'a> {
    Plain,
    /// NaN becomes 0, on every instruction set.
    Relu,
    /// They pass where this (m × n) is above zero: the derivative of [`Finish::Relu`], given its
    /// result.
    Gate(&'a [f32]),
}

/// `c (m × n) = finish(start + a (m × k) · b (k × n))`, `b` and `c` row-major, `n` a multiple of
/// 16.
///
/// The order of the additions into an element depends on neither `m` nor the instruction set, so a
/// block of rows gives the same bits wherever it is cut.
///
/// A struct and not a closure: the shim through which a closure is called is compiled without the
/// wide instructions, and a fused multiply-add becomes a function call there.
pub(crate) struct Product<'a> {
    pub m: usize,
    pub n: usize,
    pub k: usize,
    pub a: Left<'a>,
    pub b: &'a [f32],
    pub start: Start<'a>,
    pub finish: Finish<'a>,
    pub c: &'a mut [f32],
}

impl pulp::WithSimd for Product<'_> {
    type Output = ();

    /// Blocks as large as the registers hold: 16 sums of 16 lanes with AVX-512, 12 of 8 with AVX2,
    /// 16 of 4 with NEON.
    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, simd: S) {
        match S::F32_LANES {
            16 => self.columns::<S, 8, 2>(simd),
            8 => self.columns::<S, 6, 2>(simd),
            _ => self.columns::<S, 4, 4>(simd),
        }
    }
}

impl Product<'_> {
    pub fn run(self) {
        let (m, n, k) = (self.m, self.n, self.k);
        assert!(n.is_multiple_of(LANES), "columns {n} must be a multiple of {LANES}");
        assert!(self.b.len() >= k * n && self.c.len() >= m * n, "operands too short for {m}x{k} by {k}x{n}");
        if let Left::Rows(left) | Left::Transposed(left) = self.a {
            assert!(left.len() >= m * k, "left operand of {} too short for {m}x{k}", left.len());
        }
        if m > 0 && n > 0 {
            pulp::Arch::new().dispatch(self);
        }
    }

    /// `V` vectors of columns at a time, and the remainder one at a time.
    #[inline(always)]
    fn columns<S: pulp::Simd, const R: usize, const V: usize>(&mut self, simd: S) {
        let mut column = 0;
        while column + V * S::F32_LANES <= self.n {
            self.rows::<S, R, V>(simd, column);
            column += V * S::F32_LANES;
        }
        while column < self.n {
            self.rows::<S, R, 1>(simd, column);
            column += S::F32_LANES;
        }
    }

    #[inline(always)]
    fn rows<S: pulp::Simd, const R: usize, const V: usize>(&mut self, simd: S, column: usize) {
        let mut row = 0;
        while row + R <= self.m {
            self.block::<S, R, V>(simd, row, column);
            row += R;
        }
        while row < self.m {
            self.block::<S, 1, V>(simd, row, column);
            row += 1;
        }
    }

    #[inline(always)]
    fn block<S: pulp::Simd, const R: usize, const V: usize>(&mut self, simd: S, row: usize, column: usize) {
        let (m, n, k) = (self.m, self.n, self.k);
        let width = V * S::F32_LANES;
        let mut sum = [[simd.splat_f32s(0.0); V]; R];
        // One loop for each case: a case for each row would keep the sums in memory.
        match self.start {
            Start::Held => {
                for (r, sum) in sum.iter_mut().enumerate() {
                    sum.copy_from_slice(S::as_simd_f32s(&self.c[(row + r) * n + column..][..width]).0);
                }
            }
            Start::Zero => {}
            Start::Row(values) => {
                let values = S::as_simd_f32s(&values[column..column + width]).0;
                for sum in &mut sum {
                    sum.copy_from_slice(values);
                }
            }
        }
        let b_rows = self.b[..k * n].chunks_exact(n);
        // No closures: they are compiled for the baseline instruction set.
        match self.a {
            Left::Rows(a) => {
                let mut rows = [&a[..k]; R];
                for (r, slot) in rows.iter_mut().enumerate() {
                    *slot = &a[(row + r) * k..][..k];
                }
                for (l, b_row) in b_rows.enumerate() {
                    let b = S::as_simd_f32s(&b_row[column..column + width]).0;
                    for r in 0..R {
                        let x = simd.splat_f32s(rows[r][l]);
                        for v in 0..V {
                            sum[r][v] = simd.mul_add_f32s(x, b[v], sum[r][v]);
                        }
                    }
                }
            }
            Left::Transposed(a) => {
                for (a_row, b_row) in a[..k * m].chunks_exact(m).zip(b_rows) {
                    let (x, b) = (&a_row[row..row + R], S::as_simd_f32s(&b_row[column..column + width]).0);
                    for r in 0..R {
                        let x = simd.splat_f32s(x[r]);
                        for v in 0..V {
                            sum[r][v] = simd.mul_add_f32s(x, b[v], sum[r][v]);
                        }
                    }
                }
            }
            Left::Ones => {
                for b_row in b_rows {
                    let b = S::as_simd_f32s(&b_row[column..column + width]).0;
                    for sum in &mut sum {
                        for v in 0..V {
                            sum[v] = simd.add_f32s(sum[v], b[v]);
                        }
                    }
                }
            }
        }
        let zero = simd.splat_f32s(0.0);
        match self.finish {
            Finish::Plain => {}
            Finish::Relu => {
                for sum in &mut sum {
                    for v in 0..V {
                        sum[v] = simd.select_f32s(simd.greater_than_f32s(sum[v], zero), sum[v], zero);
                    }
                }
            }
            Finish::Gate(x) => {
                for (r, sum) in sum.iter_mut().enumerate() {
                    let x = S::as_simd_f32s(&x[(row + r) * n + column..][..width]).0;
                    for v in 0..V {
                        sum[v] = simd.select_f32s(simd.greater_than_f32s(x[v], zero), sum[v], zero);
                    }
                }
            }
        }
        for (r, sum) in sum.iter().enumerate() {
            S::as_mut_simd_f32s(&mut self.c[(row + r) * n + column..][..width]).0.copy_from_slice(sum);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn product_equals_the_triple_loop_for_every_left_start_and_finish(
            m in 1usize..19, lanes in 1usize..6, k in 1usize..20, seed in any::<u64>()
        ) {
            let n = lanes * LANES;
            let mut random = volrender::RandomStream::new(&[seed]);
            let mut fill = |count: usize| (0..count).map(|_| random.uniform() * 2.0 - 1.0).collect::<Vec<f32>>();
            let (a, b, c, row, gate) = (fill(m * k), fill(k * n), fill(m * n), fill(n), fill(m * n));
            let transposed: Vec<f32> = (0..k * m).map(|i| a[(i % m) * k + i / m]).collect();
            for left in [Left::Rows(&a), Left::Transposed(&transposed), Left::Ones] {
                for start in [Start::Held, Start::Zero, Start::Row(&row)] {
                    for finish in [Finish::Plain, Finish::Relu, Finish::Gate(&gate)] {
                        let mut out = c.clone();
                        Product { m, n, k, a: left, b: &b, start, finish, c: &mut out }.run();
                        for i in 0..m {
                            for j in 0..n {
                                let from = match start {
                                    Start::Held => c[i * n + j],
                                    Start::Zero => 0.0,
                                    Start::Row(values) => values[j],
                                };
                                let exact = (0..k).fold(f64::from(from), |sum, l| {
                                    let a = if matches!(left, Left::Ones) { 1.0 } else { a[i * k + l] };
                                    sum + f64::from(a) * f64::from(b[l * n + j])
                                });
                                let exact = match finish {
                                    Finish::Plain => exact,
                                    Finish::Relu => exact.max(0.0),
                                    Finish::Gate(x) => if x[i * n + j] > 0.0 { exact } else { 0.0 },
                                };
                                prop_assert!((f64::from(out[i * n + j]) - exact).abs() < 1e-5 * (k as f64 + 1.0));
                            }
                        }
                    }
                }
            }
        }

        #[test]
        fn results_have_the_same_bits_with_every_instruction_set(
            m in 1usize..19, lanes in 1usize..6, k in 1usize..20, nan in any::<prop::sample::Index>(), seed in any::<u64>()
        ) {
            let n = lanes * LANES;
            let mut random = volrender::RandomStream::new(&[seed]);
            let mut fill = |count: usize| (0..count).map(|_| random.normal()).collect::<Vec<f32>>();
            let (mut a, b, row) = (fill(m * k), fill(k * n), fill(n));
            a[nan.index(m * k)] = f32::NAN;
            let bits = |arch: pulp::Arch, left| {
                let mut out = vec![0.0; m * n];
                arch.dispatch(Product { m, n, k, a: left, b: &b, start: Start::Row(&row), finish: Finish::Relu, c: &mut out });
                out.into_iter().map(f32::to_bits).collect::<Vec<_>>()
            };
            for left in [Left::Rows(&a), Left::Transposed(&a), Left::Ones] {
                let expected = bits(pulp::Arch::Scalar, left);
                prop_assert!(bits(pulp::Arch::new(), left) == expected);
                #[cfg(target_arch = "x86_64")]
                if let Some(simd) = pulp::x86::V3::try_new() {
                    prop_assert!(bits(pulp::Arch::V3(simd), left) == expected);
                }
            }
        }
    }
}
