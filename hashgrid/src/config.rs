/// Most cells an axis may have: the integers an `f32` coordinate can still tell apart.
///
/// From 2^20 cells on little is left of an `f32` coordinate's 24 bits for the place within a cell.
pub const MAX_RESOLUTION: u32 = 1 << 24;

/// Largest log2 of the rows of one level.
pub const MAX_LOG2_TABLE_SIZE: u32 = 28;

/// Most numbers in one table: 8 GiB of `f32`.
pub const MAX_PARAMETERS: usize = 1 << 31;

/// Shape of an encoding whose resolutions grow geometrically from `n_min` to `n_max`.
///
/// N_l = ⌊n_min · b^l⌋ with b = (n_max / n_min)^(1 / (levels − 1)) (Müller et al. 2022, eq. 2 and
/// 3); the first and the last level are exactly `n_min` and `n_max`. With one level, only `n_min`
/// is used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HashGridConfig {
    /// L, at least 1.
    pub levels: usize,
    /// F, numbers stored at a corner, at least 1. 1, 2, 4 and 8 have kernels of their own.
    pub features: usize,
    /// T: a level has at most 2^T rows.
    pub log2_table_size: u32,
    /// Cells an axis of the coarsest level, at least 1.
    pub n_min: u32,
    /// Cells an axis of the finest level, at least `n_min`, at most [`MAX_RESOLUTION`].
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
            // A whole number must not fall below itself by the rounding of exp and ln.
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

/// Checks everything but the total size.
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

/// Why a grid cannot be built.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// `levels` is 0, or there are no resolutions.
    #[error("a hash grid needs at least one level")]
    NoLevels,
    /// More levels than a grid can have.
    #[error("{levels} levels, at most {most}")]
    TooManyLevels {
        /// The levels asked for.
        levels: usize,
        /// The limit.
        most: usize,
    },
    /// No features at a corner, or absurdly many.
    #[error("{features} features a corner, expected 1 to {most}")]
    Features {
        /// The features asked for.
        features: usize,
        /// The limit.
        most: usize,
    },
    /// 2^T rows are too many.
    #[error("a table of 2^{log2_table_size} rows a level, at most 2^{MAX_LOG2_TABLE_SIZE}")]
    TableSize {
        /// The T asked for.
        log2_table_size: u32,
    },
    /// A level with no cells, or with more than [`MAX_RESOLUTION`].
    #[error("level {level} has {resolution} cells an axis, expected 1 to {MAX_RESOLUTION}")]
    Resolution {
        /// Index of the level.
        level: usize,
        /// Its cells an axis.
        resolution: u32,
    },
    /// `n_max` below `n_min`.
    #[error("n_max {n_max} is below n_min {n_min}")]
    ResolutionOrder {
        /// Coarsest.
        n_min: u32,
        /// Finest.
        n_max: u32,
    },
    /// All levels together are larger than [`MAX_PARAMETERS`].
    #[error("{parameters} parameters, at most {MAX_PARAMETERS}")]
    TooManyParameters {
        /// The numbers that the table would hold up to the first level beyond the limit.
        parameters: u64,
    },
}
