//! Compositing, metrics and occupancy against references.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod composite;
mod geometry;
mod metrics;
mod occupancy;
