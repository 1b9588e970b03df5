//! Volume rendering on the CPU without the field: pinhole cameras and lens distortion, rays and
//! boxes, occupancy grids, stratified samples, alpha compositing with its backward pass, and image
//! metrics.
//!
//! ```
//! use volrender::{Aabb, Bins, Camera, RaySamples, composite};
//! use glam::{Affine3A, Mat3, Vec3};
//!
//! // 64×64 pixels, looking along +z from two metres before the origin.
//! let intrinsics = Mat3::from_cols_array(&[80.0, 0.0, 0.0, 0.0, 80.0, 0.0, 32.0, 32.0, 1.0]);
//! let camera = Camera::new(intrinsics, Affine3A::from_translation(Vec3::Z * 2.0), 64, 64)?;
//! let ray = camera.ray(10.0 + 0.5, 32.0 + 0.5);
//!
//! let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
//! if let Some((near, far)) = bounds.intersect(&ray) {
//!     let bins = Bins::new(near, far, 16);
//!     let (t, delta): ([f32; 16], _) = (std::array::from_fn(|i| bins.at(i, 0.5)), [bins.width(); 16]);
//!     // A ball of fog.
//!     let sigma = t.map(|t| if ray.at(t).length() < 0.8 { 3.0 } else { 0.0 });
//!     let mut weights = [0.0; 16];
//!     let (likelihood, rgb) = ([1.0; 16], [Vec3::X; 16]);
//!     let samples = RaySamples { sigma: &sigma, likelihood: &likelihood, delta: &delta, t: &t, rgb: &rgb };
//!     let pixel = composite(samples, Vec3::ZERO, &mut weights);
//!     assert!(pixel.opacity > 0.9);
//! }
//! # Ok::<(), volrender::Error>(())
//! ```
//!
//! # Conventions
//!
//! * Cameras are OpenCV: x right, y down, z forward, extrinsics map world to camera. Pixel (column,
//!   row) has its centre at (column + 0.5, row + 0.5).
//! * Ray directions have unit length, so t, δ and depth are lengths in the unit of the world.
//! * α_i = f_i (1 − exp(−σ_i δ_i)), w_i = α_i Π_{j<i} (1 − α_j), C = Σ w_i c_i + (1 − Σ w_i) ·
//!   background.
//! * Images are row-major H × W × 3, values in \[0, 1\].

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
mod simd;

/// The README's examples, compiled as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use camera::{Camera, Error};
pub use composite::{Composite, RaySamples, composite};
pub use composite_backward::{SampleGradients, composite_backward};
pub use distortion::Distortion;
pub use occupancy::{Occupancy, OccupancyConfig};
pub use random::RandomStream;
pub use ray::{Aabb, Ray};
pub use sampling::{Bins, patch};
