//! Queries about a triangle mesh.
#![forbid(unsafe_code)]

mod blend;
mod blend_backward;
mod distance;
mod error;
mod grid;
mod knn;
mod normals;
mod pseudonormal;
mod pyramid;
mod query;
mod tree;
mod triangle;

pub use blend::Blended;
pub use distance::{Closest, MeshDistance};
pub use error::Error;
pub use normals::vertex_normals;
pub use pyramid::{Pyramid, farthest_points};
pub use query::{SurfaceQuery, SurfaceQueryConfig};
