use std::ops::Range;

use rayon::prelude::*;

use crate::config::{Error, HashGridConfig, MAX_PARAMETERS, MAX_RESOLUTION, check};
use crate::layout::Layout;

/// Points encoded at one level before the next level starts: enough to amortise loading the level's
/// table into the cache, few enough for their coordinates to stay there from level to level.
const CHUNK: usize = 1 << 15;

/// A multiresolution hash encoding of D-dimensional points, D = 2, 3 or 4 (others do not compile).
///
/// Holds the shape only; the table of parameters belongs to the caller, so that optimisers and
/// checkpoints see one flat slice.
///
/// ```
/// let grid = hashgrid::HashGrid::<2>::with_resolutions(&[4, 100], 2, 10)?;
/// // The coarse level stores its 5 × 5 corners, the fine one hashes 101 × 101 corners to 2^10 rows.
/// assert_eq!((grid.level_range(0), grid.level_range(1)), (0..50, 50..2098));
///
/// let table = grid.init_table(1);
/// let mut features = [0.0; 4];
/// grid.encode(&table, &[[0.5, 0.25]], &mut features);
/// // This point is corner (2, 1) of the coarse level, row 2 + 1 · 5.
/// assert_eq!(features[..2], table[14..16]);
/// # Ok::<(), hashgrid::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HashGrid<const D: usize> {
    pub(crate) levels: Vec<Level>,
    pub(crate) resolutions: Vec<u32>,
    pub(crate) features: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Level {
    pub resolution: u32,
    /// Rows of this level; a power of two where hashed.
    pub rows: usize,
    pub hashed: bool,
    /// First number of this level in the flat table.
    pub start: usize,
}

/// One level of a chunk of points.
pub(crate) struct Pass<'a> {
    pub level: &'a Level,
    /// Range of the level in the table.
    pub table: Range<usize>,
    /// Range of the chunk in the points.
    pub points: Range<usize>,
    /// Range of the chunk's features of this level in (L, Q, F).
    pub features: Range<usize>,
}

impl<const D: usize> HashGrid<D> {
    /// A grid with geometrically growing resolutions.
    ///
    /// # Errors
    /// [`Error`] for a setting outside the ranges of [`HashGridConfig`], or more than 2^31
    /// parameters.
    pub fn new(config: &HashGridConfig) -> Result<Self, Error> {
        let resolutions = config.resolutions()?;
        Self::with_resolutions(&resolutions, config.features, config.log2_table_size)
    }

    /// A grid with the given resolutions in cells per axis (L), in any order.
    ///
    /// # Errors
    /// As for [`HashGrid::new`].
    pub fn with_resolutions(resolutions: &[u32], features: usize, log2_table_size: u32) -> Result<Self, Error> {
        const {
            assert!(2 <= D && D <= 4, "a hash grid has 2, 3 or 4 dimensions");
        }
        check("levels", resolutions.len(), 1..=64)?;
        check("features", features, 1..=256)?;
        check("log2_table_size", log2_table_size, 0..=28)?;
        let most_rows = 1u64 << log2_table_size;
        let mut levels = Vec::with_capacity(resolutions.len());
        // At most 64 levels · 2^28 rows · 256 features: no overflow.
        let mut start = 0u64;
        for (level, &resolution) in resolutions.iter().enumerate() {
            check(&format!("resolution of level {level}"), resolution, 1..=MAX_RESOLUTION)?;
            // A power that overflows u64 exceeds the table, too.
            let corners = (u64::from(resolution) + 1).checked_pow(D as u32);
            let dense = corners.filter(|&corners| corners <= most_rows);
            let rows = dense.unwrap_or(most_rows);
            levels.push(Level { resolution, rows: rows as usize, hashed: dense.is_none(), start: start as usize });
            start += rows * features as u64;
            check("number of parameters", start, 0..=MAX_PARAMETERS)?;
        }
        Ok(Self { levels, resolutions: resolutions.to_vec(), features })
    }

    /// Length of the flat table.
    pub fn num_parameters(&self) -> usize {
        self.level_range(self.levels.len() - 1).end
    }

    /// L·F, the number of features of one point.
    pub fn num_features(&self) -> usize {
        self.levels.len() * self.features
    }

    /// Range of level `level` in the flat table: min((N + 1)^D, 2^T) rows of F numbers.
    ///
    /// # Panics
    /// If there is no such level.
    pub fn level_range(&self, level: usize) -> Range<usize> {
        let Level { start, rows, .. } = self.levels[level];
        start..start + rows * self.features
    }

    /// Layout of the features of `points` points.
    pub fn layout(&self, points: usize) -> Layout {
        Layout { levels: self.levels.len(), points, features: self.features }
    }

    /// Resolutions of the levels in cells per axis (L).
    pub fn resolutions(&self) -> &[u32] {
        &self.resolutions
    }

    /// An initial table: uniform in ±1e-4 (Müller et al. 2022, section 3), determined by `seed`.
    pub fn init_table(&self, seed: u64) -> Vec<f32> {
        const AMPLITUDE: f32 = 1e-4;
        let mut table = vec![0.0; self.num_parameters()];
        // Counter-based random numbers: the result does not depend on the number of threads.
        table.par_iter_mut().enumerate().for_each(|(i, value)| {
            let bits = splitmix64(splitmix64(seed).wrapping_add(i as u64)) >> 40;
            *value = (bits as f32 / (1u32 << 23) as f32 - 1.0) * AMPLITUDE;
        });
        table
    }

    pub(crate) fn assert_table(&self, what: &str, table: &[f32]) {
        let (found, expected) = (table.len(), self.num_parameters());
        assert_eq!(found, expected, "{what} has {found} numbers, expected num_parameters() = {expected}");
    }

    /// Passes over the features of `points` points: all levels of a chunk, then of the next.
    pub(crate) fn passes(&self, points: usize) -> impl Iterator<Item = Pass<'_>> {
        let chunks = (0..points).step_by(CHUNK).map(move |first| first..points.min(first + CHUNK));
        chunks.flat_map(move |range| {
            self.levels.iter().enumerate().map(move |(l, level)| {
                let first = l * points;
                let features = (first + range.start) * self.features..(first + range.end) * self.features;
                Pass { level, table: self.level_range(l), points: range.clone(), features }
            })
        })
    }

    pub(crate) fn assert_features(&self, what: &str, features: &[f32], points: usize) {
        let (found, width) = (features.len(), self.num_features());
        assert_eq!(found, points * width, "{what} has {found} numbers, expected {points} points × {width} features");
    }
}

/// Steele, Lea, Flood: Fast splittable pseudorandom number generators, 2014.
fn splitmix64(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}
