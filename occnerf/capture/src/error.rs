use std::path::{Path, PathBuf};

/// A fault of a capture, in one line with file, key, expected and actual value.
///
/// ```
/// let error = capture::Layout::detect("/nowhere".as_ref()).unwrap_err();
/// assert_eq!(error.to_string(), "/nowhere: missing directory");
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// A file or directory cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A picture cannot be decoded or encoded.
    #[error("{}: not a readable picture: {source}", path.display())]
    Picture {
        /// The picture.
        path: PathBuf,
        /// The codec's reason.
        source: image::ImageError,
    },
    /// A pickle, array file or body model is truncated or malformed, or an array in it has the
    /// wrong type or shape.
    #[error(transparent)]
    Array(#[from] array_files::Error),
    /// A file that the layout demands is absent.
    #[error("{}: missing {what}", path.display())]
    Missing {
        /// Path where it should be.
        path: PathBuf,
        /// The missing item, and its reference.
        what: String,
    },
    /// A value has the wrong type, shape or size, or makes no sense.
    #[error("{}: {}: expected {expected}, found {}", path.display(), line(key), line(actual))]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The value within the file.
        key: String,
        /// Values that would have been right.
        expected: String,
        /// Value that is there.
        actual: String,
    },
    /// An option out of range.
    #[error("{name}: expected {expected}, found {actual}")]
    Setting {
        /// The setting.
        name: &'static str,
        /// Values that would have been right.
        expected: String,
        /// Value that was given.
        actual: String,
    },
}

/// Escapes control characters of a text from a file.
fn line(text: &str) -> String {
    let shown = |c: char| if c.is_control() { c.escape_default().to_string() } else { c.to_string() };
    text.chars().map(shown).collect()
}

impl CaptureError {
    /// A value that is not as expected.
    pub fn invalid(
        path: &Path,
        key: impl Into<String>,
        expected: impl Into<String>,
        actual: impl Into<String>,
    ) -> Self {
        Self::Invalid { path: path.to_owned(), key: key.into(), expected: expected.into(), actual: actual.into() }
    }

    /// A file that is absent.
    pub fn missing(path: &Path, what: impl Into<String>) -> Self {
        Self::Missing { path: path.to_owned(), what: what.into() }
    }

    /// A setting out of its range.
    pub fn setting(name: &'static str, expected: impl Into<String>, actual: impl ToString) -> Self {
        Self::Setting { name, expected: expected.into(), actual: actual.to_string() }
    }

    /// A failure of the system on `path`.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| {
            let target = std::fs::read_link(path).ok().filter(|_| source.kind() == std::io::ErrorKind::NotFound);
            let source = match target {
                Some(to) => std::io::Error::new(source.kind(), format!("a broken link to {}", to.display())),
                None => source,
            };
            Self::Io { path: path.to_owned(), source }
        }
    }
}
