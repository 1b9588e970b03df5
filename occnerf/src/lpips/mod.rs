//! LPIPS (Zhang et al. 2018): the distance of two pictures in the features of a trained network,
//! and its gradient.

mod conv;
mod maps;

mod trunk;
mod unit;
mod weights;
mod winograd;

use std::path::Path;

use crate::Error;
use maps::Maps;
use trunk::Network;

pub use trunk::Trunk;

/// What is taken off x ∈ [−1, 1] and what divides the rest, a channel each.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Largest picture, pixels: 1920 × 1080 fits. At most a kilobyte a pixel is held.
const MAX_PIXELS: usize = 1 << 21;
/// Pixels of the pictures that go through the network together.
const PIXELS_AT_ONCE: usize = 1 << 13;

/// A network with its weights, ready to compare pictures.
pub struct Lpips {
    trunk: Trunk,
    network: Network,
    /// Weight of each channel at each tap.
    lin: Vec<Vec<f32>>,
}

impl Lpips {
    /// Reads weights: a trunk with torchvision's names (`features.0.weight`, …) and LPIPS's linear
    /// layers (`lin0.weight` or `lin0.model.1.weight`, …), in `.safetensors`, or in `.pth` or `.pt`
    /// as `torch.save` writes it.
    ///
    /// `path` is one file, with the linear layers inside or in another file beside it, or a
    /// directory of such files. In a directory the first trunk counts, by file name, that has its
    /// linear layers. Pickles are parsed, never executed, and only the tensors that are needed are
    /// read: a classifier in the file costs nothing.
    ///
    /// # Errors
    /// [`Error::Io`] and [`Error::File`], naming file, tensor, expected and actual type and shape.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let mut found = weights::find(path)?;
        let built = Self::new(found.trunk, |name, shape| found.read(name, shape));
        built.map_err(|error| found.blame(error))
    }

    /// Builds `trunk` from what `read` gives for a name (`features.0.weight`, `lin0.weight`) and
    /// its shape (outputs, inputs, rows, columns; channels), row-major.
    ///
    /// # Errors
    /// Those of `read`; [`Error::Lpips`] for a tensor of another length or with numbers that are
    /// not finite.
    pub fn new(trunk: Trunk, mut read: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, Error>) -> Result<Self, Error> {
        let mut checked = |name: &str, shape: &[usize]| {
            let values = read(name, shape)?;
            if values.len() != shape.iter().product::<usize>() {
                return Err(Error::Lpips(format!("`{name}` has {} values, expected shape {shape:?}", values.len())));
            }
            match values.iter().position(|v| !v.is_finite()) {
                Some(at) => Err(Error::Lpips(format!("`{name}` is {} at flat index {at}", values[at]))),
                None => Ok(values),
            }
        };
        let network = Network::new(trunk, &mut checked)?;
        let lin = network.taps.iter().enumerate();
        let lin = lin.map(|(i, &(_, channels))| checked(&format!("lin{i}.weight"), &[channels]));
        let lin = lin.collect::<Result<_, _>>()?;
        Ok(Self { trunk, network, lin })
    }

    /// The network.
    pub fn trunk(&self) -> Trunk {
        self.trunk
    }

    /// Whether pictures of a size can be compared.
    ///
    /// # Errors
    /// [`Error::Lpips`] for those too small to have an output at every layer, and those of more
    /// than 2²¹ pixels.
    pub fn check_size(&self, width: usize, height: usize) -> Result<(), Error> {
        let name = self.trunk.name();
        let refused = |expected: String| {
            Err(Error::Lpips(format!("a picture of {width} × {height} for {name}, expected {expected}")))
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

    /// Distances of the pictures in `a` from those in `b`: (N, `height`, `width`, 3), row-major,
    /// sRGB in [0, 1]. 0 for equal pictures; about 0.1 for a slight blur and 0.7 for unrelated
    /// ones. The same bits on any number of threads.
    ///
    /// # Errors
    /// Those of [`Lpips::check_size`].
    ///
    /// # Panics
    /// If `a` and `b` are not of the same whole number of pictures.
    pub fn distance(&self, a: &[f32], b: &[f32], width: usize, height: usize) -> Result<Vec<f64>, Error> {
        self.compare(a, b, [width, height], None)
    }

    /// Computes [`Lpips::distance`] and adds `d_distance` × the gradient of each picture's distance
    /// by that picture to `d_a` (like `a`). Where a channel's maximum in a window is shared, the
    /// first pixel gets the gradient; a distance of 0 has none.
    ///
    /// # Errors
    /// Those of [`Lpips::check_size`].
    ///
    /// # Panics
    /// If `a`, `b` and `d_a` are not of the same whole number of pictures.
    pub fn distance_backward(
        &self,
        a: &[f32],
        b: &[f32],
        width: usize,
        height: usize,
        d_distance: f32,
        d_a: &mut [f32],
    ) -> Result<Vec<f64>, Error> {
        assert_eq!(a.len(), d_a.len(), "gradient of another size than the pictures");
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
        assert!(fits, "pictures of {width} × {height} × 3 in {} and {} values", a.len(), b.len());
        let at_once = len * (PIXELS_AT_ONCE / (width * height)).max(1);
        let mut values = Vec::new();
        for (part, (a, b)) in a.chunks(at_once).zip(b.chunks(at_once)).enumerate() {
            let count = a.len() / len;
            let data = a.iter().chain(b).enumerate();
            let data = data.map(|(i, x)| (2.0 * x - 1.0 - SHIFT[i % 3]) / SCALE[i % 3]).collect();
            let input = Maps { count: 2 * count, height, width, channels: 3, data };
            let first = values.len();
            values.resize(first + count, 0.0);
            let at_tap = |number: usize, out: &Maps| {
                if let Some(tap) = self.network.taps.iter().position(|tap| tap.0 == number) {
                    let distances = unit::distances(out, &self.lin[tap]);
                    values[first..].iter_mut().zip(distances).for_each(|(sum, d)| *sum += d);
                }
            };
            let outputs = self.network.forward(&input, at_tap, gradient.is_some());
            if let Some((d_distance, d_a)) = &mut gradient {
                let d_input = self.network.backward(&input, &outputs, count, |tap, out, d_out| {
                    unit::distances_backward(out, &self.lin[tap], *d_distance, d_out);
                });
                let d_a = &mut d_a[part * at_once..][..d_input.data.len()];
                d_a.iter_mut().zip(&d_input.data).enumerate().for_each(|(i, (d, g))| *d += g * 2.0 / SCALE[i % 3]);
            }
        }
        Ok(values)
    }
}
