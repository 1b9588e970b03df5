//! Queries about a triangle mesh from points around it: nearest vertices at several scales, a normal-weighted blend
//! of them with a signed distance, and the exact closest point with the exact sign.
//!
//! ```
//! use glam::Vec3;
//! use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
//!
//! // A tetrahedron, counter-clockwise seen from outside.
//! let vertices = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
//! let faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
//! let x = Vec3::new(0.2, 0.2, -0.3);
//!
//! let surface = SurfaceQuery::new(&vertices, &faces, &SurfaceQueryConfig::TREES)?;
//! let mut neighbours = vec![0; surface.neighbours_per_query()];
//! surface.neighbours(x, &mut neighbours);
//! assert_eq!(neighbours[..3], [0, 1, 2]);
//! let blended = surface.blend(x, &neighbours[..5]);
//! assert!(blended.signed_distance > 0.0);
//!
//! let mesh = MeshDistance::new(&vertices, &faces)?;
//! let closest = mesh.closest(x, f32::INFINITY).unwrap();
//! assert_eq!(closest.point, Vec3::new(0.2, 0.2, 0.0));
//! assert_eq!(closest.signed_distance, 0.3);
//! # Ok::<(), surface_query::Error>(())
//! ```
//!
//! Conventions: lengths are in the units of the vertices; faces are wound counter-clockwise seen from outside;
//! distances are positive outside. Ties between equally near vertices go to the lower index. Nothing depends on the
//! number of threads.
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
mod search;
mod tree;
mod triangle;

pub use blend::Blended;
pub use distance::{Closest, MeshDistance};
pub use error::Error;
pub use normals::vertex_normals;
pub use pyramid::{Pyramid, farthest_points};
pub use query::{SurfaceQuery, SurfaceQueryConfig};
