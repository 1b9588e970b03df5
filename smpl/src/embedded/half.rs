//! Half a body, and both halves of one.

use glam::Vec3;

/// Triangles over the points of half a body, x ≥ 0.
pub(super) struct Half {
    pub(super) vertices: Vec<Vec3>,
    pub(super) faces: Vec<[u32; 3]>,
}

/// Builds both halves of a body from the one with x ≥ 0. Vertices with x = 0 are shared.
pub(super) fn mirror(half: &Half) -> (Vec<Vec3>, Vec<[u32; 3]>) {
    let mut vertices = half.vertices.clone();
    let mut twin: Vec<u32> = Vec::with_capacity(vertices.len());
    for (i, v) in half.vertices.iter().enumerate() {
        if v.x == 0.0 {
            twin.push(i as u32);
        } else {
            twin.push(vertices.len() as u32);
            vertices.push(Vec3::new(-v.x, v.y, v.z));
        }
    }
    let mut faces = half.faces.clone();
    faces.extend((half.faces.iter()).map(|&[a, b, c]| [a, c, b].map(|i| twin[i as usize])));
    (vertices, faces)
}
