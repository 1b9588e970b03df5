//! Queries on a triangle mesh: the exact closest point with the exact sign, and the exact nearest
//! vertices at several scales with a normal-weighted blend of them.
//!
//! [`MeshDistance`] is the signed distance, on a mesh that may deform:
//!
//! ```
//! use glam::Vec3;
//! use surface_query::MeshDistance;
//!
//! // An octahedron, counter-clockwise seen from outside.
//! let vertices = [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z];
//! let faces = [
//!     [0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2],
//!     [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5],
//! ];
//! let mesh = MeshDistance::new(&vertices, &faces)?;
//! let closest = mesh.closest(Vec3::splat(0.5));
//! assert!(closest.face == 0 && closest.point.distance(Vec3::splat(1.0 / 3.0)) < 1e-6);
//! assert!(closest.signed_distance > 0.0 && mesh.closest(Vec3::ZERO).signed_distance < 0.0);
//! # Ok::<(), surface_query::Error>(())
//! ```
//!
//! [`SurfaceQuery`] finds the nearest vertices, [`farthest_points`] and [`Pyramid`] sample point
//! sets, [`vertex_normals`] weighs the normals of faces by angle.
//!
//! Conventions: lengths are in the units of the vertices; faces are wound counter-clockwise seen
//! from outside; distances are positive outside. Ties between equally near vertices go to the lower
//! index. Results do not depend on the number of threads.
#![forbid(unsafe_code)]

mod blend;
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

/// The README's example as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use blend::Blended;
pub use distance::{Closest, MeshDistance};
pub use error::Error;
pub use normals::vertex_normals;
pub use pyramid::{Pyramid, farthest_points};
pub use query::{SurfaceQuery, SurfaceQueryConfig};
