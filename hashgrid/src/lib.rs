#![doc = include_str!("../README.md")]

mod backward;
mod backward_points;
mod config;
mod corners;
mod encode;
mod grid;
mod layout;
mod simd;

pub use config::{Error, HashGridConfig, MAX_RESOLUTION};
pub use grid::HashGrid;
pub use layout::Layout;
