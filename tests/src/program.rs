//! The programs of the workspace as users call them, for tests of their command lines.

use std::path::{Path, PathBuf};
use std::process::Output;

/// A path as an argument.
///
/// # Panics
/// Where it is not UTF-8.
#[must_use]
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap_or_else(|| panic!("{}: not UTF-8", path.display()))
}

/// The standard output of a program that must have succeeded.
///
/// # Panics
/// With its standard error, if it has not.
#[must_use]
pub fn success(output: &Output, what: &str) -> String {
    assert!(output.status.success(), "{what}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Fails unless the program ended with one line on standard error, progress aside, that names every
/// one of `words`, and without a panic.
///
/// # Panics
/// Then.
pub fn refusal(output: &Output, what: &str, words: &[&str]) {
    let said = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<&str> = said.trim_end().lines().filter(|line| !line.ends_with(" s …")).collect();
    let text = lines.join("\n");
    assert!(!output.status.success(), "{what} succeeded");
    assert_eq!(lines.len(), 1, "{what}: {text}");
    assert!(text.starts_with("error: ") && !text.contains("panicked"), "{what}: {text}");
    for word in words {
        assert!(text.contains(word), "{what} should name {word}: {text}");
    }
}

/// `path`, made an empty folder.
///
/// # Panics
/// Where the system refuses.
#[must_use]
pub fn emptied(path: PathBuf) -> PathBuf {
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    path
}

/// For a test of the binary NAME: `NAME` runs it, `done` runs it and returns what it prints,
/// `refused` runs it on arguments that it must refuse, `folder` makes an empty folder.
#[macro_export]
macro_rules! program {
    ($name:ident) => {
        pub use $crate::program::text;

        pub fn $name(arguments: &[&str]) -> std::process::Output {
            let program = env!(concat!("CARGO_BIN_EXE_", stringify!($name)));
            std::process::Command::new(program).args(arguments).env_remove("SMPL_MODEL").output().unwrap()
        }

        pub fn done(arguments: &[&str]) -> String {
            $crate::program::success(&$name(arguments), &format!("{arguments:?}"))
        }

        pub fn refused(arguments: &[&str], words: &[&str]) {
            $crate::program::refusal(&$name(arguments), &format!("{arguments:?}"), words);
        }

        pub fn folder(name: &str) -> std::path::PathBuf {
            $crate::program::emptied(std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(name))
        }
    };
}
