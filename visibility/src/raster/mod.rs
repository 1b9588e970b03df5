//! A software rasteriser: which triangle every pixel sees, where on the triangle, and how far away.
//!
//! Vertices are projected, triangles are set up and sorted into bands of rows, and every band is
//! drawn by one task: first depth and face of every sample, then the barycentrics of the faces that
//! won.

mod band;
mod clip;
mod fragment;
mod options;
mod project;
mod rasterizer;
mod triangle;

pub use fragment::{Fragment, Pixel};
pub use options::{RasterOptions, Samples};
pub use rasterizer::Rasterizer;
