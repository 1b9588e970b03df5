//! Motion fields: from a point in the world to the canonical pose.

mod field;
mod jacobian;
mod prior;
mod surface;
mod volume;
mod volume_backward;

use glam::Vec3;

pub use field::{MotionField, MotionFrame, SurfacePoint};
pub use surface::SurfaceMotion;
pub use volume::{WeightVolume, WeightVolumeConfig};

/// A point of the world in canonical space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// x̂, in the unshifted rest pose.
    pub canonical: Vec3,
    /// f: how likely the point belongs to the body at all, in [0, 1].
    pub likelihood: f32,
}
