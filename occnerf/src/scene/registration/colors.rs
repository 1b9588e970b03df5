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
}
