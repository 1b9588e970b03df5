use glam::{DVec3, Vec3};

/// Unit normal of each vertex, (V): the normals of its faces weighted by the angle the face spans
/// at the vertex (Thürmer and Wüthrich 1998; Bærentzen and Aanæs 2005). Faces are wound
/// counter-clockwise seen from outside.
///
/// The fallback is +Y: for a vertex without faces, or with faces whose normals cancel or have no
/// area. Duplicated vertices along a seam get the normals of their own side.
///
/// ```
/// use glam::Vec3;
///
/// let normals = surface_query::vertex_normals(&[Vec3::ZERO, Vec3::X, Vec3::Y], &[[0, 1, 2]]);
/// assert_eq!(normals, [Vec3::Z; 3]);
/// ```
///
/// # Panics
/// If a face has an index outside `vertices`.
pub fn vertex_normals(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Vec3> {
    let mut sums = vec![DVec3::ZERO; vertices.len()];
    for (i, face) in faces.iter().enumerate() {
        assert!(
            face.iter().all(|&v| (v as usize) < vertices.len()),
            "vertex_normals: face {i} is {face:?} but there are {} vertices",
            vertices.len()
        );
        let corners = face.map(|v| vertices[v as usize].as_dvec3());
        let normal = face_normal(corners);
        for (corner, angle) in corner_angles(corners).into_iter().enumerate() {
            sums[face[corner] as usize] += normal * angle;
        }
    }
    sums.into_iter().map(|sum| sum.normalize_or(DVec3::Y).as_vec3()).collect()
}

/// Unit normal of a triangle, zero where it has no area. Finite for any finite `f32` corners.
#[inline]
pub(crate) fn face_normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a).normalize_or_zero()
}

/// Interior angles at the three corners, radians; 0 at a corner whose edges have no length.
#[inline]
pub(crate) fn corner_angles([a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let angle = |u: DVec3, v: DVec3| u.cross(v).length().atan2(u.dot(v));
    let (ab, bc, ca) = (b - a, c - b, a - c);
    [angle(ab, -ca), angle(bc, -ab), angle(ca, -bc)]
}
