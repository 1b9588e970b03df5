//! Errors of files.

use std::path::{Path, PathBuf};

/// A file that cannot be read, or an array in it that does not fit its use.
///
/// `file` is the path as given, or the name passed along with bytes in memory; `key` is the name of
/// the array. Control characters of keys are escaped, so that a message is a single line.
///
/// ```
/// use array_files::{Error, pickle};
///
/// let error = pickle::parse("evil.pkl", b"cos\nsystem\n(S'true'\ntR.").unwrap_err();
/// assert!(matches!(error, Error::Pickle { offset: 0, .. }));
/// let text = "evil.pkl: malformed pickle at byte 0: global `os system` is not allowed";
/// assert_eq!(error.to_string(), text);
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path as given.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A required array is missing.
    #[error("{file}: no `{key}` (it holds {})", available.join(", ").escape_debug())]
    MissingKey {
        /// The file.
        file: String,
        /// The missing name.
        key: String,
        /// The names present.
        available: Vec<String>,
    },
    /// An array of another shape than expected.
    #[error("{file}: `{}` has shape {actual:?}, expected {expected}", key.escape_debug())]
    Shape {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// Expected extents, `_` for any.
        expected: String,
        /// The shape in the file.
        actual: Vec<usize>,
    },
    /// An array or object of another type than expected.
    #[error("{file}: `{}` is {actual}, expected {expected}", key.escape_debug())]
    Type {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// The expected type.
        expected: &'static str,
        /// The type in the file.
        actual: String,
    },
    /// NaN, an infinity, or a value beyond the range of `f32`.
    #[error("{file}: `{}` is not finite at flat index {index}", key.escape_debug())]
    NotFinite {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// Row-major position of the first such value.
        index: usize,
    },
    /// Contradictory content: a tensor outside its storage, a sparse matrix whose parts disagree, a
    /// shape that does not match the number of values.
    #[error("{file}: `{}`: {message}", key.escape_debug())]
    Invalid {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// The fault.
        message: String,
    },
    /// Content larger than the reader's limit. Raised before that memory is allocated.
    #[error("{file}: `{}` claims {claimed} bytes, more than the limit of {limit}", key.escape_debug())]
    TooLarge {
        /// The file.
        file: String,
        /// The array; empty for the file as a whole.
        key: String,
        /// Bytes needed, as far as known.
        claimed: u128,
        /// Bytes allowed.
        limit: u64,
    },
    /// Malformed or truncated `.npy` or `.npz` structure.
    #[error("{file}: {}malformed array file: {message}", prefix(key))]
    Npy {
        /// The file.
        file: String,
        /// The array; empty for the archive as a whole.
        key: String,
        /// The fault.
        message: String,
    },
    /// Malformed, truncated or disallowed pickle.
    #[error("{file}: malformed pickle at byte {offset}: {message}")]
    Pickle {
        /// The file.
        file: String,
        /// Offset of the failing opcode from the start of the file.
        offset: usize,
        /// The fault.
        message: String,
    },
}

impl Error {
    pub(crate) fn io(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_owned(), source }
    }

    pub(crate) fn invalid(file: &str, key: &str, message: impl ToString) -> Self {
        Self::Invalid { file: file.to_owned(), key: key.to_owned(), message: message.to_string() }
    }

    pub(crate) fn too_large(file: &str, key: &str, claimed: u128, limit: u64) -> Self {
        Self::TooLarge { file: file.to_owned(), key: key.to_owned(), claimed, limit }
    }

    pub(crate) fn npy(file: &str, key: &str, message: impl ToString) -> Self {
        Self::Npy { file: file.to_owned(), key: key.to_owned(), message: message.to_string() }
    }
}

/// `key` and a colon; empty for the file as a whole.
fn prefix(key: &str) -> String {
    if key.is_empty() { String::new() } else { format!("`{}`: ", key.escape_debug()) }
}
