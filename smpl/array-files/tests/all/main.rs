//! Readers against written files, damage and limits.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod arrays;
mod pickles;
mod torch;

use std::path::{Path, PathBuf};

/// A file committed beside the tests, written by `fixtures/make_pickles.py` or `make_joblib.py`.
fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}
