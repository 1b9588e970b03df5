//! Per-vertex albedo and light shared by all frames, and the colour residuals against them.

use glam::Vec3;

use crate::capture::Light;
use crate::scene::registration::observations::Observations;
use crate::scene::seen::{ColorObservation, albedo, lamp};

/// Least standard deviation of a colour residual, and least number of frames that observe a vertex.
const NOISE: f32 = 0.05;
const LEAST_FRAMES: u32 = 3;

/// Albedo of the vertices, and the light.
pub(super) struct Colors {
    /// Albedo and number of observations, (V).
    albedo: Vec<(Vec3, u32)>,
    light: Light,
    /// Robust standard deviation of the residuals (scaled median absolute deviation).
    pub noise: f32,
}

impl Colors {
    pub fn measure(observations: &[Observations], vertices: usize) -> Self {
        let seen = || observations.iter().flat_map(|observed| &observed.colors);
        let light = lamp(seen(), vertices);
        let mut counts = vec![0; vertices];
        seen().for_each(|(v, ..)| counts[*v as usize] += 1);
        let sums = albedo(seen(), vertices, light);
        let albedo = sums.iter().zip(counts).map(|(&(sum, squares), n)| (sum / squares.max(f32::MIN_POSITIVE), n));
        let mut colors = Self { albedo: albedo.collect(), light, noise: 1.0 };
        if let Some(noise) = deviation(seen().filter_map(|seen| colors.residual(seen))) {
            colors.noise = noise.max(NOISE);
        }
        colors
    }

    /// Observed colour minus shaded albedo; `None` for a vertex with too few observations.
    pub fn residual(&self, (vertex, color, normal): &ColorObservation) -> Option<Vec3> {
        let (albedo, count) = self.albedo[*vertex as usize];
        (count >= LEAST_FRAMES).then(|| *color - self.light.on(*normal) * albedo)
    }

    /// Jacobian of [`Colors::residual`] with respect to a rotation of the surface, a row a channel.
    pub fn rotation_jacobian(&self, (vertex, _, normal): &ColorObservation) -> [Vec3; 3] {
        let turn = self.light.change(*normal).cross(*normal);
        self.albedo[*vertex as usize].0.to_array().map(|albedo| albedo * turn)
    }
}

/// Scaled median absolute deviation of colour residuals; `None` for no residuals.
pub(crate) fn deviation(residuals: impl Iterator<Item = Vec3>) -> Option<f32> {
    let mut errors: Vec<f32> = residuals.map(|residual| residual.abs().element_sum() / 3.0).collect();
    let middle = errors.len() / 2;
    let median = if errors.is_empty() { None } else { Some(*errors.select_nth_unstable_by(middle, f32::total_cmp).1) };
    // 1.48 scales a median absolute deviation to a normal distribution's σ.
    median.map(|median| 1.48 * median)
}

/// Weight of the robust loss of Geman and McClure (1985) at three standard deviations.
pub(crate) fn robust(squared: f32, noise: f32) -> f32 {
    (1.0 + squared / (9.0 * noise * noise)).powi(-2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn residuals_change_with_rotations_as_by_finite_differences(
            slope in prop::array::uniform3(-2.0f32..2.0),
            normal in prop::array::uniform3(-1.0f32..1.0),
            albedo in prop::array::uniform3(0.0f32..1.0),
            axis in 0usize..3,
        ) {
            let (normal, axis, h) = (Vec3::from(normal).normalize_or(Vec3::X), Vec3::AXES[axis], 1e-2);
            let light = Light { slope: Vec3::from(slope) };
            let turned = |h: f32| Quat::from_axis_angle(axis, h) * normal;
            // Where it becomes darkest it has a kink.
            let is_darkest = |h: f32| light.on(turned(h)) == Light::DARKEST;
            prop_assume!(is_darkest(h) == is_darkest(-h));
            let colors = Colors { albedo: vec![(Vec3::from(albedo), LEAST_FRAMES)], light, noise: 1.0 };
            let residual = |h: f32| colors.residual(&(0, Vec3::splat(0.5), turned(h))).unwrap();
            let numeric = (residual(h) - residual(-h)) / (2.0 * h);
            let exact = Vec3::from(colors.rotation_jacobian(&(0, Vec3::ZERO, normal)).map(|turned| turned.dot(axis)));
            prop_assert!(exact.distance(numeric) < 2e-3, "{exact} {numeric}");
        }
    }
}
