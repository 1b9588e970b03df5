//! The interface of LPIPS in a build without the feature `lpips`: nothing can be loaded.

use std::convert::Infallible;
use std::path::Path;

use crate::Error;

/// Which network's features are compared; this build has none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trunk(());

impl Trunk {
    /// The name used in results.
    pub fn name(self) -> &'static str {
        "none"
    }
}

/// A network with its weights. There is none in a build without the feature `lpips`.
pub struct Lpips(Infallible);

impl Lpips {
    /// Refuses: the feature `lpips` is off.
    ///
    /// # Errors
    /// Always [`Error::Lpips`].
    pub fn load(path: &Path) -> Result<Self, Error> {
        let path = path.display();
        Err(Error::Lpips(format!("weights {path} given, but this build is without the feature `lpips`")))
    }

    /// The network.
    pub fn trunk(&self) -> Trunk {
        match self.0 {}
    }

    /// Whether pictures of a size can be compared.
    ///
    /// # Errors
    /// None: there is no such value.
    pub fn check_size(&self, _width: usize, _height: usize) -> Result<(), Error> {
        match self.0 {}
    }

    /// Distances of pictures.
    ///
    /// # Errors
    /// None: there is no such value.
    pub fn distance(&self, _a: &[f32], _b: &[f32], _width: usize, _height: usize) -> Result<Vec<f64>, Error> {
        match self.0 {}
    }

    /// Distances of pictures and their gradient.
    ///
    /// # Errors
    /// None: there is no such value.
    pub fn distance_backward(
        &self,
        _a: &[f32],
        _b: &[f32],
        _width: usize,
        _height: usize,
        _d_distance: f32,
        _d_a: &mut [f32],
    ) -> Result<Vec<f64>, Error> {
        match self.0 {}
    }
}
