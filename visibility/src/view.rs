use glam::{Affine3A, DVec3, Mat3, Vec3};
use rayon::prelude::*;

use crate::RayMesh;

/// Share of a vertex's distance by which something must be closer to hide it. Far above the
/// rounding of the intersection (1e-6) and below any gap that matters (0.03 mm at 3 m).
const MARGIN: f32 = 1e-5;

/// A pinhole camera of the OpenCV convention: x right, y down, z forward; the centre of the first
/// pixel is at (0.5, 0.5).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Pixels from normalised camera coordinates.
    pub intrinsics: Mat3,
    /// Camera from world.
    pub extrinsics: Affine3A,
    /// Pixels a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl View {
    /// The centre of projection in the world; `None` if the extrinsics have no inverse.
    #[must_use]
    pub fn centre(&self) -> Option<Vec3> {
        let rotation = Mat3::from(self.extrinsics.matrix3).as_dmat3();
        let determinant = rotation.determinant();
        if determinant == 0.0 || !determinant.is_finite() {
            return None;
        }
        let translation: DVec3 = Vec3::from(self.extrinsics.translation).as_dvec3();
        let centre = (rotation.inverse() * -translation).as_vec3();
        centre.is_finite().then_some(centre)
    }

    /// Row-major index of the pixel that a point of the world falls into; `None` behind the camera,
    /// outside the image, or for a point that is not finite.
    #[must_use]
    pub fn pixel(&self, point: Vec3) -> Option<usize> {
        let p = self.extrinsics.transform_point3(point);
        let projected = self.intrinsics * p;
        let (u, v) = (projected.x / projected.z, projected.y / projected.z);
        // False for NaN.
        let inside = p.z > 0.0 && u >= 0.0 && v >= 0.0 && u < self.width as f32 && v < self.height as f32;
        inside.then(|| v as usize * self.width as usize + u as usize)
    }
}

/// Marks those of `vertices` (V) that the view sees: those in front of the camera that fall into a
/// pixel of the image, and into one that is `usable` (H·W row-major, `true` = nothing but the mesh
/// is in front; `None`: all are), to which nothing of `mesh` blocks the way from the camera.
///
/// The vertices are usually those of the mesh, in its order. Such a vertex is not hidden by its own
/// faces, however obliquely they are seen; other points are, unless they lie within a relative 1e-5
/// of the surface. Nothing is visible where the extrinsics have no inverse.
///
/// # Panics
/// If `usable` has not `width · height` entries.
#[must_use]
pub fn visible_vertices(mesh: &RayMesh, vertices: &[Vec3], view: &View, usable: Option<&[bool]>) -> Vec<bool> {
    let pixels = view.width as usize * view.height as usize;
    if let Some(usable) = usable {
        assert_eq!(
            usable.len(),
            pixels,
            "visible_vertices: {} usable flags for {} × {} pixels",
            usable.len(),
            view.width,
            view.height
        );
    }
    let Some(centre) = view.centre() else {
        return vec![false; vertices.len()];
    };
    vertices
        .par_iter()
        .enumerate()
        .with_min_len(256)
        .map(|(i, &v)| {
            let Some(pixel) = view.pixel(v) else {
                return false;
            };
            if usable.is_some_and(|usable| !usable[pixel]) {
                return false;
            }
            let own = mesh.is_vertex(i, v);
            let counts = |face: &[u32; 3]| !(own && face.contains(&(i as u32)));
            !mesh.is_blocked_by(centre, v - centre, 1.0 - MARGIN, counts)
        })
        .collect()
}
