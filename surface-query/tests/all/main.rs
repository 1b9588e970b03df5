//! Queries against brute force.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod blend;
mod distance;
mod neighbours;
mod sampling;
