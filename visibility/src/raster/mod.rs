//! A software rasteriser: face, barycentric coordinates and depth of every sample.
//!
//! Vertices are projected, triangles are set up and binned into bands of rows, and each band is one
//! task: a depth test of all its triangles, then the barycentrics of the visible faces.

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
