use std::ops::Range;

use glam::{Vec3, Vec4};

use crate::exponential::{one_minus_exp, optical_depth};

/// Samples per block of SIMD exponentials.
pub(crate) const BLOCK: usize = 32;

/// The samples of one ray, nearest first. All slices are (S).
///
/// ```
/// use glam::Vec3;
/// use volrender::{RaySamples, composite};
///
/// // Two rays of two samples each, in one set of slices: fog that absorbs half, then a wall.
/// let sigma = [2f32.ln(), 1e9, 0.0, 2f32.ln()];
/// let samples = RaySamples {
///     sigma: &sigma,
///     likelihood: &[1.0; 4],
///     delta: &[1.0; 4],
///     t: &[0.5, 1.5, 0.5, 1.5],
///     rgb: &[Vec3::X, Vec3::Y, Vec3::X, Vec3::Y],
/// };
/// let mut weights = [0.0; 2];
/// let pixel = composite(samples.slice(0..2), Vec3::ZERO, &mut weights);
/// assert!(pixel.color.distance(Vec3::new(0.5, 0.5, 0.0)) < 1e-6 && pixel.termination == Some(1));
/// let pixel = composite(samples.slice(2..4), Vec3::ZERO, &mut weights);
/// assert!(pixel.color.distance(Vec3::new(0.0, 0.5, 0.0)) < 1e-6);
/// ```
#[derive(Clone, Copy, Debug, Default)]
pub struct RaySamples<'a> {
    /// Density σ ≥ 0 in 1/length; infinity counts as `f32::MAX`.
    pub sigma: &'a [f32],
    /// Foreground likelihood f in [0, 1], which scales α; 1 for an ordinary renderer.
    pub likelihood: &'a [f32],
    /// Width δ ≥ 0 of the sample's own bin; infinity counts as `f32::MAX`.
    pub delta: &'a [f32],
    /// Depth, finite.
    pub t: &'a [f32],
    /// Colour c.
    pub rgb: &'a [Vec3],
}

impl RaySamples<'_> {
    /// The samples in `range`: one ray of several stored consecutively.
    ///
    /// # Panics
    /// If the range exceeds a slice.
    pub fn slice(&self, range: Range<usize>) -> Self {
        Self {
            sigma: &self.sigma[range.clone()],
            likelihood: &self.likelihood[range.clone()],
            delta: &self.delta[range.clone()],
            t: &self.t[range.clone()],
            rgb: &self.rgb[range],
        }
    }

    /// Asserts that all slices and results have the same length.
    pub(crate) fn assert_lengths<const N: usize>(&self, results: [usize; N]) {
        let Self { sigma, likelihood, delta, t, rgb } = self;
        let n = sigma.len();
        assert!(
            [likelihood.len(), delta.len(), t.len(), rgb.len()] == [n; 4] && results == [n; N],
            "{n} sigma, {} likelihood, {} delta, {} t, {} rgb, results of {results:?}: expected equal lengths",
            likelihood.len(),
            delta.len(),
            t.len(),
            rgb.len(),
        );
    }
}

/// One composited ray.
///
/// ```
/// use glam::Vec3;
/// use volrender::{Composite, RaySamples, composite};
///
/// // Red fog at depth 3 that absorbs half, before a white background.
/// let (sigma, rgb) = ([2f32.ln()], [Vec3::X]);
/// let samples = RaySamples { sigma: &sigma, likelihood: &[1.0], delta: &[1.0], t: &[3.0], rgb: &rgb };
/// let Composite { color, opacity, depth, termination } = composite(samples, Vec3::ONE, &mut [0.0]);
/// assert!(color.distance(Vec3::new(1.0, 0.5, 0.5)) < 1e-6 && (opacity - 0.5).abs() < 1e-6);
/// assert!((depth / opacity - 3.0).abs() < 1e-6 && termination == Some(0));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Composite {
    /// C = Σ w_i c_i + (1 − Σ w_i) · background.
    pub color: Vec3,
    /// Σ w_i, in [0, 1].
    pub opacity: f32,
    /// Σ w_i t_i; divide by the opacity for the expected depth of the surface.
    pub depth: f32,
    /// Lowest index among the samples of largest α; `None` without samples or where every α is 0.
    pub termination: Option<u32>,
}

/// Composites the samples of one ray and writes their weights (S), w_i = α_i Π_{j<i} (1 − α_j) with
/// α_i = f_i (1 − exp(−σ_i δ_i)) (Max 1995; the likelihood f as in HumanNeRF, 2022).
///
/// Omitting samples with α = 0 changes nothing but the index of the termination. A NaN in the
/// inputs makes the colour NaN and is never the termination. Transmittance below 1e-38 counts as 0.
/// Bins of any width and densities of any size give finite results, if depths are below 3.4e38 and
/// colours are finite. [`RaySamples`] has an example.
///
/// # Panics
/// If the slices differ in length.
pub fn composite(samples: RaySamples<'_>, background: Vec3, weights: &mut [f32]) -> Composite {
    samples.assert_lengths([weights.len()]);
    pulp::Arch::new().dispatch(Kernel(
        #[inline(always)]
        || forward(samples, background, weights),
    ))
}

#[inline(always)]
fn forward(samples: RaySamples<'_>, background: Vec3, weights: &mut [f32]) -> Composite {
    let RaySamples { sigma, likelihood, delta, t, rgb } = samples;
    let mut transmittance = 1.0;
    let mut sum = Vec4::ZERO; // colour and depth
    let mut opacity = 0.0;
    let mut largest = 0.0;
    let mut termination = None;
    let mut alpha = [0.0f32; BLOCK];
    let inputs = sigma.chunks(BLOCK).zip(likelihood.chunks(BLOCK));
    let inputs = inputs.zip(delta.chunks(BLOCK)).zip(t.chunks(BLOCK));
    let blocks = inputs.zip(rgb.chunks(BLOCK)).zip(weights.chunks_mut(BLOCK));
    for (block, (((((sigma, likelihood), delta), t), rgb), weights)) in blocks.enumerate() {
        let alpha = &mut alpha[..sigma.len()];
        let inputs = sigma.iter().zip(likelihood).zip(delta);
        for (alpha, ((&sigma, &likelihood), &delta)) in alpha.iter_mut().zip(inputs) {
            *alpha = likelihood * one_minus_exp(optical_depth(sigma, delta)).0;
        }
        // Sequential sums: omitting samples with α = 0 changes no bit.
        let outputs = weights.iter_mut().zip(t).zip(rgb);
        for (i, (&alpha, ((weight, &t), &rgb))) in alpha.iter().zip(outputs).enumerate() {
            if alpha > largest {
                (largest, termination) = (alpha, Some((block * BLOCK + i) as u32));
            }
            *weight = transmittance * alpha;
            transmittance *= 1.0 - alpha;
            sum += *weight * rgb.extend(t);
            opacity += *weight;
        }
        transmittance = flushed(transmittance);
    }
    // The sum of weights may exceed 1 by rounding.
    let opacity = if opacity > 1.0 { 1.0 } else { opacity };
    Composite { color: sum.truncate() + (1.0 - opacity) * background, opacity, depth: sum.w, termination }
}

/// Closure that [`pulp::Arch::dispatch`] compiles for each instruction set.
///
/// `FnMut` inlines the closure's body; `FnOnce`, which `dispatch` accepts directly, calls it
/// through a shim compiled for the baseline.
pub(crate) struct Kernel<F>(pub F);

impl<R, F: FnMut() -> R> pulp::WithSimd for Kernel<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, _: S) -> R {
        (self.0)()
    }
}

/// Transmittance after a block, denormal numbers flushed to 0: they are slow and change no pixel.
#[inline(always)]
pub(crate) fn flushed(transmittance: f32) -> f32 {
    if transmittance < f32::MIN_POSITIVE { 0.0 } else { transmittance }
}
