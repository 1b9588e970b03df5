use glam::Vec3;

use crate::composite::{BLOCK, RaySamples, flushed};
use crate::exponential::{one_minus_exp, optical_depth, saturated};
use crate::simd::Kernel;

/// Outputs for the gradients of one ray's samples, each (S); overwritten.
#[derive(Debug)]
pub struct SampleGradients<'a> {
    /// Gradient by density.
    pub d_sigma: &'a mut [f32],
    /// Gradient by colour.
    pub d_rgb: &'a mut [Vec3],
    /// Gradient by likelihood.
    pub d_likelihood: &'a mut [f32],
}

/// Writes the gradients of [`composite`](crate::composite) by the samples of one ray, given those
/// of its colour and its opacity, and the `weights` (S) that it wrote.
///
/// With V_i = c_i · d_color + d_opacity the value of stopping at sample i, and R_i the value of
/// everything behind it (R_S = background · d_color, R_{i−1} = α_i V_i + (1 − α_i) R_i), the
/// derivative by α_i is T_i (V_i − R_i). Nothing is divided by 1 − α, so that an opaque sample, and
/// every sample behind it, has its exact gradient.
///
/// # Panics
/// Where the slices differ in length.
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
    // The outputs serve as scratch: dα/dσ, dα/df, and in d_rgb the transmittance in front of each
    // sample.
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
