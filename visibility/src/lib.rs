//! Visibility of a triangle mesh: a software rasteriser, watertight ray casts, the vertices that a
//! camera sees, and running counts of how often each was seen.
//!
//! ```
//! use glam::{Affine3A, Vec2, Vec3};
//! use visibility::{RasterOptions, Rasterizer, RayMesh, View, visible_vertices};
//!
//! // A triangle at depth 2 and one behind it.
//! let front = [(-1.0, -1.0, 2.0), (1.0, -1.0, 2.0), (0.0, 1.0, 2.0)];
//! let back = [(0.0, 0.0, 4.0), (3.5, 0.0, 4.0), (0.0, -3.5, 4.0)];
//! let vertices = [front, back].concat().into_iter().map(Vec3::from).collect::<Vec<_>>();
//! let faces = [[0, 1, 2], [3, 4, 5]];
//! let view = View {
//!     focal: Vec2::splat(10.0),
//!     centre: Vec2::splat(10.0),
//!     world_to_camera: Affine3A::IDENTITY,
//!     width: 20,
//!     height: 20,
//! };
//!
//! // The face and depth of the pixel in column 10 and row 10.
//! let options = RasterOptions::default();
//! let fragments = Rasterizer::default().faces(&vertices, &faces, &view, &options)?;
//! assert_eq!(fragments[10 * 20 + 10].map(|f| (f.face, f.depth)), Some((0, 2.0)));
//!
//! let mesh = RayMesh::new(&vertices, &faces)?;
//! assert_eq!(mesh.first_hit(Vec3::ZERO, Vec3::Z).map(|hit| hit.t), Some(2.0));
//! let visible = visible_vertices(&mesh, &vertices, &view, None);
//! assert_eq!(visible, [true, true, true, false, true, true]);
//! # Ok::<(), visibility::Error>(())
//! ```
//!
//! Conventions: cameras are OpenCV (x right, y down, z forward), extrinsics map world to camera,
//! the first pixel's centre is (0.5, 0.5). Lengths are in the units of the vertices. Results do not
//! depend on the number of threads.
#![forbid(unsafe_code)]

mod counts;
mod error;
mod raster;
mod ray_mesh;
mod tree;
mod triangle;
mod view;

/// The README's example as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use counts::VisibilityCounts;
pub use error::Error;
pub use raster::{Fragment, Pixel, RasterOptions, Rasterizer, Samples};
pub use ray_mesh::{Hit, RayMesh};
pub use view::{View, visible_vertices};
