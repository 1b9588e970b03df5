//! Losses of the paper on patches and samples, each with its gradient.

/// Side of the uniform SSIM window.
const WINDOW: usize = 7;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// A 32-pixel patch has at most three scales: at a fourth, 4 pixels are smaller than the window.
const MAX_SCALES: usize = 3;

/// Multi-scale structural dissimilarity of two square patches: the mean over scales of 1 − SSIM,
/// each scale the 2 × 2 mean of the one before (after Wang et al. 2003, with a sum in place of the
/// product so that the gradient stays bounded where a scale's SSIM is near 0). Keeps the buffers
/// that it takes.
#[derive(Clone, Debug, Default)]
pub(crate) struct Dissimilarity {
    scales: Vec<Scale>,
    windows: Windows,
}

/// Both patches at one scale, `side`·`side`·3, and the gradient of the first.
#[derive(Clone, Debug, Default)]
struct Scale {
    side: usize,
    x: Vec<f32>,
    y: Vec<f32>,
    d_x: Vec<f32>,
}

/// What SSIM knows of each window position.
#[derive(Clone, Debug, Default)]
struct Windows {
    /// Sums of x, y, x², y², xy along rows, then their means.
    rows: Vec<[f32; 5]>,
    means: Vec<[f32; 5]>,
    /// Derivatives by the means of x, x² and xy.
    coefficients: Vec<[f32; 3]>,
}

impl Dissimilarity {
    /// `a`, `b`: `size`·`size`·3 row-major in [0, 1]. Adds `scale` × the gradient with respect to
    /// `a` to `d_a` and returns the value (unscaled). A patch smaller than the window gives 0.
    pub fn backward(&mut self, a: &[f32], b: &[f32], size: usize, scale: f32, d_a: &mut [f32]) -> f64 {
        assert_eq!((a.len(), b.len(), d_a.len()), (size * size * 3, size * size * 3, size * size * 3));
        let count = (0..MAX_SCALES).take_while(|s| size >> s >= WINDOW).count();
        self.scales.resize_with(count, Scale::default);
        let Some((first, rest)) = self.scales.split_first_mut() else { return 0.0 };
        first.side = size;
        first.x.clear();
        first.x.extend_from_slice(a);
        first.y.clear();
        first.y.extend_from_slice(b);
        let mut finer = first;
        for scale in rest {
            scale.side = finer.side / 2;
            half_size(&finer.x, finer.side, &mut scale.x);
            half_size(&finer.y, finer.side, &mut scale.y);
            finer = scale;
        }
        let share = 1.0 / count as f32;
        let mut value = 0.0;
        for s in (0..count).rev() {
            let (finer, coarser) = self.scales.split_at_mut(s + 1);
            let Scale { side, x, y, d_x } = &mut finer[s];
            d_x.clear();
            d_x.resize(x.len(), 0.0);
            if let Some(coarser) = coarser.first() {
                half_size_backward(&coarser.d_x, coarser.side, *side, d_x);
            }
            let mean = self.windows.ssim_backward(x, y, *side, -share * scale, d_x);
            value += f64::from(share) * (1.0 - mean);
        }
        d_a.iter_mut().zip(&self.scales[0].d_x).for_each(|(d, g)| *d += g);
        value
    }
}

fn half_size(x: &[f32], side: usize, out: &mut Vec<f32>) {
    let half = side / 2;
    out.clear();
    out.extend((0..half * half * 3).map(|index| {
        let (row, column, channel) = (index / 3 / half, index / 3 % half, index % 3);
        let at = |r: usize, c: usize| x[((2 * row + r) * side + 2 * column + c) * 3 + channel];
        0.25 * (at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1))
    }));
}

fn half_size_backward(d_out: &[f32], half: usize, side: usize, d_x: &mut [f32]) {
    for (index, d) in d_out.iter().enumerate() {
        let (row, column, channel) = (index / 3 / half, index / 3 % half, index % 3);
        for (r, c) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            d_x[((2 * row + r) * side + 2 * column + c) * 3 + channel] += 0.25 * d;
        }
    }
}

impl Windows {
    /// Mean SSIM over window positions and channels (uniform 7 × 7, sample covariance, data range
    /// 1); adds `scale` × its gradient to `d_x`.
    fn ssim_backward(&mut self, x: &[f32], y: &[f32], side: usize, scale: f32, d_x: &mut [f32]) -> f64 {
        let positions = side - WINDOW + 1;
        let count = (WINDOW * WINDOW) as f32;
        let unbias = count / (count - 1.0);
        let weight = scale / (positions * positions * 3) as f32;
        let mut sum = 0.0;
        // The SSIM of a window is a function of five window means, so its gradient is gathered
        // through them: a pixel receives the box sum of the coefficients of the windows that hold
        // it.
        for channel in 0..3 {
            self.measure(x, y, side, channel);
            let Self { means, coefficients, .. } = self;
            coefficients.clear();
            coefficients.extend(means.iter().map(|&[mx, my, mxx, myy, mxy]| {
                let (vx, vy, vxy) = (unbias * (mxx - mx * mx), unbias * (myy - my * my), unbias * (mxy - mx * my));
                let (a1, a2) = (2.0 * mx * my + C1, 2.0 * vxy + C2);
                let (b1, b2) = (mx * mx + my * my + C1, vx + vy + C2);
                let s = (a1 * a2) / (b1 * b2);
                sum += f64::from(s);
                let d_vxy = 2.0 * a1 / (b1 * b2);
                let d_vx = -s / b2;
                let d_mx = 2.0 * my * a2 / (b1 * b2) - s * 2.0 * mx / b1 - unbias * (d_vxy * my + d_vx * 2.0 * mx);
                [d_mx, unbias * d_vx, unbias * d_vxy]
            }));
            for row in 0..side {
                for column in 0..side {
                    let mut total = [0.0f32; 3];
                    for r in row.saturating_sub(WINDOW - 1)..(row + 1).min(positions) {
                        for c in column.saturating_sub(WINDOW - 1)..(column + 1).min(positions) {
                            let coefficient = &coefficients[r * positions + c];
                            for i in 0..3 {
                                total[i] += coefficient[i];
                            }
                        }
                    }
                    let pixel = (row * side + column) * 3 + channel;
                    let [d_mean, d_square, d_product] = total;
                    d_x[pixel] += weight / count * (d_mean + 2.0 * x[pixel] * d_square + y[pixel] * d_product);
                }
            }
        }
        sum / (positions * positions * 3) as f64
    }

    /// Means of x, y, x², y², xy over every window of one channel, by running sums along rows, then
    /// columns.
    fn measure(&mut self, x: &[f32], y: &[f32], side: usize, channel: usize) {
        let Self { rows, means, .. } = self;
        let positions = side - WINDOW + 1;
        rows.clear();
        rows.extend((0..side * positions).map(|index| {
            let (row, column) = (index / positions, index % positions);
            let mut sums = [0.0f32; 5];
            for c in column..column + WINDOW {
                let pixel = (row * side + c) * 3 + channel;
                let (x, y) = (x[pixel], y[pixel]);
                for (sum, value) in sums.iter_mut().zip([x, y, x * x, y * y, x * y]) {
                    *sum += value;
                }
            }
            sums
        }));
        let scale = 1.0 / (WINDOW * WINDOW) as f32;
        means.clear();
        means.extend((0..positions * positions).map(|index| {
            let (row, column) = (index / positions, index % positions);
            let mut mean = [0.0f32; 5];
            for r in row..row + WINDOW {
                for i in 0..5 {
                    mean[i] += rows[r * positions + column][i];
                }
            }
            mean.map(|m| m * scale)
        }));
    }
}

/// β of the completeness term, in units of the density (paper §4.1).
pub(crate) const BETA: f32 = 10.0;

/// Completeness of one sample inside the body, on the activated density (paper §3.4): e^(ReLU(β −
/// σ) − β), which is 1 at σ = 0 and e^−β from σ = β on. Returns the value and its derivative by σ.
pub(crate) fn completeness(sigma: f32) -> (f32, f32) {
    let value = (-sigma.min(BETA)).exp();
    (value, if sigma < BETA { -value } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use testkit::gradient::{Tolerance, assert_gradient};
    use volrender::RandomStream;

    fn patch(size: usize, seed: u64) -> Vec<f32> {
        let mut random = RandomStream::new(&[seed]);
        (0..size * size * 3).map(|_| random.uniform()).collect()
    }

    fn plain_dissimilarity(mut a: Vec<f32>, mut b: Vec<f32>, mut size: usize) -> f64 {
        let mut values = Vec::new();
        while values.len() < 3 && size >= 7 {
            values.push(1.0 - testkit::oracle::ssim(&a, &b, size, size));
            let half = |x: &[f32]| {
                let mut out = Vec::new();
                half_size(x, size, &mut out);
                out
            };
            (a, b) = (half(&a), half(&b));
            size /= 2;
        }
        values.iter().sum::<f64>() / values.len() as f64
    }

    #[test]
    fn dissimilarity_equals_the_mean_of_plain_ssim_over_the_scales() {
        for size in [7, 14, 29, 32] {
            let (a, b) = (patch(size, 8), patch(size, 9));
            let ours = Dissimilarity::default().backward(&a, &b, size, 0.0, &mut vec![0.0; a.len()]);
            assert!((ours - plain_dissimilarity(a, b, size)).abs() < 2e-5);
        }
    }

    #[test]
    fn dissimilarity_gradient_agrees_with_central_differences() {
        for size in [7, 9, 16, 32] {
            let (a, b) = (patch(size, 1), patch(size, 2));
            let mut d_a = vec![0.0; a.len()];
            Dissimilarity::default().backward(&a, &b, size, 1.0, &mut d_a);
            // The oracle works in f64: a difference of f32 variances would drown the small
            // derivatives.
            let tolerance = Tolerance { abs: 2e-6, rel: 0.01 };
            let picked: Vec<usize> = (0..a.len()).step_by(a.len().div_ceil(150)).collect();
            let point: Vec<f32> = picked.iter().map(|&i| a[i]).collect();
            let analytic: Vec<f32> = picked.iter().map(|&i| d_a[i]).collect();
            assert_gradient("dissimilarity", &point, &analytic, 2e-3, tolerance, |x| {
                let mut moved = a.clone();
                picked.iter().zip(x).for_each(|(&i, &v)| moved[i] = v);
                plain_dissimilarity(moved, b.clone(), size)
            });
        }
    }

    #[test]
    fn patches_smaller_than_the_window_cost_nothing() {
        let a = patch(4, 1);
        assert_eq!(Dissimilarity::default().backward(&a, &patch(4, 2), 4, 1.0, &mut [0.0; 48]), 0.0);
    }

    #[test]
    fn completeness_is_one_when_empty_and_flat_beyond_beta() {
        assert_eq!(completeness(0.0), (1.0, -1.0));
        assert_eq!(completeness(10.0), ((-10.0f32).exp(), 0.0));
        assert_eq!(completeness(1e30).1, 0.0);
        let (h, s) = (1e-2, 1.7);
        let numeric = (completeness(s + h).0 - completeness(s - h).0) / (2.0 * h);
        assert!((numeric - completeness(s).1).abs() < 1e-4);
    }
}
