use glam::Vec3;

use crate::composite::{BLOCK, next_transmittance};
use crate::exponential::one_minus_exp;

/// Gradients of [`composite`](crate::composite) of one ray, given those of its colour and its opacity, and the
/// `weights` that it wrote. All slices are (S); `d_sigma`, `d_rgb` and `d_likelihood` are overwritten.
///
/// With V_i = c_i · d_color + d_opacity the value of stopping at sample i, and R_i the value of everything behind it
/// (R_S = background · d_color, R_{i−1} = α_i V_i + (1 − α_i) R_i), the derivative by α_i is T_i (V_i − R_i). Nothing is
/// divided by 1 − α, so that an opaque sample, and every sample behind it, has its exact gradient.
///
/// # Panics
/// Where the slices differ in length.
pub fn composite_backward(
    sigma: &[f32],
    likelihood: &[f32],
    delta: &[f32],
    rgb: &[Vec3],
    background: Vec3,
    weights: &[f32],
    d_color: Vec3,
    d_opacity: f32,
    d_sigma: &mut [f32],
    d_rgb: &mut [Vec3],
    d_likelihood: &mut [f32],
) {
    let n = sigma.len();
    assert!(
        [likelihood.len(), delta.len(), rgb.len(), weights.len()] == [n; 4]
            && [d_sigma.len(), d_rgb.len(), d_likelihood.len()] == [n; 3],
        "{n} sigma, {} likelihood, {} delta, {} rgb, {} weights, {} d_sigma, {} d_rgb, {} d_likelihood: expected \
         equal lengths",
        likelihood.len(),
        delta.len(),
        rgb.len(),
        weights.len(),
        d_sigma.len(),
        d_rgb.len(),
        d_likelihood.len()
    );
    pulp::Arch::new().dispatch(
        #[inline(always)]
        || {
            backward(
                sigma, likelihood, delta, rgb, background, weights, d_color, d_opacity, d_sigma,
                d_rgb, d_likelihood,
            )
        },
    )
}

#[inline(always)]
fn backward(
    sigma: &[f32],
    likelihood: &[f32],
    delta: &[f32],
    rgb: &[Vec3],
    background: Vec3,
    weights: &[f32],
    d_color: Vec3,
    d_opacity: f32,
    d_sigma: &mut [f32],
    d_rgb: &mut [Vec3],
    d_likelihood: &mut [f32],
) {
    let n = sigma.len();
    let mut transmittance = 1.0;
    // The outputs serve as scratch: dα/dσ, dα/df, and in d_rgb the transmittance in front of each sample.
    for start in (0..n).step_by(BLOCK) {
        let block = start..n.min(start + BLOCK);
        let m = block.len();
        let (sigma, delta) = (&sigma[block.clone()], &delta[block.clone()]);
        let likelihood = &likelihood[block.clone()];
        let (d_sigma, d_likelihood) = (&mut d_sigma[block.clone()], &mut d_likelihood[block.clone()]);
        for i in 0..m {
            let (absorbed, passed) = one_minus_exp(sigma[i] * delta[i]);
            d_sigma[i] = likelihood[i] * delta[i] * passed;
            d_likelihood[i] = absorbed;
        }
        let d_rgb = &mut d_rgb[block];
        for i in 0..m {
            d_rgb[i].x = transmittance;
            transmittance = next_transmittance(transmittance, likelihood[i] * d_likelihood[i]);
        }
    }
    let mut behind = background.dot(d_color);
    for i in (0..n).rev() {
        let value = rgb[i].dot(d_color) + d_opacity;
        let d_alpha = d_rgb[i].x * (value - behind);
        let alpha = likelihood[i] * d_likelihood[i];
        behind = alpha * value + (1.0 - alpha) * behind;
        d_sigma[i] *= d_alpha;
        d_likelihood[i] *= d_alpha;
        d_rgb[i] = weights[i] * d_color;
    }
}
