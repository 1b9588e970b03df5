//! Properties of the crates together.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod common;
mod determinism;
mod fuzz;
mod house;
mod occlusion;
mod scale;
mod surface;
mod training;
