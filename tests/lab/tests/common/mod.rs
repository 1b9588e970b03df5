//! What the tests of the command line share; each uses a part of it.
#![allow(dead_code, reason = "each test uses a part")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Runs the program.
pub fn lab(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lab")).args(arguments).env_remove("SMPL_MODEL").output().unwrap()
}

/// Runs the program, which must succeed; returns what it prints.
pub fn done(arguments: &[&str]) -> String {
    let output = lab(arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// Runs the program, which must refuse its arguments as [`refusal`] says.
pub fn refused(arguments: &[&str], words: &[&str]) {
    refusal(&lab(arguments), &format!("{arguments:?}"), words);
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Fails unless the program ended with one line on standard error that names every one of `words`,
/// and without a panic.
pub fn refusal(output: &Output, what: &str, words: &[&str]) {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success(), "{what} succeeded");
    assert_eq!(text.trim_end().lines().count(), 1, "{what}: {text}");
    assert!(text.starts_with("error: ") && !text.contains("panicked"), "{what}: {text}");
    for word in words {
        assert!(text.contains(word), "{what} should name {word}: {text}");
    }
}

/// Options of `synth` for a capture that is made in no time.
pub const TINY: [&str; 6] = ["--size", "32", "--frames", "4", "--eval-cameras", "1"];

/// An empty folder of a test's own.
pub fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}
