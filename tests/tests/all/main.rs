//! Properties of the crates together.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

#[path = "common/capture_on_disk.rs"]
mod capture_on_disk;
mod common;
mod determinism;
mod fuzz;
mod house;
mod motion;
mod occlusion;
mod scale;
mod surface;
mod training;
