//! A person as a skinned, textured mesh: baked from a trained field, or fitted to the frames.

mod avatar;
mod charts;
mod displacement;
mod draw;
pub mod export;
mod make;
mod refine;
mod saved;
mod simplify;
mod skirt;
mod surface;
#[cfg(test)]
mod tests;

use std::io::Write;
use std::path::Path;

use crate::Error;

pub use avatar::{Atlas, Avatar, Clip, MAX_ATLAS_SIDE, MAX_JOINTS};
use avatar::{motion_of_bones, turn_upright};
pub use draw::BakedRenderer;
pub use make::{BakeReport, bake, fit};
pub use skirt::skirted;
pub use smpl::Joint;

/// Replaces a file atomically.
fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    crate::replace_file(path, |to| to.write_all(bytes)).map_err(|source| Error::Io { path: path.to_owned(), source })
}
