//! The field's multilayer perceptron: ReLU hidden layers, a linear head, both directions by hand,
//! and one small matrix kernel for every layer of it.

use volrender::RandomStream;

/// Shape of a perceptron and where its weights lie in one flat slice.
///
/// Layer `l` holds a matrix (inputs × outputs, row-major) followed by its biases; widths are padded
/// to 16 lanes and the padding stays zero.
#[derive(Clone, Debug)]
pub(crate) struct Mlp {
    /// Padded widths: input, hidden …, output.
    widths: Vec<usize>,
    offsets: Vec<usize>,
    true_widths: Vec<usize>,
}

fn pad(width: usize) -> usize {
    width.next_multiple_of(LANES)
}

/// Activations of a block of samples.
#[derive(Clone, Debug, Default)]
pub(crate) struct Activations {
    /// One row-major buffer (samples × padded width) for the input and for each layer's output.
    pub layers: Vec<Vec<f32>>,
}

impl Activations {
    /// The linear outputs, a padded row a sample.
    pub fn outputs(&self) -> impl Iterator<Item = &[f32]> {
        self.layers.last().into_iter().flat_map(|layer| layer.chunks_exact(LANES))
    }
}

impl Mlp {
    pub fn new(inputs: usize, hidden: &[usize], outputs: usize) -> Self {
        let true_widths: Vec<usize> =
            std::iter::once(inputs).chain(hidden.iter().copied()).chain(std::iter::once(outputs)).collect();
        let widths: Vec<usize> = true_widths.iter().map(|&w| pad(w)).collect();
        let mut offsets = vec![0];
        for pair in widths.windows(2) {
            offsets.push(offsets[offsets.len() - 1] + (pair[0] + 1) * pair[1]);
        }
        Self { widths, offsets, true_widths }
    }

    pub fn num_parameters(&self) -> usize {
        self.offsets[self.offsets.len() - 1]
    }

    /// Parameters that are not padding.
    pub fn num_true_parameters(&self) -> usize {
        self.true_widths.windows(2).map(|w| (w[0] + 1) * w[1]).sum()
    }

    /// Padded width of the input rows.
    pub fn input_width(&self) -> usize {
        self.widths[0]
    }

    fn num_layers(&self) -> usize {
        self.widths.len() - 1
    }

    /// He-uniform weights (He et al. 2015), zero biases; the head is a tenth of that, so that every
    /// seed starts near its biases.
    pub fn initial(&self, seed: u64) -> Vec<f32> {
        let mut parameters = vec![0.0; self.num_parameters()];
        for layer in 0..self.num_layers() {
            let mut random = RandomStream::new(&[seed, 0x4D4C_5031, layer as u64]);
            let (inputs, outputs) = (self.true_widths[layer], self.true_widths[layer + 1]);
            let gain = if layer + 1 == self.num_layers() { 0.1 } else { 1.0 };
            let bound = gain * (6.0 / inputs as f32).sqrt();
            for i in 0..inputs {
                for o in 0..outputs {
                    parameters[self.offsets[layer] + i * self.widths[layer + 1] + o] =
                        bound * (2.0 * random.uniform() - 1.0);
                }
            }
        }
        parameters
    }

    /// Sizes the buffers for `samples` rows; contents of the input rows are the caller's to fill.
    pub fn resize(&self, activations: &mut Activations, samples: usize) {
        activations.layers.resize_with(self.widths.len(), Vec::new);
        for (buffer, width) in activations.layers.iter_mut().zip(&self.widths) {
            buffer.resize(samples * width, 0.0);
        }
    }

    /// Fills every layer of `activations` from its input rows; the last buffer is the linear
    /// output.
    pub fn forward(&self, parameters: &[f32], activations: &mut Activations, samples: usize) {
        assert_eq!(parameters.len(), self.num_parameters());
        for layer in 0..self.num_layers() {
            let (inputs, outputs) = (self.widths[layer], self.widths[layer + 1]);
            let (weights, biases) = self.layer(parameters, layer);
            let (previous, next) = activations.layers.split_at_mut(layer + 1);
            let (x, y) = (&previous[layer][..samples * inputs], &mut next[0][..samples * outputs]);
            let finish = if layer + 1 < self.num_layers() { Finish::Relu } else { Finish::Plain };
            let (a, start) = (Left::Rows(x), Start::Row(biases));
            Product { m: samples, n: outputs, k: inputs, a, b: weights, start, finish, c: y }.run();
        }
    }

    /// Backward of [`Mlp::forward`]: accumulates into `d_parameters`, overwrites `d_input` (samples
    /// × padded width).
    ///
    /// `transposed` is [`Mlp::transposed_weights`] of the same parameters; `d_output` is consumed
    /// as scratch.
    pub fn backward(
        &self,
        transposed: &[f32],
        activations: &Activations,
        samples: usize,
        d_output: &mut Vec<f32>,
        d_input: &mut Vec<f32>,
        d_parameters: &mut [f32],
    ) {
        for layer in (0..self.num_layers()).rev() {
            let (inputs, outputs) = (self.widths[layer], self.widths[layer + 1]);
            let x = &activations.layers[layer][..samples * inputs];
            let d_y = &d_output[..samples * outputs];
            let weight_range = self.offsets[layer]..self.offsets[layer + 1];
            let (d_weights, d_biases) = d_parameters[weight_range].split_at_mut(inputs * outputs);
            for (m, a, c) in [(inputs, Left::Transposed(x), d_weights), (1, Left::Ones, d_biases)] {
                let (start, finish) = (Start::Held, Finish::Plain);
                Product { m, n: outputs, k: samples, a, b: d_y, start, finish, c }.run();
            }
            d_input.resize(samples * inputs, 0.0);
            let (a, b) = (Left::Rows(d_y), &transposed[self.offsets[layer]..][..inputs * outputs]);
            let (start, finish) = (Start::Zero, if layer > 0 { Finish::Gate(x) } else { Finish::Plain });
            Product { m: samples, n: inputs, k: outputs, a, b, start, finish, c: d_input }.run();
            if layer > 0 {
                std::mem::swap(d_output, d_input);
            }
        }
    }

    /// Every layer's matrix transposed (outputs × inputs), in the same places of the flat slice.
    pub fn transposed_weights(&self, parameters: &[f32], transposed: &mut Vec<f32>) {
        transposed.resize(parameters.len(), 0.0);
        for layer in 0..self.num_layers() {
            let (inputs, outputs) = (self.widths[layer], self.widths[layer + 1]);
            let (weights, _) = self.layer(parameters, layer);
            let to = &mut transposed[self.offsets[layer]..][..inputs * outputs];
            for i in 0..inputs {
                for o in 0..outputs {
                    to[o * inputs + i] = weights[i * outputs + o];
                }
            }
        }
    }

    /// Zeroes what belongs to padding, so that an optimiser never moves it.
    pub fn clear_padding(&self, d_parameters: &mut [f32]) {
        for layer in 0..self.num_layers() {
            let (inputs, outputs) = (self.widths[layer], self.widths[layer + 1]);
            for row in 0..=inputs {
                let keep = if row < self.true_widths[layer] || row == inputs { self.true_widths[layer + 1] } else { 0 };
                d_parameters[self.offsets[layer] + row * outputs..][keep..outputs].fill(0.0);
            }
        }
    }

    fn layer<'a>(&self, parameters: &'a [f32], layer: usize) -> (&'a [f32], &'a [f32]) {
        parameters[self.offsets[layer]..self.offsets[layer + 1]].split_at(self.widths[layer] * self.widths[layer + 1])
    }
}

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
    use proptest::prelude::*;
    use testkit::gradient::{Tolerance, assert_gradient};

    use super::*;

    fn run(mlp: &Mlp, parameters: &[f32], input: &[f32], samples: usize) -> Activations {
        let mut activations = Activations::default();
        mlp.resize(&mut activations, samples);
        let (width, inputs) = (mlp.input_width(), input.len() / samples);
        for s in 0..samples {
            activations.layers[0][s * width..][..inputs].copy_from_slice(&input[s * inputs..][..inputs]);
        }
        mlp.forward(parameters, &mut activations, samples);
        activations
    }

    #[test]
    fn gradients_of_parameters_and_input_agree_with_central_differences() {
        let (inputs, samples) = (5, 7);
        let mlp = Mlp::new(inputs, &[18, 9], 4);
        for seed in 0..4 {
            let mut random = RandomStream::new(&[seed, 5]);
            let parameters: Vec<f32> = {
                let mut p: Vec<f32> = (0..mlp.num_parameters()).map(|_| random.normal() * 0.3).collect();
                mlp.clear_padding(&mut p);
                p
            };
            let input: Vec<f32> = (0..inputs * samples).map(|_| random.normal()).collect();
            let cotangent: Vec<f32> = (0..samples * crate::model::perceptron::LANES).map(|_| random.normal()).collect();
            let value = |parameters: &[f32], input: &[f32]| -> f64 {
                let out = run(&mlp, parameters, input, samples);
                out.layers[3].iter().zip(&cotangent).map(|(y, c)| f64::from(*y) * f64::from(*c)).sum()
            };
            let activations = run(&mlp, &parameters, &input, samples);
            let (mut transposed, mut d_parameters) = (Vec::new(), vec![0.0; mlp.num_parameters()]);
            mlp.transposed_weights(&parameters, &mut transposed);
            let (mut d_out, mut d_input) = (cotangent.clone(), Vec::new());
            mlp.backward(&transposed, &activations, samples, &mut d_out, &mut d_input, &mut d_parameters);
            mlp.clear_padding(&mut d_parameters);
            let signs = |a: &Activations| a.layers[1..3].iter().flatten().map(|&v| v > 0.0).collect::<Vec<_>>();
            let mut tested = 0;
            for direction in 0..40 {
                let mut random = RandomStream::new(&[seed, 77, direction]);
                let mut d: Vec<f32> = (0..mlp.num_parameters()).map(|_| 0.1 * random.normal()).collect();
                mlp.clear_padding(&mut d);
                let h = 1e-3;
                let moved = |h: f32| parameters.iter().zip(&d).map(|(p, d)| p + h * d).collect::<Vec<f32>>();
                let (low, high) = (moved(-h), moved(h));
                // A unit that switches within the step is a kink: the difference is no derivative
                // there.
                let (low_run, high_run) = (run(&mlp, &low, &input, samples), run(&mlp, &high, &input, samples));
                if signs(&low_run) != signs(&high_run) {
                    continue;
                }
                tested += 1;
                let analytic: f64 = d.iter().zip(&d_parameters).map(|(a, b)| f64::from(a * b)).sum();
                let numeric = (value(&high, &input) - value(&low, &input)) / (2.0 * f64::from(h));
                assert!((numeric - analytic).abs() < 0.01 * (1.0 + analytic.abs()), "{numeric} {analytic}");
            }
            assert!(tested >= 10, "{tested}");
            let analytic: Vec<f32> =
                (0..inputs * samples).map(|i| d_input[(i / inputs) * mlp.input_width() + i % inputs]).collect();
            let tolerance = Tolerance { abs: 0.02, rel: 0.03 };
            assert_gradient("d_input", &input, &analytic, 2e-4, tolerance, |x| value(&parameters, x));
        }
    }

    impl Mlp {
        /// The outputs for one input, in f64 and term by term.
        pub fn plain(&self, parameters: &[f32], input: &[f64]) -> Vec<f64> {
            let mut x = input.to_vec();
            for layer in 0..self.num_layers() {
                let (weights, biases) = self.layer(parameters, layer);
                let output = |o: usize| {
                    let products =
                        x.iter().enumerate().map(|(i, x)| x * f64::from(weights[i * self.widths[layer + 1] + o]));
                    f64::from(biases[o]) + products.sum::<f64>()
                };
                let last = layer + 1 == self.num_layers();
                let outputs = (0..self.true_widths[layer + 1]).map(output);
                x = outputs.map(|y| if last { y } else { y.max(0.0) }).collect();
            }
            x
        }
    }

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
