//! Rays, views and pictures against brute force.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod counts;
mod raster;
mod rays;
mod views;
