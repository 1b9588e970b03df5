/// Why a mesh or an image is refused.
///
/// ```
/// use visibility::{Error, RayMesh};
///
/// let refused = RayMesh::new(&[glam::Vec3::ZERO], &[[0, 0, 1]]).unwrap_err();
/// assert_eq!(refused, Error::FaceIndex { face: 0, vertex: 1, vertices: 1 });
/// assert_eq!(refused.to_string(), "face 0 has vertex index 1, but there are only 1 vertices");
/// ```
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A face has an index outside the vertices.
    #[error("face {face} has vertex index {vertex}, but there are only {vertices} vertices")]
    FaceIndex {
        /// Index of the face.
        face: usize,
        /// The vertex index out of range.
        vertex: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A vertex has a NaN or infinite coordinate.
    #[error("vertex {vertex} is not finite")]
    NotFinite {
        /// Index of the vertex.
        vertex: usize,
    },
    /// The mesh has more vertices or faces than are supported.
    #[error("{count} elements, at most 2^31 are supported")]
    TooMany {
        /// Number of elements.
        count: usize,
    },
    /// An image too large to rasterise.
    #[error("an image of {width} × {height} pixels, at most {most} × {most} are supported")]
    ImageSize {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Largest width and height at this number of samples a pixel.
        most: u32,
    },
}

pub(crate) fn check_mesh(vertices: &[glam::Vec3], faces: &[[u32; 3]]) -> Result<(), Error> {
    let limit = 1 << 31;
    for count in [vertices.len(), faces.len()] {
        if count > limit {
            return Err(Error::TooMany { count });
        }
    }
    if let Some(vertex) = vertices.iter().position(|v| !v.is_finite()) {
        return Err(Error::NotFinite { vertex });
    }
    for (face, corners) in faces.iter().enumerate() {
        for &vertex in corners {
            if vertex as usize >= vertices.len() {
                return Err(Error::FaceIndex { face, vertex, vertices: vertices.len() });
            }
        }
    }
    Ok(())
}
