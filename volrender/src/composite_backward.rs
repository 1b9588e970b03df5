use glam::Vec3;

use crate::composite::{BLOCK, Kernel, RaySamples, flushed};
use crate::exponential::{one_minus_exp, optical_depth, saturated};

/// Outputs for the gradients of one ray's samples, each (S); overwritten.
///
/// ```
/// use glam::Vec3;
/// use volrender::{RaySamples, SampleGradients, composite, composite_backward};
///
/// let (sigma, rgb) = ([0.0], [Vec3::X]);
/// let samples = RaySamples { sigma: &sigma, likelihood: &[1.0], delta: &[0.5], t: &[1.0], rgb: &rgb };
/// let mut weights = [0.0];
/// composite(samples, Vec3::ZERO, &mut weights);
///
/// // At σ = 0 the red channel grows by δ = 0.5 per unit of density.
/// let (mut d_sigma, mut d_rgb, mut d_likelihood) = ([0.0], [Vec3::ZERO], [0.0]);
/// let gradients =
///     SampleGradients { d_sigma: &mut d_sigma, d_rgb: &mut d_rgb, d_likelihood: &mut d_likelihood };
/// composite_backward(samples, Vec3::ZERO, &weights, Vec3::X, 0.0, gradients);
/// assert_eq!(d_sigma, [0.5]);
/// ```
#[derive(Debug)]
pub struct SampleGradients<'a> {
    /// Gradient of the densities.
    pub d_sigma: &'a mut [f32],
    /// Gradient of the colours.
    pub d_rgb: &'a mut [Vec3],
    /// Gradient of the likelihoods.
    pub d_likelihood: &'a mut [f32],
}

/// Backward pass of [`composite`](crate::composite): writes the gradients of the samples of one
/// ray, given those of its colour and opacity and the `weights` (S) of the forward pass.
///
/// With V_i = c_i · d_color + d_opacity the value of stopping at sample i, and R_i the value of
/// everything behind it (R_S = background · d_color, R_{i−1} = α_i V_i + (1 − α_i) R_i), the
/// derivative by α_i is T_i (V_i − R_i). There is no division by 1 − α, so that opaque samples and
/// the samples behind them have exact gradients. A density's gradient saturates at ±`f32::MAX`,
/// which bins wider than 1e38 can reach. [`SampleGradients`] has an example.
///
/// # Panics
/// If the slices differ in length.
pub fn composite_backward(
    samples: RaySamples<'_>,
    background: Vec3,
    weights: &[f32],
    d_color: Vec3,
    d_opacity: f32,
    gradients: SampleGradients<'_>,
) {
    let SampleGradients { d_sigma, d_rgb, d_likelihood } = gradients;
    samples.assert_lengths([weights.len(), d_sigma.len(), d_rgb.len(), d_likelihood.len()]);
    pulp::Arch::new().dispatch(Kernel(
        #[inline(always)]
        || {
            let gradients = SampleGradients { d_sigma, d_rgb, d_likelihood };
            backward(samples, background, weights, d_color, d_opacity, gradients)
        },
    ))
}

#[inline(always)]
fn backward(
    samples: RaySamples<'_>,
    background: Vec3,
    weights: &[f32],
    d_color: Vec3,
    d_opacity: f32,
    gradients: SampleGradients<'_>,
) {
    let RaySamples { sigma, likelihood, delta, rgb, .. } = samples;
    let SampleGradients { d_sigma, d_rgb, d_likelihood } = gradients;
    // The outputs first hold dα/dσ, dα/df and, in d_rgb, the transmittance in front of each sample.
    let mut transmittance = 1.0;
    let inputs = sigma.chunks(BLOCK).zip(likelihood.chunks(BLOCK)).zip(delta.chunks(BLOCK));
    let outputs = d_sigma.chunks_mut(BLOCK).zip(d_likelihood.chunks_mut(BLOCK)).zip(d_rgb.chunks_mut(BLOCK));
    for (((sigma, likelihood), delta), ((d_sigma, d_likelihood), d_rgb)) in inputs.zip(outputs) {
        let inputs = sigma.iter().zip(likelihood).zip(delta);
        let outputs = d_sigma.iter_mut().zip(&mut *d_likelihood);
        for (((&sigma, &likelihood), &delta), (d_sigma, d_likelihood)) in inputs.zip(outputs) {
            let (absorbed, passed) = one_minus_exp(optical_depth(sigma, delta));
            *d_sigma = likelihood * saturated(delta) * passed;
            *d_likelihood = absorbed;
        }
        for ((&likelihood, &d_likelihood), d_rgb) in likelihood.iter().zip(&*d_likelihood).zip(d_rgb) {
            d_rgb.x = transmittance;
            transmittance *= 1.0 - likelihood * d_likelihood;
        }
        transmittance = flushed(transmittance);
    }

    let mut behind = background.dot(d_color);
    let inputs = likelihood.iter().zip(rgb).zip(weights);
    let outputs = d_sigma.iter_mut().zip(d_likelihood).zip(d_rgb);
    for (((&likelihood, &rgb), &weight), ((d_sigma, d_likelihood), d_rgb)) in inputs.zip(outputs).rev() {
        let value = rgb.dot(d_color) + d_opacity;
        let d_alpha = d_rgb.x * (value - behind);
        let alpha = likelihood * *d_likelihood;
        behind = alpha * value + (1.0 - alpha) * behind;
        *d_sigma = saturated(*d_sigma * d_alpha);
        *d_likelihood *= d_alpha;
        *d_rgb = weight * d_color;
    }
}
