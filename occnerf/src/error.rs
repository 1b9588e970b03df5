//! Errors: what can go wrong outside the caller's control.

use std::path::PathBuf;

use crate::capture::CaptureError;
use crate::config::ConfigError;

/// Any failure of preparing, training, saving or evaluating.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A value of the configuration that cannot be.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A capture that cannot be read.
    #[error(transparent)]
    Data(#[from] CaptureError),
    /// A file of arrays, or a body model, that cannot be read or written.
    #[error(transparent)]
    Array(#[from] array_files::Error),
    /// The canonical or a posed mesh, as a set of points.
    #[error("surface query: {0}")]
    Surface(#[from] surface_query::Error),
    /// The canonical or a posed mesh, as something rays hit.
    #[error("ray casting: {0}")]
    Visibility(#[from] visibility::Error),
    /// The encoding.
    #[error("hash grid: {0}")]
    HashGrid(#[from] hashgrid::Error),
    /// A capture that cannot be trained on.
    #[error("scene: {0}")]
    Scene(String),
    /// Weights or images that LPIPS cannot take.
    #[error(transparent)]
    Lpips(#[from] lpips::Error),
    /// A perceptual term without its weights.
    #[error("perceptual term: {0}")]
    Perceptual(String),
    /// An avatar that cannot be written in the form that is asked for.
    #[error("{0}")]
    Bake(String),
    /// A training whose numbers have grown beyond all bounds.
    #[error(
        "training has diverged: after step {step} `{key}` holds {value}; smaller learning rates (`rates`) would do"
    )]
    Diverged {
        /// Steps taken.
        step: u64,
        /// Parameters or moments of the optimiser, as in a checkpoint.
        key: String,
        /// The first such number.
        value: f32,
    },
    /// A file that cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that does not hold what it should.
    #[error("{}: {what}", path.display())]
    File {
        /// Path of the file.
        path: PathBuf,
        /// Key, expected and actual.
        what: String,
    },
}
