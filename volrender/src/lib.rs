#![doc = include_str!("../README.md")]

mod camera;
mod composite;
mod composite_backward;
mod distortion;
mod exponential;
pub mod metrics;
mod occupancy;
mod random;
mod ray;
mod sampling;

pub use camera::{Camera, Error};
pub use composite::{Composite, RaySamples, composite};
pub use composite_backward::{SampleGradients, composite_backward};
pub use distortion::Distortion;
pub use occupancy::{Occupancy, OccupancyConfig};
pub use random::RandomStream;
pub use ray::{Aabb, Ray};
pub use sampling::{Bins, patch};
