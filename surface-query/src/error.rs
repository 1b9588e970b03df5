/// Why a mesh or a configuration is refused.
///
/// ```
/// use surface_query::{Error, MeshDistance};
///
/// let refused = MeshDistance::new(&[glam::Vec3::ZERO], &[[0, 0, 1]]).unwrap_err();
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
    /// A coordinate beyond 10¹⁸, where squared distances approach the range of `f32`; for
    /// [`crate::SurfaceQuery`] alone.
    #[error("vertex {vertex} has a coordinate beyond 1e18")]
    OutOfRange {
        /// Index of the vertex.
        vertex: usize,
    },
    /// [`crate::MeshDistance`] needs at least one face.
    #[error("no faces")]
    NoFaces,
    /// [`crate::SurfaceQuery`] needs at least one vertex.
    #[error("no vertices")]
    NoVertices,
    /// The mesh has more vertices or faces than are supported.
    #[error("{count} elements, at most 2^31 are supported")]
    TooMany {
        /// Number of elements.
        count: usize,
    },
    /// A configuration value out of its range.
    #[error("{name} = {value}, expected {expected}")]
    Config {
        /// The field of the configuration.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The range allowed.
        expected: &'static str,
    },
    /// Too many cells in the candidate grid: the cell is too small for the extent of the vertices.
    #[error("candidate grid of {cells:.3e} cells, at most {limit:.3e}: choose larger cells")]
    GridTooLarge {
        /// Cells of the bounding box.
        cells: f64,
        /// Largest number allowed.
        limit: f64,
    },
    /// The nearest-neighbour tree could not be built.
    #[error("nearest-neighbour tree: {0}")]
    Tree(String),
}

/// Checks what every structure of this crate relies on.
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
