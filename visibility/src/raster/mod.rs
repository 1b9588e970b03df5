//! A software rasteriser: face, barycentric coordinates and depth of every sample.
//!
//! Vertices are projected, triangles are set up and binned into bands of rows, and each band is one
//! task: a depth test of all its triangles, then the barycentrics of the visible faces.

mod band;
mod clip;
mod project;
mod rasterizer;
mod triangle;

pub use rasterizer::Rasterizer;

/// Settings of the rasteriser.
///
/// ```
/// use visibility::{RasterOptions, Samples};
///
/// // A closed mesh in millimetres, antialiased.
/// let options = RasterOptions { samples: Samples::Four, cull_back: true, near: 1.0 };
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
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Samples {
    /// At its centre.
    One,
    /// At the centres of its four quarters, row by row.
    Four,
}

impl Samples {
    fn per_side(self) -> u32 {
        match self {
            Self::One => 1,
            Self::Four => 2,
        }
    }
}

/// The visible point of a sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fragment {
    /// Index of the face.
    pub face: u32,
    /// Depth: the z coordinate in the camera frame.
    pub depth: f32,
    /// Perspective-correct barycentric coordinates: non-negative, sum 1.
    pub barycentric: [f32; 3],
}

/// The samples of a pixel, as [`crate::Rasterizer::draw`] passes them to the shader.
#[derive(Clone, Copy, Debug)]
pub struct Pixel<'a> {
    /// Row-major index of the pixel.
    pub index: usize,
    /// The fragment of every sample; no samples for a pixel without fragments.
    pub samples: &'a [Option<Fragment>],
}
