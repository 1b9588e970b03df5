use glam::Vec3;

/// Why a mesh or an image is refused.
///
/// ```
/// let refused = visibility::RayMesh::new(&[glam::Vec3::ZERO], &[[0, 0, 1]]).unwrap_err();
/// assert_eq!(refused.to_string(), "face 0 has vertex index 1, but there are only 1 vertices");
/// ```
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct Error(
    /// The fault: the index of the vertex or face, the size and its limit.
    pub String,
);

impl Error {
    pub(crate) fn face_index(face: usize, vertex: u32, vertices: usize) -> Self {
        Self(format!("face {face} has vertex index {vertex}, but there are only {vertices} vertices"))
    }

    pub(crate) fn too_many(elements: usize) -> Self {
        Self(format!("{elements} elements, at most 2^31 are supported"))
    }
}

pub(crate) fn check_mesh(vertices: &[Vec3], faces: &[[u32; 3]]) -> Result<(), Error> {
    let (count, most) = (vertices.len(), vertices.len().max(faces.len()));
    if most > 1 << 31 {
        return Err(Error::too_many(most));
    }
    if let Some(vertex) = vertices.iter().position(|v| !v.is_finite()) {
        return Err(Error(format!("vertex {vertex} is not finite")));
    }
    for (face, corners) in faces.iter().enumerate() {
        if let Some(&vertex) = corners.iter().find(|&&v| v as usize >= count) {
            return Err(Error::face_index(face, vertex, count));
        }
    }
    Ok(())
}
