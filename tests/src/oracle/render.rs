use glam::{DVec3, Vec3};

/// Alpha compositing of one ray, α_i = f_i (1 − exp(−σ_i δ_i)): colour over `background`, opacity,
/// weights (S) and the lowest index of the largest α (`None` for no samples or all-zero α). All
/// inputs are (S).
///
/// # Panics
/// Where the slices differ in length.
#[must_use]
pub fn composite(
    sigma: &[f32],
    likelihood: &[f32],
    delta: &[f32],
    rgb: &[Vec3],
    background: Vec3,
) -> (DVec3, f64, Vec<f64>, Option<u32>) {
    let n = sigma.len();
    assert!(
        likelihood.len() == n && delta.len() == n && rgb.len() == n,
        "composite: {n} σ, {} f, {} δ, {} colours",
        likelihood.len(),
        delta.len(),
        rgb.len()
    );
    let mut color = DVec3::ZERO;
    let mut weights = Vec::new();
    let mut largest = 0.0;
    let mut termination = None;
    let mut transmittance = 1.0;
    for i in 0..n {
        let optical_depth = f64::from(sigma[i]) * f64::from(delta[i]);
        let alpha = f64::from(likelihood[i]) * -(-optical_depth).exp_m1();
        if alpha > largest {
            largest = alpha;
            termination = Some(i as u32);
        }
        weights.push(transmittance * alpha);
        color += rgb[i].as_dvec3() * transmittance * alpha;
        transmittance *= 1.0 - alpha;
    }
    let opacity: f64 = weights.iter().sum();
    (color + background.as_dvec3() * (1.0 - opacity), opacity, weights, termination)
}
