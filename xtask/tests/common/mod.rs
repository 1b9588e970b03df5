//! What the tests of the command line share.

use std::path::{Path, PathBuf};
use std::process::Output;

/// Fails unless the program ended with one line on standard error that names every one of `words`, and without a panic.
pub fn refused(output: &Output, what: &str, words: &[&str]) {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success(), "{what} succeeded");
    assert_eq!(text.trim_end().lines().count(), 1, "{what}: {text}");
    assert!(text.starts_with("error: ") && !text.contains("panicked"), "{what}: {text}");
    for word in words {
        assert!(text.contains(word), "{what} should name {word}: {text}");
    }
}

/// An empty folder of a test's own.
pub fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}
