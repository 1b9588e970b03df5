//! LPIPS against golden values and gradients, and against damaged files.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod files;
mod formula;
mod golden;

use std::path::PathBuf;

/// A file of the shared data, or `None` with a message where it is absent.
fn shared(name: &str) -> Option<PathBuf> {
    testkit::files::shared(&format!("lpips/{name}"))
}

/// Noise in [0, 1], a function of its seed.
fn noise(count: usize, seed: u64) -> Vec<f32> {
    (0..count as u64).map(|i| formula::uniform(seed << 40 | i) * 0.5 + 0.5).collect()
}
