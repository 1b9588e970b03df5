//! Queries about a triangle mesh from points around it: nearest vertices at several scales, a
//! normal-weighted blend of them with a signed distance, and the exact closest point with the exact
//! sign.
//!
//! ```
//! use glam::Vec3;
//! use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
//!
//! // An octahedron, counter-clockwise seen from outside.
//! let vertices = [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z];
//! let faces = [
//!     [0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2],
//!     [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5],
//! ];
//! let x = Vec3::splat(0.5);
//!
//! // A mesh of six vertices takes a small neighbourhood.
//! let config = SurfaceQueryConfig { k: 3, coarse_levels: 0, ..SurfaceQueryConfig::TREES };
//! let surface = SurfaceQuery::new(&vertices, &faces, &config)?;
//! let mut neighbours = vec![0; surface.neighbours_per_query()];
//! surface.neighbours(x, &mut neighbours);
//! assert_eq!(neighbours, [0, 1, 2]);
//! let blended = surface.blend(x, &neighbours);
//! assert!((blended.signed_distance - 0.75f32.sqrt() + 1.0 / 3f32.sqrt()).abs() < 1e-6);
//!
//! let mesh = MeshDistance::new(&vertices, &faces)?;
//! let closest = mesh.closest(x, f32::INFINITY).unwrap();
//! assert!(closest.face == 0 && closest.point.distance(Vec3::splat(1.0 / 3.0)) < 1e-6);
//! assert!((closest.signed_distance - blended.signed_distance).abs() < 1e-6);
//! # Ok::<(), surface_query::Error>(())
//! ```
//!
//! Conventions: lengths are in the units of the vertices; faces are wound counter-clockwise seen
//! from outside; distances are positive outside. Ties between equally near vertices go to the lower
//! index. Nothing depends on the number of threads.
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

/// The README's examples, compiled as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use blend::Blended;
pub use distance::{Closest, MeshDistance};
pub use error::Error;
pub use normals::vertex_normals;
pub use pyramid::{Pyramid, farthest_points};
pub use query::{SurfaceQuery, SurfaceQueryConfig};
