//! The colours that a video shows of the prior.

use glam::Vec3;

use crate::Error;
use crate::capture::Light;
use crate::model::colors::VertexColors;
use crate::scene::light::{albedo, measure_light};
use crate::scene::prepared::Scene;
use crate::scene::seen::deeper;
use crate::scene::unseen::complete;

impl VertexColors {
    /// The colour that is closest to the visible training pixels that saw a vertex, by ray casting,
    /// under the light of the scene if the configuration asks for one; a vertex that none saw takes
    /// a mean of those that some saw, by their canonical distances, along the stripes if there are
    /// any. Pixels at the edge of masks do not count where they show what is beside the person.
    ///
    /// # Errors
    /// Pictures that cannot be read.
    pub fn measure(scene: &Scene) -> Result<Self, Error> {
        let vertices = scene.body.canonical.vertices.len();
        let frames = deeper(&scene.seen()?, scene.edge);
        let light = if scene.lit { measure_light(&frames, vertices) } else { Light::default() };
        let sums = albedo(frames.iter().flatten(), vertices, |normal| light.on(normal));
        let seen: Vec<bool> = sums.iter().map(|sum| sum.1 > 0.0).collect();
        let mut colors: Vec<Vec3> = sums.iter().map(|(sum, squares)| *sum / squares.max(f32::MIN_POSITIVE)).collect();
        complete(&scene.body, &mut colors, &seen);
        Ok(Self { colors, seen, light })
    }
}
