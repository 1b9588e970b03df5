//! Results of the rasteriser.

/// The visible point of a sample, of one layer.
///
/// ```
/// use glam::{Affine3A, Vec2, Vec3};
/// use visibility::{RasterOptions, Rasterizer, View};
///
/// let vertices = [(-1.0, -1.0, 2.0), (1.0, -1.0, 2.0), (0.0, 1.0, 2.0)].map(Vec3::from);
/// let (focal, centre) = (Vec2::splat(10.0), Vec2::splat(1.5));
/// let view = View { focal, centre, world_to_camera: Affine3A::IDENTITY, width: 3, height: 3 };
/// let options = RasterOptions::default();
/// let fragments = Rasterizer::default().faces(&vertices, &[[0, 1, 2]], &view, &options)?;
/// // Pixel (1, 1) is at the principal point.
/// let fragment = fragments[4].unwrap();
/// assert_eq!((fragment.face, fragment.depth, fragment.barycentric), (0, 2.0, [0.25, 0.25, 0.5]));
/// # Ok::<(), visibility::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fragment {
    /// Index of the face, counted through all layers.
    pub face: u32,
    /// Depth: the z coordinate in the camera frame.
    pub depth: f32,
    /// Perspective-correct barycentric coordinates: non-negative, sum 1.
    pub barycentric: [f32; 3],
}

/// The samples of a pixel, as [`crate::Rasterizer::draw`] passes them to the shader.
///
/// ```
/// use visibility::Pixel;
///
/// /// Share of the pixel that the mesh covers.
/// fn coverage(pixel: Pixel<'_>) -> f32 {
///     let count = pixel.samples().len().max(1);
///     pixel.samples().filter(|sample| !sample.is_empty()).count() as f32 / count as f32
/// }
/// # let _ = coverage;
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Pixel<'a> {
    /// Row-major index of the pixel.
    pub index: usize,
    pub(super) fragments: &'a [Fragment],
    /// Number of fragments of every sample; empty if all samples are.
    pub(super) counts: &'a [usize],
    pub(super) layers: usize,
}

impl Pixel<'_> {
    /// The fragments of every sample, nearest first, at most one a layer. No samples at all for a
    /// pixel without fragments.
    #[inline]
    pub fn samples(&self) -> impl ExactSizeIterator<Item = &[Fragment]> {
        self.counts.iter().zip(self.fragments.chunks_exact(self.layers.max(1))).map(|(&n, sample)| &sample[..n])
    }
}
