//! Settings of the rasteriser.

/// Settings of the rasteriser.
///
/// ```
/// use visibility::{RasterOptions, Samples};
///
/// // A closed mesh in millimetres, antialiased.
/// let options = RasterOptions { samples: Samples::Four, cull_back: true, near: 1.0 };
/// # let _ = options;
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Samples a pixel.
    pub samples: Samples,
    /// Culls triangles that are clockwise in the image: the inside of closed meshes.
    pub cull_back: bool,
    /// Depth of the near plane, in the units of the vertices; above 0.
    pub near: f32,
}

impl Default for RasterOptions {
    /// One sample a pixel, no culling, near plane at 10⁻⁴ units.
    fn default() -> Self {
        Self { samples: Samples::One, cull_back: false, near: 1e-4 }
    }
}

/// Samples of a pixel.
///
/// ```
/// use visibility::Samples;
///
/// let samples = if cfg!(debug_assertions) { Samples::One } else { Samples::Four };
/// # let _ = samples;
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Samples {
    /// At its centre.
    One,
    /// At the centres of its four quarters, row by row.
    Four,
}

impl Samples {
    pub(super) fn per_side(self) -> u32 {
        match self {
            Self::One => 1,
            Self::Four => 2,
        }
    }
}
