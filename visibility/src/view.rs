use glam::{Affine3A, DVec3, Mat3, Vec2, Vec3};
use rayon::prelude::*;

use crate::RayMesh;

/// Relative margin by which an occluder must be closer than a vertex: far above the rounding of the
/// intersection (10⁻⁶), far below a gap that matters (0.03 mm at 3 m).
const MARGIN: f32 = 1e-5;

/// A pinhole camera of the OpenCV convention: x right, y down, z forward; the centre of the first
/// pixel is at (0.5, 0.5).
///
/// ```
/// use glam::{Affine3A, Vec2, Vec3};
/// use visibility::View;
///
/// let view = View {
///     focal: Vec2::splat(100.0),
///     centre: Vec2::new(32.0, 24.0),
///     world_to_camera: Affine3A::from_translation(Vec3::Z * 2.0),
///     width: 64,
///     height: 48,
/// };
/// assert_eq!(view.centre_of_projection(), Some(-2.0 * Vec3::Z));
/// assert_eq!(view.pixel(Vec3::ZERO), Some(24 * 64 + 32));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Focal lengths in pixels.
    pub focal: Vec2,
    /// Principal point in pixels; (0, 0) is the outer corner of the first pixel.
    pub centre: Vec2,
    /// Extrinsics.
    pub world_to_camera: Affine3A,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

impl View {
    /// Position of the camera in the world; `None` if the extrinsics are singular.
    pub fn centre_of_projection(&self) -> Option<Vec3> {
        let rotation = Mat3::from(self.world_to_camera.matrix3).as_dmat3();
        let determinant = rotation.determinant();
        if determinant == 0.0 || !determinant.is_finite() {
            return None;
        }
        let translation: DVec3 = Vec3::from(self.world_to_camera.translation).as_dvec3();
        let centre = (rotation.inverse() * -translation).as_vec3();
        centre.is_finite().then_some(centre)
    }

    /// Row-major index of the pixel that holds the projection of `point`; `None` behind the camera,
    /// outside the image, or for a point that is not finite.
    pub fn pixel(&self, point: Vec3) -> Option<usize> {
        let p = self.world_to_camera.transform_point3(point);
        let projected = self.intrinsics() * p;
        let (u, v) = (projected.x / projected.z, projected.y / projected.z);
        // False for NaN.
        let inside = p.z > 0.0 && u >= 0.0 && v >= 0.0 && u < self.width as f32 && v < self.height as f32;
        inside.then(|| v as usize * self.width as usize + u as usize)
    }

    /// The calibration matrix.
    pub(crate) fn intrinsics(&self) -> Mat3 {
        Mat3::from_cols(Vec3::X * self.focal.x, Vec3::Y * self.focal.y, self.centre.extend(1.0))
    }
}

/// Marks those of `vertices` (V) that the view sees: in front of the camera, inside the image at a
/// pixel that is `usable` (H·W row-major; `None`: all), and not occluded by `mesh`.
///
/// `vertices` are usually those of the mesh, in its order: a vertex is not occluded by its own
/// faces. Other points are visible only within a relative 10⁻⁵ of the surface or in front of it.
/// Without a centre of projection nothing is visible.
///
/// # Panics
/// If `usable` does not have `width · height` entries.
pub fn visible_vertices(mesh: &RayMesh, vertices: &[Vec3], view: &View, usable: Option<&[bool]>) -> Vec<bool> {
    let View { width, height, .. } = *view;
    let pixels = width as usize * height as usize;
    let flags = usable.map_or(pixels, <[bool]>::len);
    assert_eq!(flags, pixels, "visible_vertices: {flags} usable flags for {width} × {height} pixels");
    let Some(centre) = view.centre_of_projection() else {
        return vec![false; vertices.len()];
    };
    vertices
        .par_iter()
        .enumerate()
        .with_min_len(256)
        .map(|(i, &v)| {
            if view.pixel(v).is_none_or(|pixel| usable.is_some_and(|usable| !usable[pixel])) {
                return false;
            }
            let own = mesh.is_vertex(i, v);
            let counts = |face: &[u32; 3]| !(own && face.contains(&(i as u32)));
            !mesh.is_occluded_by(centre, v - centre, 1.0 - MARGIN, counts)
        })
        .collect()
}
