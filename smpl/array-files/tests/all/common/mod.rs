//! Places of test data.

use std::path::{Path, PathBuf};

/// A file committed beside the tests, written by `fixtures/make_pickles.py` or `make_joblib.py`.
pub fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}
