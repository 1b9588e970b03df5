//! The field in canonical space, as baking samples it.

use glam::Vec3;

/// A point near the canonical prior.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    /// Canonical, normalised metres.
    pub at: Vec3,
    /// The closest point of the prior, the face it is on, and its weights of that face's corners.
    pub closest: Vec3,
    pub face: u32,
    pub barycentric: [f32; 3],
    /// Signed distance from there, positive outside.
    pub distance: f32,
}

/// A trained person in the canonical space.
pub(super) trait CanonicalField: Sync {
    /// Density, in 1 / normalised metre and 0 outside the extent, and colour at each of `places`;
    /// overwrites `out`.
    fn evaluate(&self, places: &[Place], out: &mut Vec<(f32, Vec3)>);

    /// Path length of a ray that grazes the surface, as on the outline, normalised metres.
    fn grazing(&self) -> f32;

    /// Largest distance of the extent from the prior.
    fn reach(&self) -> f32;
}
