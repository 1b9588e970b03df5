//! A software rasteriser: face, barycentric coordinates and depth of every sample.
//!
//! Vertices are projected, triangles are set up and binned into bands of rows, and each band is one
//! task: a depth test of all its triangles, then the barycentrics of the visible faces.

mod band;
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
///
/// ```
/// use glam::Vec3;
/// use visibility::{RasterOptions, Rasterizer, Samples};
/// # use glam::{Affine3A, Vec2};
/// # use visibility::View;
///
/// # let (centre, world_to_camera) = (Vec2::splat(0.5), Affine3A::IDENTITY);
/// # let view = View { focal: Vec2::ONE, centre, world_to_camera, width: 1, height: 1 };
/// // view: a single pixel. The triangle covers its left half, short of the centre.
/// let vertices = [(-0.1, -9.0, 1.0), (-0.1, 9.0, 1.0), (-9.0, 0.0, 1.0)].map(Vec3::from);
/// let (options, mut covered) = (RasterOptions { samples: Samples::Four, ..Default::default() }, [vec![]]);
/// Rasterizer::default().draw(&vertices, &[[0, 1, 2]], &view, &options, &mut covered, |pixel| {
///     pixel.samples.iter().map(Option::is_some).collect()
/// })?;
/// assert_eq!(covered, [[true, false, true, false]]);
/// # Ok::<(), visibility::Error>(())
/// ```
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
///
/// ```
/// use glam::Vec3;
/// use visibility::{RasterOptions, Rasterizer};
/// # use glam::{Affine3A, Vec2};
/// # use visibility::View;
///
/// # let (centre, world_to_camera) = (Vec2::splat(0.5), Affine3A::IDENTITY);
/// # let view = View { focal: Vec2::ONE, centre, world_to_camera, width: 1, height: 1 };
/// // view: a single pixel, its centre on the z axis. The triangle is slanted.
/// let vertices = [(-2.0, -1.0, 1.0), (2.0, -1.0, 3.0), (0.0, 2.0, 2.0)].map(Vec3::from);
/// let fragments = Rasterizer::default().faces(&vertices, &[[0, 1, 2]], &view, &RasterOptions::default())?;
/// let fragment = fragments[0].unwrap();
/// let point: Vec3 = fragment.barycentric.iter().zip(vertices).map(|(b, vertex)| b * vertex).sum();
/// assert!((fragment.depth - 2.0).abs() < 1e-5 && point.distance(2.0 * Vec3::Z) < 1e-5);
/// # Ok::<(), visibility::Error>(())
/// ```
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
///
/// ```
/// use glam::Vec3;
/// use visibility::{RasterOptions, Rasterizer};
/// # use glam::{Affine3A, Vec2};
/// # use visibility::View;
///
/// # let (focal, world_to_camera) = (Vec2::ONE, Affine3A::IDENTITY);
/// # let view = View { focal, centre: Vec2::X, world_to_camera, width: 2, height: 1 };
/// // view: two pixels. The triangle covers the first, a backdrop shows in the second.
/// let vertices = [(-0.1, -9.0, 1.0), (-0.1, 9.0, 1.0), (-9.0, 0.0, 1.0)].map(Vec3::from);
/// let (options, backdrop, mut image) = (RasterOptions::default(), [0.1, 0.2], [0.0; 2]);
/// Rasterizer::default().draw(&vertices, &[[0, 1, 2]], &view, &options, &mut image, |pixel| {
///     if pixel.samples.is_empty() { backdrop[pixel.index] } else { 1.0 }
/// })?;
/// assert_eq!(image, [1.0, 0.2]);
/// # Ok::<(), visibility::Error>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Pixel<'a> {
    /// Row-major index of the pixel.
    pub index: usize,
    /// The fragment of every sample; no samples for a pixel without fragments.
    pub samples: &'a [Option<Fragment>],
}
