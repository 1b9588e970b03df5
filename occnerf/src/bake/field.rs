//! What a bake asks of a trained person: density and colour at points of the canonical space.

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
    /// From there, positive outside.
    pub distance: f32,
}

/// A trained person in the canonical space.
pub(super) trait CanonicalField: Sync {
    /// Density, in 1 / normalised metre and 0 where nothing can be, and colour at each of `places`;
    /// overwrites `out`.
    fn evaluate(&self, places: &[Place], out: &mut Vec<(f32, Vec3)>);

    /// From one sample of a picture's ray to the next, normalised metres.
    fn spacing(&self) -> f32;

    /// Length of ray that the greatest density outside a point stands for, normalised metres: a ray
    /// that grazes the surface, as those do that draw the outline, stays about as long in it.
    fn grazing(&self) -> f32;

    /// How far from the prior there can be anything.
    fn reach(&self) -> f32;
}
