//! `Lpips` of the crate `lpips`; without the feature of that name, a type without values.

#[cfg(feature = "lpips")]
pub use ::lpips::Lpips;

#[cfg(not(feature = "lpips"))]
pub use absent::Lpips;

#[cfg(not(feature = "lpips"))]
mod absent {
    use std::path::Path;

    use crate::error::Error;

    /// Network of LPIPS. A build without the feature `lpips` has none.
    #[derive(Clone, Copy)]
    pub enum Lpips {}

    impl Lpips {
        /// Fails: the feature `lpips` is off.
        ///
        /// # Errors
        /// Always [`Error::Perceptual`].
        pub fn load(path: &Path) -> Result<Self, Error> {
            let path = path.display();
            Err(Error::Perceptual(format!("weights {path} given, but this build is without the feature `lpips`")))
        }

        /// Name of the network.
        pub fn name(self) -> &'static str {
            match self {}
        }

        /// Whether images of a size can be compared.
        ///
        /// # Errors
        /// None: there is no value to call this on.
        pub fn check_size(self, _width: usize, _height: usize) -> Result<(), Error> {
            match self {}
        }

        /// Distances of images.
        ///
        /// # Errors
        /// None: there is no value to call this on.
        pub fn distance(self, _a: &[f32], _b: &[f32], _width: usize, _height: usize) -> Result<Vec<f64>, Error> {
            match self {}
        }

        /// Distances of images and their gradient.
        ///
        /// # Errors
        /// None: there is no value to call this on.
        pub fn distance_backward(
            self,
            _a: &[f32],
            _b: &[f32],
            _width: usize,
            _height: usize,
            _d_distance: f32,
            _d_a: &mut [f32],
        ) -> Result<Vec<f64>, Error> {
            match self {}
        }
    }
}
