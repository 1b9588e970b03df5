#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod counts;
mod error;
mod raster;
mod ray_mesh;
mod triangle;
mod view;

pub use counts::VisibilityCounts;
pub use error::Error;
pub use raster::{Fragment, Pixel, RasterOptions, Rasterizer, Samples};
pub use ray_mesh::{Hit, RayMesh};
pub use view::{View, visible_vertices};
