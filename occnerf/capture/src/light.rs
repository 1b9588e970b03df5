//! The light of a video.

use glam::Vec3;
use surface_query::vertex_normals;

/// Weight of the third band relative to a linear light: 0.94 for a distant point light, 0 for a
/// uniform hemisphere. Chosen on the tuning captures, for lights of some extent.
const LAMP: f32 = 0.5;

/// Shading by normal n under one lamp plus ambient light, 1 + s · n + ½ |s| ((ŝ · n)² − ⅓) with
/// slope s, at least 0.2: three bands of spherical harmonics (Ramamoorthi and Hanrahan 2001), the
/// third being determined by the second. Even light by default.
///
/// ```
/// use glam::Vec3;
///
/// let lamp = capture::Light { slope: 0.5 * Vec3::Y };
/// assert!(lamp.on(Vec3::Y) > 1.0 && lamp.on(Vec3::NEG_Y) < 1.0);
/// assert_eq!(capture::Light::default().on(Vec3::Y), 1.0);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Light {
    /// Direction of the lamp in the world times its intensity relative to the mean.
    pub slope: Vec3,
}

impl Light {
    /// Least shading, so that albedo stays observable.
    pub const DARKEST: f32 = 0.2;

    /// Gradient of the shading by the slope at a unit normal, for a lamp in this direction (a unit
    /// vector, or zero for a linear light).
    pub fn along(lamp: Vec3, normal: Vec3) -> Vec3 {
        normal + LAMP * (lamp.dot(normal) * normal - lamp / 3.0)
    }

    /// Shading at a unit normal, relative to the mean over all directions.
    #[must_use]
    pub fn on(&self, normal: Vec3) -> f32 {
        (1.0 + self.slope.dot(Self::along(self.slope.normalize_or_zero(), normal))).max(Self::DARKEST)
    }

    /// Gradient of [`Light::on`] by the normal.
    pub fn change(&self, normal: Vec3) -> Vec3 {
        let toward = self.slope.normalize_or_zero();
        if self.on(normal) > Self::DARKEST { (1.0 + 2.0 * LAMP * toward.dot(normal)) * self.slope } else { Vec3::ZERO }
    }

    /// Shading of each vertex of a surface, (V); empty under even light.
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
