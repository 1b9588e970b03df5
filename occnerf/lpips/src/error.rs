use std::path::PathBuf;

/// Weights that cannot be read, or images of a size that a network does not take.
///
/// ```
/// use lpips::{Error, Lpips};
///
/// let Err(error) = Lpips::load("no/such/vgg16.pth".as_ref()) else { unreachable!() };
/// assert!(matches!(error, Error::Io { .. }));
/// assert!(error.to_string().starts_with("no/such/vgg16.pth: "));
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file or directory that cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that does not hold the weights of a network.
    #[error("{}: {what}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Tensor, expected and actual type and shape.
        what: String,
    },
    /// A file of `torch.save` that is damaged or holds anything but plain data.
    #[error(transparent)]
    Torch(#[from] array_files::Error),
    /// A tensor with another number of values than its shape, or with a value that is not finite.
    #[error("`{name}` {what}")]
    Tensor {
        /// Name of the tensor.
        name: String,
        /// Expected and actual.
        what: String,
    },
    /// An image of a size that the network does not take.
    #[error("{0}")]
    Size(String),
}
