//! Which vertices of a mesh were seen, and how often: ray casts against a mesh, the vertices a
//! camera sees, a rasteriser that says which triangle every pixel sees, running counts, and the
//! attention weights made of them.
//!
//! ```
//! use glam::{Affine3A, Mat3, Vec3};
//! use visibility::{RasterOptions, Rasterizer, RayMesh, View, VisibilityCounts, visible_vertices};
//!
//! // A triangle at depth 2 and one behind it.
//! let front = [Vec3::new(-1.0, -1.0, 2.0), Vec3::new(1.0, -1.0, 2.0), Vec3::new(0.0, 1.0, 2.0)];
//! let back = [Vec3::new(0.0, 0.0, 4.0), Vec3::new(3.5, 0.0, 4.0), Vec3::new(0.0, -3.5, 4.0)];
//! let vertices = [front, back].concat();
//! let mesh = RayMesh::new(&vertices, &[[0, 1, 2], [3, 4, 5]])?;
//! assert_eq!(mesh.first_hit(Vec3::ZERO, Vec3::Z).unwrap().t, 2.0);
//!
//! let view = View {
//!     intrinsics: Mat3::from_cols(Vec3::X * 10.0, Vec3::Y * 10.0, Vec3::new(10.0, 10.0, 1.0)),
//!     extrinsics: Affine3A::IDENTITY,
//!     width: 20,
//!     height: 20,
//! };
//! let seen = visible_vertices(&mesh, &vertices, &view, None);
//! assert_eq!(seen, [true, true, true, false, true, true]);
//!
//! let fragments = Rasterizer::default().faces(&vertices, &[[0, 1, 2], [3, 4, 5]], &view, &RasterOptions::default())?;
//! assert_eq!(fragments[10 * 20 + 10].map(|f| (f.face, f.depth)), Some((0, 2.0)));
//!
//! let mut counts = VisibilityCounts::new(vertices.len());
//! counts.add_visible(&seen);
//! let mut attention = [0.0; 2];
//! counts.attention(&[0, 3], &mut attention);
//! assert_eq!(attention, [2.0 / 3.0, 1.0 / 3.0]);
//! # Ok::<(), visibility::Error>(())
//! ```
//!
//! Conventions: cameras are OpenCV (x right, y down, z forward), extrinsics map world to camera,
//! the first pixel's centre is (0.5, 0.5). Lengths are in the units of the vertices. Nothing
//! depends on the number of threads.
#![forbid(unsafe_code)]

mod counts;
mod error;
mod raster;
mod ray_mesh;
mod tree;
mod triangle;
mod view;

/// The README's examples, compiled as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use counts::VisibilityCounts;
pub use error::Error;
pub use raster::{Fragment, Pixel, RasterOptions, Rasterizer, Samples};
pub use ray_mesh::{Hit, RayMesh};
pub use view::{View, visible_vertices};
