/// Largest resolution of a level, in cells per axis: the integers an `f32` represents exactly.
///
/// From 2^20 cells on, an `f32` coordinate has less than 4 bits for the position within a cell.
pub const MAX_RESOLUTION: u32 = 1 << 24;

/// Largest log2 of the rows of one level.
const MAX_LOG2_TABLE_SIZE: u32 = 28;

/// Largest number of parameters: 8 GiB of `f32`.
pub(crate) const MAX_PARAMETERS: usize = 1 << 31;

/// Shape of an encoding whose resolutions grow geometrically from `n_min` to `n_max`.
///
/// N_l = ⌊n_min · b^l⌋ with b = (n_max / n_min)^(1 / (levels − 1)) (Müller et al. 2022, eq. 2 and
/// 3); the first and the last level are exactly `n_min` and `n_max`. With one level, only `n_min`
/// is used.
///
/// ```
/// use hashgrid::{HashGrid, HashGridConfig};
///
/// // The paper's settings for a 3-D scene: growth b = 1.38.
/// let config = HashGridConfig { levels: 16, features: 2, log2_table_size: 19, n_min: 16, n_max: 2048 };
/// let grid = HashGrid::<3>::new(&config)?;
/// assert_eq!(grid.resolutions()[..4], [16, 22, 30, 42]);
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
        if levels == 0 {
            return Err(Error::NoLevels);
        }
        if n_max < n_min {
            return Err(Error::ResolutionOrder { n_min, n_max });
        }
        check_resolution(0, n_min)?;
        check_resolution(levels - 1, n_max)?;
        check_levels(levels)?;
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

const MAX_LEVELS: usize = 64;
const MAX_FEATURES: usize = 256;

fn check_levels(levels: usize) -> Result<(), Error> {
    match levels {
        0 => Err(Error::NoLevels),
        1..=MAX_LEVELS => Ok(()),
        _ => Err(Error::TooManyLevels { levels, most: MAX_LEVELS }),
    }
}

fn check_resolution(level: usize, resolution: u32) -> Result<(), Error> {
    if (1..=MAX_RESOLUTION).contains(&resolution) {
        return Ok(());
    }
    Err(Error::Resolution { level, resolution })
}

/// Validates all settings but the total size.
pub(crate) fn check(resolutions: &[u32], features: usize, log2_table_size: u32) -> Result<(), Error> {
    check_levels(resolutions.len())?;
    if !(1..=MAX_FEATURES).contains(&features) {
        return Err(Error::Features { features, most: MAX_FEATURES });
    }
    if log2_table_size > MAX_LOG2_TABLE_SIZE {
        return Err(Error::TableSize { log2_table_size });
    }
    for (level, &resolution) in resolutions.iter().enumerate() {
        check_resolution(level, resolution)?;
    }
    Ok(())
}

/// Invalid configuration of a grid.
///
/// ```
/// use hashgrid::{Error, HashGrid};
///
/// let error = HashGrid::<3>::with_resolutions(&[16, 0], 2, 14).unwrap_err();
/// assert_eq!(error, Error::Resolution { level: 1, resolution: 0 });
/// assert_eq!(error.to_string(), "level 1 has a resolution of 0, expected 1 to 16777216");
/// ```
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// `levels` is 0, or there are no resolutions.
    #[error("a hash grid needs at least one level")]
    NoLevels,
    /// More than 64 levels.
    #[error("{levels} levels, at most {most}")]
    TooManyLevels {
        /// Requested levels.
        levels: usize,
        /// Upper limit.
        most: usize,
    },
    /// Number of features out of range.
    #[error("{features} features per level, expected 1 to {most}")]
    Features {
        /// Requested features.
        features: usize,
        /// Upper limit.
        most: usize,
    },
    /// T above 28.
    #[error("a table of 2^{log2_table_size} rows per level, at most 2^{MAX_LOG2_TABLE_SIZE}")]
    TableSize {
        /// Requested T.
        log2_table_size: u32,
    },
    /// A resolution of 0 or above [`MAX_RESOLUTION`].
    #[error("level {level} has a resolution of {resolution}, expected 1 to {MAX_RESOLUTION}")]
    Resolution {
        /// Index of the level.
        level: usize,
        /// Its cells per axis.
        resolution: u32,
    },
    /// `n_max` below `n_min`.
    #[error("n_max {n_max} is below n_min {n_min}")]
    ResolutionOrder {
        /// Coarsest resolution.
        n_min: u32,
        /// Finest resolution.
        n_max: u32,
    },
    /// More than 2^31 parameters in all levels together.
    #[error("{parameters} parameters, at most {MAX_PARAMETERS}")]
    TooManyParameters {
        /// Parameters up to and including the first level beyond the limit.
        parameters: u64,
    },
}
