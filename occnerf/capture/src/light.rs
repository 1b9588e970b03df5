//! The light that all frames of a video share.

use glam::Vec3;
use surface_query::vertex_normals;

/// How much brighter than a linear light surfaces are that face the lamp or turn their back on it,
/// and darker those that it grazes: 0.94 under a point far away, 0 under an evenly bright half of
/// the sky. Between them, for lamps have a size; chosen on the tuning captures.
const LAMP: f32 = 0.5;

/// Brightness by normal n under one lamp and what comes evenly from everywhere,
/// 1 + s · n + ½ |s| ((ŝ · n)² − ⅓) with s its slope, at least 0.2: three bands of spherical
/// harmonics (Ramamoorthi and Hanrahan 2001), of which the third follows from the second. Even
/// light by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Light {
    /// Where the lamp is, in the world, and by how much of the mean it lights.
    pub slope: Vec3,
}

impl Light {
    /// Least brightness: what a light leaves black says nothing of its colour.
    pub const DARKEST: f32 = 0.2;

    /// What the slope is multiplied with to light a surface with this unit normal, for a lamp in
    /// this direction (a unit vector, or zero for a linear light).
    pub fn along(lamp: Vec3, normal: Vec3) -> Vec3 {
        normal + LAMP * (lamp.dot(normal) * normal - lamp / 3.0)
    }

    /// How bright a surface with this unit normal is, relative to the mean over all directions.
    #[must_use]
    pub fn on(&self, normal: Vec3) -> f32 {
        (1.0 + self.slope.dot(Self::along(self.slope.normalize_or_zero(), normal))).max(Self::DARKEST)
    }

    /// How [`Light::on`] changes with the normal.
    pub fn change(&self, normal: Vec3) -> Vec3 {
        let toward = self.slope.normalize_or_zero();
        if self.on(normal) > Self::DARKEST { (1.0 + 2.0 * LAMP * toward.dot(normal)) * self.slope } else { Vec3::ZERO }
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
