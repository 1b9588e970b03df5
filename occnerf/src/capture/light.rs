//! The light that all frames of a video share.

use glam::Vec3;
use surface_query::vertex_normals;

/// Least brightness: what a light leaves black says nothing of its colour.
const DARKEST: f32 = 0.2;

/// Brightness by normal, 1 + slope · n: the first two bands of spherical harmonics (Ramamoorthi and
/// Hanrahan 2001). Even light by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Light {
    /// Where surfaces are brightest, in the world, and by how much of the mean.
    pub slope: Vec3,
}

impl Light {
    /// How bright a surface with this unit normal is, relative to the mean over all directions.
    #[must_use]
    pub fn on(&self, normal: Vec3) -> f32 {
        (1.0 + self.slope.dot(normal)).max(DARKEST)
    }

    /// How bright each vertex of a surface is, (V); nothing under even light, as bright as 1.
    ///
    /// # Panics
    /// If a face names a vertex that does not exist.
    #[must_use]
    pub fn on_surface(&self, vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<f32> {
        if self.slope == Vec3::ZERO {
            return Vec::new();
        }
        vertex_normals(vertices, faces).iter().map(|normal| self.on(normal.normalize_or_zero())).collect()
    }
}
