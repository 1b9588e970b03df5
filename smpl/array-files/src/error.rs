//! Errors of files.

use std::path::{Path, PathBuf};

/// A file that cannot be read or written, or an array or part of it that does not fit its use.
///
/// `file` is the path as given, or the name passed along with bytes in memory; `key` is the array,
/// part or line, empty for the file as a whole. Control characters are escaped, so that a message
/// is a single line.
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
    /// A missing array, one of another type or shape than expected, with values that are not finite
    /// or parts that contradict each other, or one larger than the reader's limit, which is found
    /// before the memory is allocated. Also malformed safetensors, and what other crates read.
    #[error("{file}: {}{message}", prefix(key))]
    Invalid {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// Expected and actual.
        message: String,
    },
    /// Malformed or truncated `.npy` or `.npz` structure.
    #[error("{file}: {}malformed array file: {message}", prefix(key))]
    Npy {
        /// The file.
        file: String,
        /// The array.
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
    /// [`Error::Invalid`] of an array.
    pub fn invalid(file: &str, key: &str, message: impl ToString) -> Self {
        Self::Invalid { file: file.to_owned(), key: key.to_owned(), message: message.to_string() }
    }

    /// [`Error::Invalid`] for an array that is not among those present.
    pub fn missing<S: AsRef<str>>(file: &str, key: &str, present: impl IntoIterator<Item = S>) -> Self {
        let present: Vec<String> = present.into_iter().map(|name| name.as_ref().escape_debug().to_string()).collect();
        Self::invalid(file, key, format!("missing, the file holds {}", present.join(", ")))
    }

    /// [`Error::Invalid`] for content that needs more bytes than `limit`.
    pub fn too_large(file: &str, key: &str, claimed: u128, limit: u64) -> Self {
        Self::invalid(file, key, format!("claims {claimed} bytes, more than the limit of {limit}"))
    }

    pub(crate) fn io(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        move |source| Self::Io { path: path.to_owned(), source }
    }

    pub(crate) fn npy(file: &str, key: &str, message: impl ToString) -> Self {
        Self::Npy { file: file.to_owned(), key: key.to_owned(), message: message.to_string() }
    }
}

/// `key` and a colon; empty for the file as a whole.
fn prefix(key: &str) -> String {
    if key.is_empty() { String::new() } else { format!("`{}`: ", key.escape_debug()) }
}
