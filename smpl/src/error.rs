//! Errors of reading and writing files.

use std::path::PathBuf;

/// An error of a file: I/O, format, or content.
///
/// `file` is the path as given, or the name passed with bytes in memory; `key` is the array's name,
/// displayed with control characters escaped. Messages are one line.
///
/// ```
/// let error = smpl::BodyModel::load("no_such_body.npz".as_ref()).unwrap_err();
/// assert!(matches!(error, smpl::Error::Io { .. }));
/// assert!(error.to_string().starts_with("no_such_body.npz: "));
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system reported an error.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path as given.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file extension this crate does not read.
    #[error("{}: unknown kind of file (expected {expected})", path.display())]
    Extension {
        /// The path as given.
        path: PathBuf,
        /// Supported extensions.
        expected: &'static str,
    },
    /// A required array is missing.
    #[error("{file}: no `{key}` (it holds {})", available.join(", ").escape_debug())]
    MissingKey {
        /// The file.
        file: String,
        /// Requested name.
        key: String,
        /// Available names.
        available: Vec<String>,
    },
    /// An array of the wrong shape.
    #[error("{file}: `{}` has shape {actual:?}, expected {expected}", key.escape_debug())]
    Shape {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// Expected pattern; `_` is any size.
        expected: String,
        /// The shape in the file.
        actual: Vec<usize>,
    },
    /// An array or object of the wrong type.
    #[error("{file}: `{}` is {actual}, expected {expected}", key.escape_debug())]
    Type {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// Expected type.
        expected: &'static str,
        /// Actual type.
        actual: String,
    },
    /// NaN, an infinity, or a value too large for `f32`.
    #[error("{file}: `{}` is not finite at flat index {index}", key.escape_debug())]
    NotFinite {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// Position of the first such value, row-major.
        index: usize,
    },
    /// Inconsistent content: an index out of range, weights that do not sum to one, a tree with a
    /// cycle. Also malformed glTF, OBJ and safetensors files; `key` is then the part or the line.
    #[error("{file}: `{}`: {message}", key.escape_debug())]
    Invalid {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// The fault.
        message: String,
    },
    /// The file claims more memory than the reader's limit. Raised before allocation.
    #[error("{file}: `{}` claims {claimed} bytes, more than the limit of {limit}", key.escape_debug())]
    TooLarge {
        /// The file.
        file: String,
        /// The array; empty for the file as a whole.
        key: String,
        /// Claimed size, bytes.
        claimed: u128,
        /// Limit, bytes.
        limit: u64,
    },
    /// Malformed or truncated `.npy` or `.npz` structure.
    #[error("{file}: {}malformed array file: {message}", within(key))]
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
        /// Offset of the opcode at fault from the start of the file.
        offset: usize,
        /// The fault.
        message: String,
    },
}

impl Error {
    /// Shorthand for [`Error::Invalid`].
    pub(crate) fn invalid(file: &str, key: &str, message: impl Into<String>) -> Self {
        Self::Invalid { file: file.to_owned(), key: key.to_owned(), message: message.into() }
    }
}

/// The key with its separator; empty for the file as a whole.
fn within(key: &str) -> String {
    if key.is_empty() { String::new() } else { format!("`{}`: ", key.escape_debug()) }
}
