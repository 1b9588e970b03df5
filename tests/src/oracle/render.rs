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

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    #[test]
    fn a_uniform_fog_follows_beer_and_lambert() {
        let n = 50;
        let (color, opacity, weights, termination) =
            composite(&vec![2.0; n], &vec![1.0; n], &vec![0.01; n], &vec![Vec3::X; n], Vec3::Y);
        let expected = 1.0 - (-1.0f64).exp();
        assert_abs_diff_eq!(opacity, expected, epsilon = 1e-6);
        assert!(color.distance(DVec3::new(expected, 1.0 - expected, 0.0)) < 1e-6);
        assert!(weights.windows(2).all(|w| w[0] > w[1]));
        assert_eq!(termination, Some(0));
    }

    #[test]
    fn an_opaque_sample_hides_what_is_behind_it() {
        let rgb = [Vec3::X, Vec3::Y, Vec3::Z];
        let (color, opacity, weights, termination) = composite(&[0.0, 1e9, 1e9], &[1.0; 3], &[0.1; 3], &rgb, Vec3::ONE);
        assert_eq!((color, opacity), (DVec3::Y, 1.0));
        assert_eq!(weights, [0.0, 1.0, 0.0]);
        assert_eq!(termination, Some(1), "the lowest index of equal alphas");
    }

    #[test]
    fn likelihood_bounds_alpha_and_nothing_is_background() {
        let (_, opacity, ..) = composite(&[1e9], &[0.25], &[0.1], &[Vec3::X], Vec3::ZERO);
        assert_eq!(opacity, 0.25);
        let (color, opacity, _, termination) = composite(&[], &[], &[], &[], Vec3::ONE);
        assert_eq!((color, opacity, termination), (DVec3::ONE, 0.0, None));
        assert_eq!(composite(&[0.0], &[1.0], &[1.0], &[Vec3::X], Vec3::ZERO).3, None);
    }
}
