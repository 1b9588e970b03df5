//! Errors of files and models.

use std::path::PathBuf;

/// A file that cannot be read or written, or a model that is not valid.
///
/// `file` is the path as given, or the name passed along with bytes in memory; `key` is the array,
/// part or line, with its control characters escaped: a message is a single line.
///
/// ```
/// use smpl::{BodyModel, Error};
///
/// let mut body = BodyModel::embedded();
/// body.faces[5][0] = 7000;
/// let error = body.validate("body.npz").unwrap_err();
/// assert!(matches!(&error, Error::Invalid { key, .. } if key == "f"));
/// assert_eq!(error.to_string(), "body.npz: `f`: face 5 names vertex 7000 of 6890");
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file, or an array in it, cannot be read, or is of another type or shape than expected.
    #[error(transparent)]
    File(#[from] array_files::Error),
    /// A file name with an unknown extension.
    #[error("{}: unknown kind of file (expected {expected})", path.display())]
    Extension {
        /// The path as given.
        path: PathBuf,
        /// The known extensions.
        expected: &'static str,
    },
    /// Readable, but impossible: an index out of range, weights that do not sum to one, a tree with
    /// a cycle. Also malformed glTF, OBJ and safetensors files.
    #[error("{file}: `{}`: {message}", key.escape_debug())]
    Invalid {
        /// The file.
        file: String,
        /// The array, part or line.
        key: String,
        /// The fault.
        message: String,
    },
}

impl Error {
    /// [`Error::Invalid`] of a file's array, part or line.
    pub fn invalid(file: &str, key: &str, message: impl Into<String>) -> Self {
        Self::Invalid { file: file.to_owned(), key: key.to_owned(), message: message.into() }
    }

    /// A value of `key` that is NaN or infinite, at row-major position `index`.
    pub(crate) fn not_finite(file: &str, key: &str, index: usize) -> Self {
        Self::invalid(file, key, format!("not finite at flat index {index}"))
    }
}
