use std::fmt::Display;
use std::ops::RangeInclusive;

/// Largest resolution of a level, in cells per axis: the integers an `f32` represents exactly.
///
/// From 2^20 cells on, an `f32` coordinate has less than 4 bits for the position within a cell.
pub const MAX_RESOLUTION: u32 = 1 << 24;
/// Largest number of parameters: 8 GiB of `f32`.
pub(crate) const MAX_PARAMETERS: u64 = 1 << 31;

/// Shape of an encoding whose resolutions grow geometrically from `n_min` to `n_max`.
///
/// N_l = ⌊n_min · b^l⌋ with b = (n_max / n_min)^(1 / (levels − 1)) (Müller et al. 2022, eq. 2 and
/// 3); the first and the last level are exactly `n_min` and `n_max`. With one level, only `n_min`
/// is used.
///
/// ```
/// use hashgrid::{HashGrid, HashGridConfig};
///
/// let config = HashGridConfig { levels: 8, features: 2, log2_table_size: 14, n_min: 16, n_max: 512 };
/// let grid = HashGrid::<3>::new(&config)?;
/// assert_eq!((grid.num_features(), grid.resolutions()[7]), (16, 512));
/// # Ok::<(), hashgrid::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HashGridConfig {
    /// L: number of levels, 1 to 64.
    pub levels: usize,
    /// F: features per level, 1 to 256. 1, 2, 4 and 8 have specialised kernels.
    pub features: usize,
    /// T: a level has at most 2^T rows; at most 28.
    pub log2_table_size: u32,
    /// Resolution of the coarsest level in cells per axis, at least 1.
    pub n_min: u32,
    /// Resolution of the finest level in cells per axis, `n_min` to [`MAX_RESOLUTION`].
    pub n_max: u32,
}

impl HashGridConfig {
    pub(crate) fn resolutions(&self) -> Result<Vec<u32>, Error> {
        let Self { levels, n_min, n_max, .. } = *self;
        check("levels", levels, 1..=64)?;
        check("n_min", n_min, 1..=MAX_RESOLUTION)?;
        check("n_max", n_max, n_min..=MAX_RESOLUTION)?;
        if levels == 1 {
            return Ok(vec![n_min]);
        }
        let growth = (f64::from(n_max) / f64::from(n_min)).ln() / (levels - 1) as f64;
        let grown = |level: usize| {
            // Keeps the floor of an integer N_l from dropping by the rounding of exp and ln.
            let n = f64::from(n_min) * (growth * level as f64).exp() * (1.0 + 1e-12);
            (n as u32).clamp(n_min, n_max)
        };
        let mut resolutions: Vec<u32> = (0..levels).map(grown).collect();
        resolutions[levels - 1] = n_max;
        Ok(resolutions)
    }
}

pub(crate) fn check<T: PartialOrd + Display>(name: &str, value: T, range: RangeInclusive<T>) -> Result<(), Error> {
    if range.contains(&value) {
        return Ok(());
    }
    Err(Error(format!("{name}: {value}, expected {} to {}", range.start(), range.end())))
}

/// Invalid configuration of a grid. The message names the setting, its value and its range.
///
/// ```
/// let error = hashgrid::HashGrid::<3>::with_resolutions(&[16, 0], 2, 14).unwrap_err();
/// assert_eq!(error.to_string(), "resolution of level 1: 0, expected 1 to 16777216");
/// ```
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Error(String);
