//! Errors of files.

use std::path::PathBuf;

/// A file that cannot be read or does not hold what it should.
///
/// `file` is the path as given, or the name passed with bytes already in memory; `key` is the
/// array's name, which is shown with its control characters escaped: one line whatever it holds.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The operating system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The path as given.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file name ends in nothing this crate reads.
    #[error("{}: unknown kind of file (expected {expected})", path.display())]
    Extension {
        /// The path as given.
        path: PathBuf,
        /// The extensions that would do.
        expected: &'static str,
    },
    /// An array that must be there is not.
    #[error("{file}: no `{key}` (it holds {})", available.join(", ").escape_debug())]
    MissingKey {
        /// The file.
        file: String,
        /// The name that was looked for.
        key: String,
        /// The names that are there instead.
        available: Vec<String>,
    },
    /// An array of another shape than its use demands.
    #[error("{file}: `{}` has shape {actual:?}, expected {expected}", key.escape_debug())]
    Shape {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// Pattern, `_` standing for any size.
        expected: String,
        /// The shape in the file.
        actual: Vec<usize>,
    },
    /// An array or object of another type than its use demands.
    #[error("{file}: `{}` is {actual}, expected {expected}", key.escape_debug())]
    Type {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// The type that is expected.
        expected: &'static str,
        /// The type found.
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
    /// Readable, but impossible: an index out of range, weights that do not sum to one, a tree with
    /// a cycle. Also what cannot be read of a glTF, OBJ or safetensors file; `key` is then the part
    /// or the line.
    #[error("{file}: `{}`: {message}", key.escape_debug())]
    Invalid {
        /// The file.
        file: String,
        /// The array.
        key: String,
        /// The fault.
        message: String,
    },
    /// The file asks for more memory than the reader's limit. Raised before the memory is
    /// allocated.
    #[error("{file}: `{}` claims {claimed} bytes, more than the limit of {limit}", key.escape_debug())]
    TooLarge {
        /// The file.
        file: String,
        /// The array; empty for the file as a whole.
        key: String,
        /// Bytes that the header claims.
        claimed: u128,
        /// Bytes that are allowed.
        limit: u64,
    },
    /// Malformed or truncated `.npy` or `.npz` structure.
    #[error("{file}: {}malformed array file: {message}", within(key))]
    Npy {
        /// The file.
        file: String,
        /// The array; empty for the archive as a whole.
        key: String,
        /// The fault found.
        message: String,
    },
    /// Malformed, truncated or disallowed pickle.
    #[error("{file}: malformed pickle at byte {offset}: {message}")]
    Pickle {
        /// The file.
        file: String,
        /// Offset of the opcode at fault from the start of the file.
        offset: usize,
        /// The fault found.
        message: String,
    },
}

impl Error {
    /// Shorthand for [`Error::Invalid`].
    pub(crate) fn invalid(file: &str, key: &str, message: impl Into<String>) -> Self {
        Self::Invalid { file: file.to_owned(), key: key.to_owned(), message: message.into() }
    }
}

/// The key with what parts it from the rest of a line; nothing for the file as a whole.
fn within(key: &str) -> String {
    if key.is_empty() { String::new() } else { format!("`{}`: ", key.escape_debug()) }
}
