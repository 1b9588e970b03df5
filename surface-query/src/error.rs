/// Errors of meshes and configurations.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A face names a vertex that does not exist.
    #[error("face {face} names vertex {vertex}, but there are only {vertices} vertices")]
    FaceIndex {
        /// The face.
        face: usize,
        /// The vertex it names.
        vertex: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A vertex has a NaN or infinite coordinate.
    #[error("vertex {vertex} is not finite")]
    NotFinite {
        /// The vertex.
        vertex: usize,
    },
    /// A nearest-vertex structure needs at least one vertex.
    #[error("no vertices")]
    NoVertices,
    /// The mesh has more vertices or faces than are supported.
    #[error("{count} elements, at most 2^31 are supported")]
    TooMany {
        /// Their number.
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
    /// The candidate grid would need too many cells: the cell is too small for the extent of the
    /// vertices.
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
