//! LPIPS (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual
//! Metric"): the distance of two images in the features of a trained network, and its gradient.
//!
//! ```
//! use lpips::{Error, Lpips, Trunk};
//!
//! // Weights of one's own, by torchvision's names; `Lpips::load` reads them from a file.
//! let network = Lpips::new(Trunk::SqueezeNet, |_name, shape| {
//!     let fan_in: usize = shape[1..].iter().product();
//!     let value = |i: usize| ((i * 7919 % 1009) as f32 / 504.0 - 0.6) / (fan_in as f32).sqrt();
//!     Ok(if fan_in == 1 { vec![0.1; shape[0]] } else { (0..shape[0] * fan_in).map(value).collect() })
//! })?;
//!
//! // Two images of 32 × 24 pixels, sRGB in [0, 1].
//! let (width, height) = (32, 24);
//! let image: Vec<f32> = (0..3 * width * height).map(|i| (i % 17) as f32 / 16.0).collect();
//! let mut noisy: Vec<f32> = image.iter().enumerate().map(|(i, v)| v + (i % 5) as f32 * 0.02).collect();
//! assert_eq!(network.distance(&image, &image, width, height)?, [0.0]);
//!
//! // A small step against the gradient brings the noisy one closer.
//! let mut gradient = vec![0.0; noisy.len()];
//! let before = network.distance_backward(&noisy, &image, width, height, 1.0, &mut gradient)?;
//! let norm = gradient.iter().map(|d| d * d).sum::<f32>().sqrt();
//! noisy.iter_mut().zip(&gradient).for_each(|(v, d)| *v -= 0.01 * d / norm);
//! assert!(network.distance(&noisy, &image, width, height)?[0] < before[0]);
//! # Ok::<(), Error>(())
//! ```
//!
//! # Conventions
//! - Images are slices of (image, row, column, channel), row-major, sRGB in [0, 1]; several are
//!   compared pairwise in one call.
//! - Gradients are added to the caller's buffer, so that losses sum up.
//! - The bits depend on the instruction set, not on the number of threads (rayon's pool).
//! - Errors are for files, tensors and image sizes; slices of the wrong length panic.
//!
//! # Features
//! None. The matrix products take AVX-512, AVX2 or NEON at run time.
#![forbid(unsafe_code)]

mod conv;
mod distance;
mod error;
mod maps;
mod trunk;
mod weights;

use std::path::Path;

use distance::{distances, distances_backward};
use maps::Maps;
use trunk::Network;

pub use error::Error;
pub use trunk::Trunk;

/// The README's example, compiled as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

/// Normalisation of x ∈ [−1, 1], a value for each channel: (x − `SHIFT`) / `SCALE`.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Largest image, pixels: 1920 × 1080 fits.
const MAX_PIXELS: usize = 1 << 21;
/// Pixels of the images that go through the network together.
const PIXELS_AT_ONCE: usize = 1 << 13;

/// A network with its weights.
pub struct Lpips {
    trunk: Trunk,
    network: Network,
    /// Weights of the channels at each tap.
    lin: Vec<Vec<f32>>,
}

impl Lpips {
    /// Reads weights: a trunk with torchvision's names (`features.0.weight`, …) and LPIPS's linear
    /// layers (`lin0.weight` or `lin0.model.1.weight`, …), in `.safetensors`, or in `.pth` or `.pt`
    /// as `torch.save` writes it.
    ///
    /// `path` is a file, with the linear layers inside or in another file beside it, or a directory
    /// of such files. A directory's first trunk, by file name, that has its linear layers is taken.
    /// Pickles are parsed, never executed, and only the tensors of the trunk are read, not the
    /// classifier.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::File`] and [`Error::Torch`], naming file, tensor, expected and
    /// actual type and shape.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let mut found = weights::find(path)?;
        let built = Self::new(found.trunk, |name, shape| found.read(name, shape));
        built.map_err(|error| found.blame(error))
    }

    /// Builds `trunk` from the tensors that `read` returns for a name (`features.0.weight`,
    /// `lin0.weight`) and a shape (outputs, inputs, kernel rows, kernel columns; or channels),
    /// row-major.
    ///
    /// # Errors
    /// Those of `read`; [`Error::Tensor`] for a tensor of another length or with a value that is
    /// not finite.
    pub fn new(trunk: Trunk, mut read: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, Error>) -> Result<Self, Error> {
        let mut checked = |name: &str, shape: &[usize]| {
            let values = read(name, shape)?;
            let fault = |what: String| Err(Error::Tensor { name: name.to_owned(), what });
            if values.len() != shape.iter().product::<usize>() {
                return fault(format!("has {} values, expected shape {shape:?}", values.len()));
            }
            match values.iter().position(|v| !v.is_finite()) {
                Some(at) => fault(format!("is {} at flat index {at}", values[at])),
                None => Ok(values),
            }
        };
        let network = Network::new(trunk, &mut checked)?;
        let lin = trunk.taps().iter().enumerate();
        let lin = lin.map(|(i, &channels)| checked(&format!("lin{i}.weight"), &[channels]));
        Ok(Self { trunk, network, lin: lin.collect::<Result<_, _>>()? })
    }

    /// [`Trunk::name`] of the network.
    pub fn name(&self) -> &'static str {
        self.trunk.name()
    }

    /// Whether images of a size can be compared.
    ///
    /// # Errors
    /// [`Error::Size`] for those too small to have an output at every layer, and those of more than
    /// 2²¹ pixels.
    pub fn check_size(&self, width: usize, height: usize) -> Result<(), Error> {
        let refused = |expected: String| {
            let image = format!("LPIPS: an image of {width} × {height} for {}", self.name());
            Err(Error::Size(format!("{image}, expected {expected}")))
        };
        if width.checked_mul(height).is_none_or(|pixels| pixels > MAX_PIXELS) {
            return refused(format!("at most {MAX_PIXELS} pixels"));
        }
        if !self.network.takes(height, width) {
            let least = (1..MAX_PIXELS).find(|&side| self.network.takes(side, side)).unwrap_or(MAX_PIXELS);
            return refused(format!("at least {least} pixels a side"));
        }
        Ok(())
    }

    /// Distances of the images in `a` from those in `b`: (N, `height`, `width`, 3), row-major, sRGB
    /// in [0, 1]. 0 for equal images; about 0.1 for a slight blur and 0.7 for unrelated ones.
    ///
    /// Takes about a kilobyte of memory for each pixel of an image pair.
    ///
    /// # Errors
    /// Those of [`Lpips::check_size`].
    ///
    /// # Panics
    /// If `a` and `b` are not the same whole number of images.
    pub fn distance(&self, a: &[f32], b: &[f32], width: usize, height: usize) -> Result<Vec<f64>, Error> {
        self.compare(a, b, [width, height], None)
    }

    /// Computes [`Lpips::distance`] and adds `d_distance` × the gradient of each image's distance
    /// by that image to `d_a` (like `a`). Where pixels of a pooling window share the maximum, the
    /// first gets the gradient; a distance of 0 has none.
    ///
    /// Meant for patches: takes about five kilobytes for each pixel of an image pair.
    ///
    /// # Errors
    /// Those of [`Lpips::check_size`].
    ///
    /// # Panics
    /// If `a`, `b` and `d_a` are not the same whole number of images.
    pub fn distance_backward(
        &self,
        a: &[f32],
        b: &[f32],
        width: usize,
        height: usize,
        d_distance: f32,
        d_a: &mut [f32],
    ) -> Result<Vec<f64>, Error> {
        assert_eq!(a.len(), d_a.len(), "lengths of images and gradient");
        self.compare(a, b, [width, height], Some((d_distance, d_a)))
    }

    fn compare(
        &self,
        a: &[f32],
        b: &[f32],
        [width, height]: [usize; 2],
        mut gradient: Option<(f32, &mut [f32])>,
    ) -> Result<Vec<f64>, Error> {
        self.check_size(width, height)?;
        let len = 3 * width * height;
        let fits = a.len() == b.len() && a.len().is_multiple_of(len);
        assert!(fits, "images of {width} × {height} × 3 in {} and {} values", a.len(), b.len());
        let at_once = len * (PIXELS_AT_ONCE / (width * height)).max(1);
        let mut values = vec![0.0; a.len() / len];
        let parts = a.chunks(at_once).zip(b.chunks(at_once)).zip(values.chunks_mut(at_once / len));
        for (part, ((a, b), values)) in parts.enumerate() {
            let count = values.len();
            let data = a.iter().chain(b).enumerate();
            let data = data.map(|(i, x)| (2.0 * x - 1.0 - SHIFT[i % 3]) / SCALE[i % 3]).collect();
            let input = Maps { count: 2 * count, height, width, channels: 3, data };
            let at_tap = |tap: usize, out: &Maps| {
                values.iter_mut().zip(distances(out, &self.lin[tap])).for_each(|(sum, d)| *sum += d);
            };
            let outputs = self.network.forward(&input, at_tap, gradient.is_some());
            if let Some((d_distance, d_a)) = &mut gradient {
                let d_input = self.network.backward(&input, &outputs, count, |tap, out, d_out| {
                    distances_backward(out, &self.lin[tap], *d_distance, d_out);
                });
                let d_a = d_a[part * at_once..].iter_mut().zip(&d_input.data);
                d_a.enumerate().for_each(|(i, (d, g))| *d += g * 2.0 / SCALE[i % 3]);
            }
        }
        Ok(values)
    }
}
