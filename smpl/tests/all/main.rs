//! The crate against oracles, files and golden values.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod bodies;
mod body;
mod bvh;
mod clip;
mod volume;
