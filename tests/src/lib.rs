//! Test kit of the workspace: meshes, proptest strategies, a finite-difference gradient checker
//! and brute-force oracles.
//!
//! Everything here is written to be obviously right rather than fast. The oracles take slices and
//! glam values only, compute in `f64`, and share no code with the crates they check.
//!
//! ```
//! use testkit::{gradient::{assert_gradient, Tolerance}, mesh, oracle};
//! use testkit::glam::Vec3;
//!
//! let ball = mesh::icosphere(2);
//! assert!(oracle::inside(&ball.vertices, &ball.faces, Vec3::ZERO));
//!
//! // d(x²)/dx = 2x
//! assert_gradient("square", &[3.0], &[6.0], 1e-2, Tolerance::default(), |x| f64::from(x[0]).powi(2));
//! ```
//!
//! Conventions: closed meshes are wound counter-clockwise seen from outside; ties between equally
//! good answers go to the lower index.

pub mod body;
pub mod files;
pub mod gradient;
pub mod mesh;
pub mod oracle;
pub mod program;
pub mod strategy;

pub use glam;
pub use mesh::TriMesh;
