//! Colours that all frames agree on.

use glam::Vec3;

use crate::capture::Light;
use crate::scene::light::{Seen, albedo, lamp};
use crate::scene::registration::sight::Sight;

/// Least noise of a colour, and frames that have to show a vertex.
const NOISE: f32 = 0.05;
const SHOWN: u32 = 3;

/// The colours of the vertices under even light, and the light.
pub(super) struct Colors {
    /// Colour, and in how many frames it was seen, V.
    albedo: Vec<(Vec3, u32)>,
    light: Light,
    /// Standard deviation of what is seen from what it should be, by its median.
    pub noise: f32,
}

impl Colors {
    pub fn measure(sights: &[Sight], vertices: usize) -> Self {
        let seen = || sights.iter().flat_map(|sight| &sight.seen);
        let light = lamp(seen(), vertices);
        let mut counts = vec![0; vertices];
        seen().for_each(|(v, ..)| counts[*v as usize] += 1);
        let sums = albedo(seen(), vertices, light);
        let albedo = sums.iter().zip(counts).map(|(&(sum, squares), n)| (sum / squares.max(f32::MIN_POSITIVE), n));
        let mut colors = Self { albedo: albedo.collect(), light, noise: 1.0 };
        let mut errors: Vec<f32> =
            seen().filter_map(|seen| Some(colors.error(seen)?.abs().element_sum() / 3.0)).collect();
        if !errors.is_empty() {
            let middle = errors.len() / 2;
            // Of a normal distribution.
            colors.noise = (1.48 * *errors.select_nth_unstable_by(middle, f32::total_cmp).1).max(NOISE);
        }
        colors
    }

    /// What is seen less what it should be; `None` where too few frames say what.
    pub fn error(&self, (vertex, color, normal): &Seen) -> Option<Vec3> {
        let (albedo, count) = self.albedo[*vertex as usize];
        (count >= SHOWN).then(|| *color - self.light.on(*normal) * albedo)
    }

    /// How what [`Colors::error`] says changes as the surface turns about an axis, a row a channel.
    pub fn turned(&self, (vertex, _, normal): &Seen) -> [Vec3; 3] {
        let turn = self.light.change(*normal).cross(*normal);
        self.albedo[*vertex as usize].0.to_array().map(|albedo| albedo * turn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn errors_change_with_the_surfaces_turn_as_finite_differences_do(
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
            let colors = Colors { albedo: vec![(Vec3::from(albedo), SHOWN)], light, noise: 1.0 };
            let error = |h: f32| colors.error(&(0, Vec3::splat(0.5), turned(h))).unwrap();
            let numeric = (error(h) - error(-h)) / (2.0 * h);
            let exact = Vec3::from(colors.turned(&(0, Vec3::ZERO, normal)).map(|turned| turned.dot(axis)));
            prop_assert!(exact.distance(numeric) < 2e-3, "{exact} {numeric}");
        }
    }
}
