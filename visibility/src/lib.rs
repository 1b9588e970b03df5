//! Which vertices of a mesh were seen, and how often.
#![forbid(unsafe_code)]

mod counts;
mod error;
mod ray_mesh;
mod tree;
mod triangle;
mod view;

pub use counts::VisibilityCounts;
pub use error::Error;
pub use ray_mesh::{Hit, RayMesh};
pub use view::{View, visible_vertices};
