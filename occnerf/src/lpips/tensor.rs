//! What a file of weights says of a tensor, and errors that name the file.

use std::path::Path;

use safetensors::tensor::Dtype;

use crate::Error;

/// A tensor of a file.
#[derive(Clone, Debug)]
pub(super) struct Tensor {
    pub dtype: Dtype,
    pub shape: Vec<usize>,
    /// Where its bytes start: in the file, or in an entry of the zip archive that the file is.
    pub at: u64,
    pub entry: Option<String>,
}

pub(super) fn fault(path: &Path, what: impl Into<String>) -> Error {
    Error::File { path: path.to_owned(), what: what.into() }
}

pub(super) fn io(path: &Path) -> impl Fn(std::io::Error) -> Error {
    move |source| Error::Io { path: path.to_owned(), source }
}
