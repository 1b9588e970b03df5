//! How triangles are drawn.

/// Settings of a [`Rasterizer`](super::Rasterizer).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Samples of a pixel.
    pub samples: Samples,
    /// Leaves out triangles that the camera sees clockwise: the inside of closed meshes.
    pub cull_back: bool,
    /// Nothing closer than this depth is drawn, in the units of the vertices; above 0.
    pub near: f32,
}

impl Default for RasterOptions {
    /// One sample a pixel, both sides, everything farther than 10⁻⁴ units.
    fn default() -> Self {
        Self { samples: Samples::One, cull_back: false, near: 1e-4 }
    }
}

/// Samples of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Samples {
    /// One at its centre.
    One,
    /// One at the centre of each of its four quarters, row by row.
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
