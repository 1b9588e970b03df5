#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod blend;
mod distance;
mod error;
mod grid;
mod knn;
mod normals;
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
