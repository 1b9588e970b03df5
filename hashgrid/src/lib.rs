//! Multiresolution hash encoding (Müller, Evans, Schied, Keller: *Instant Neural Graphics
//! Primitives with a Multiresolution Hash Encoding*, 2022) in 2, 3 or 4 dimensions, with its
//! backward passes written by hand.
//!
//! L grids of growing resolution cover the unit cube; every grid corner has F learnable features,
//! which are interpolated d-linearly at a point. Levels with more corners than table rows share
//! rows by a spatial hash.
//!
//! ```
//! use hashgrid::{HashGrid, HashGridConfig};
//!
//! let config = HashGridConfig { levels: 8, features: 2, log2_table_size: 14, n_min: 4, n_max: 256 };
//! let grid = HashGrid::<3>::new(&config)?;
//! let table = grid.init_table(7);
//!
//! let points = [[0.1, 0.2, 0.3], [0.9, 0.5, 1.0]];
//! let mut features = vec![0.0; points.len() * grid.num_features()];
//! grid.encode(&table, &points, &mut features);
//!
//! // L = Σ features² / 2, so that d_features = features.
//! let mut d_table = vec![0.0; grid.num_parameters()];
//! grid.encode_backward(&points, &features, &mut d_table);
//! # Ok::<(), hashgrid::Error>(())
//! ```
//!
//! # Conventions
//!
//! * Level l has N_l cells per axis; p = x · N_l, cell c = min(⌊p⌋, N_l − 1), corners c and c + 1,
//!   so x = 1 is inside the last cell.
//! * Where (N_l + 1)^D corners fit the 2^T rows, corner c has row Σ_j c_j (N_l + 1)^j (*dense*);
//!   else (⊕_j c_j · π_j) mod 2^T in wrapping `u32`, π = 1, 2654435761, 805459861, 3674653429
//!   (*hashed*).
//! * Coordinates are clamped to \[0, 1\]; NaN counts as 0. Neither gets a gradient.
//! * The table is one flat slice owned by the caller, level after level; a dense level has only its
//!   (N_l + 1)^D rows. [`HashGrid::level_range`] gives the range of a level.
//! * Features are (L, Q, F): levels, points, features per level. [`Layout`] converts them to and
//!   from one row per point.
//! * `encode` overwrites its output; the backward passes add to theirs.
//! * Results do not depend on the number of threads, bit for bit.

mod backward;
mod backward_points;
mod config;
mod corners;
mod encode;
mod grid;
mod layout;
mod simd;

/// The README's examples, compiled as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use config::{Error, HashGridConfig, MAX_RESOLUTION};
pub use grid::HashGrid;
pub use layout::Layout;
