use glam::Vec3;

use crate::exponential::one_minus_exp;

/// Samples whose exponentials are computed together in SIMD lanes.
pub(crate) const BLOCK: usize = 32;

/// One composited ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Composite {
    /// C = Σ w_i c_i + (1 − Σ w_i) · background.
    pub color: Vec3,
    /// Σ w_i, in [0, 1].
    pub opacity: f32,
    /// Σ w_i t_i; divide by the opacity for the mean depth of what was hit.
    pub depth: f32,
    /// Lowest index among the samples of largest α; `None` without samples or where every α is 0.
    pub termination: Option<u32>,
}

/// Composites the samples of one ray, nearest first, and writes their weights w_i = α_i Π_{j<i} (1 − α_j) with
/// α_i = f_i (1 − exp(−σ_i δ_i)) (Max 1995; the likelihood f as in HumanNeRF, 2022). All slices are (S).
///
/// `sigma` is density in 1/length, at least 0, however large; `likelihood` f is in [0, 1]; `delta` is the width of
/// the sample's own bin; `t` its depth. Samples that are known to have α = 0 may be left out: the result is the
/// same. A NaN in the inputs makes the colour NaN and never wins the termination.
///
/// Transmittance below 1e-38 counts as 0.
///
/// # Panics
/// Where the slices differ in length.
pub fn composite(
    sigma: &[f32],
    likelihood: &[f32],
    delta: &[f32],
    t: &[f32],
    rgb: &[Vec3],
    background: Vec3,
    weights: &mut [f32],
) -> Composite {
    let n = sigma.len();
    assert!(
        [likelihood.len(), delta.len(), t.len(), rgb.len(), weights.len()] == [n; 5],
        "{n} sigma, {} likelihood, {} delta, {} t, {} rgb, {} weights: expected equal lengths",
        likelihood.len(),
        delta.len(),
        t.len(),
        rgb.len(),
        weights.len()
    );
    pulp::Arch::new().dispatch(
        #[inline(always)]
        || forward(sigma, likelihood, delta, t, rgb, background, weights),
    )
}

#[inline(always)]
fn forward(
    sigma: &[f32],
    likelihood: &[f32],
    delta: &[f32],
    t: &[f32],
    rgb: &[Vec3],
    background: Vec3,
    weights: &mut [f32],
) -> Composite {
    let n = sigma.len();
    let mut transmittance = 1.0;
    let mut color = Vec3::ZERO;
    let mut depth = 0.0;
    let mut opacity = 0.0;
    let mut largest = 0.0;
    let mut termination = None;
    let mut alpha = [0.0f32; BLOCK];
    for start in (0..n).step_by(BLOCK) {
        let block = start..n.min(start + BLOCK);
        let m = block.len();
        let (sigma, delta) = (&sigma[block.clone()], &delta[block.clone()]);
        let (likelihood, t) = (&likelihood[block.clone()], &t[block.clone()]);
        let (rgb, weights) = (&rgb[block.clone()], &mut weights[block]);
        for i in 0..m {
            alpha[i] = likelihood[i] * one_minus_exp(sigma[i] * delta[i]).0;
        }
        for i in 0..m {
            let alpha = alpha[i];
            if alpha > largest {
                largest = alpha;
                termination = Some((start + i) as u32);
            }
            let w = transmittance * alpha;
            transmittance = next_transmittance(transmittance, alpha);
            weights[i] = w;
            color += w * rgb[i];
            depth += w * t[i];
            opacity += w;
        }
    }
    // Rounding may carry a sum of weights past 1.
    let opacity = if opacity > 1.0 { 1.0 } else { opacity };
    Composite {
        color: color + (1.0 - opacity) * background,
        opacity,
        depth,
        termination,
    }
}

/// T_{i+1}. Denormal numbers are flushed: they change no pixel and are slow.
#[inline(always)]
pub(crate) fn next_transmittance(transmittance: f32, alpha: f32) -> f32 {
    let next = transmittance * (1.0 - alpha);
    if next < f32::MIN_POSITIVE { 0.0 } else { next }
}
