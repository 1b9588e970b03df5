/// Errors of meshes.
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
    /// The mesh has more vertices or faces than are supported.
    #[error("{count} elements, at most 2^31 are supported")]
    TooMany {
        /// Their number.
        count: usize,
    },
    /// A picture that is too large to rasterise.
    #[error("a picture of {width} × {height} pixels, at most {most} × {most} can be rasterised")]
    ImageSize {
        /// Pixels a row.
        width: u32,
        /// Rows.
        height: u32,
        /// Most pixels a row or column, with the samples a pixel asked for.
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
