//! Readers of the files in which Python programs keep arrays: numpy's `.npy` and `.npz`, pickles,
//! joblib's compressed pickles and PyTorch's `torch.save`; a writer of `.npz`; safetensors, both
//! ways; and what every file needs, bounded reading and atomic replacement.
//!
//! ```
//! use array_files::npz::{self, Npz};
//! use array_files::{Data, NdArray};
//!
//! let path = std::env::temp_dir().join("array-files-lib.npz");
//! let poses = NdArray { shape: vec![2, 3], data: Data::F32(vec![0.0, 0.1, 0.2, 0.3, 0.4, 0.5]) };
//! npz::write(&path, &[("poses", poses)])?;
//!
//! let mut archive = Npz::open(&path)?;
//! assert_eq!(archive.keys(), ["poses"]);
//! let (shape, values) = archive.f32("poses", &[None, Some(3)])?; // any number of rows of 3
//! assert_eq!((shape, values[5]), (vec![2, 3], 0.5));
//! # std::fs::remove_file(&path).unwrap();
//! # Ok::<(), array_files::Error>(())
//! ```
//!
//! # Conventions
//! - Arrays are row-major whatever order or strides the file has. Element types are widened to
//!   the four of [`Data`].
//! - A pickle is data: constructors of arrays and containers are on an allow-list, every other
//!   global is an error, and nothing is executed.
//! - Sizes in headers are not trusted: memory is bounded by the bytes of the file and by the limits
//!   stated at each reader.
//! - Errors name the file, the array and, for pickles, the offset of the opcode. Readers of bytes
//!   in memory take a name to be used as the file's.

mod array;
mod element;
mod error;
mod file;
mod npy;
pub mod npz;
pub mod pickle;
pub mod tensors;
pub mod torch;

/// The README's example, compiled as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use array::{Data, NdArray};
pub use element::half_to_f32;
pub use error::Error;
pub use file::{decode_text, read_bounded, read_file, replace_file, sweep};
