//! A person as a skinned, textured mesh: baked from a trained field, or fitted to the frames.

mod avatar;
mod charts;
mod displacement;
mod draw;
pub mod export;
mod field;
mod make;
mod motion;
mod paint;
mod refine;
mod renderer;
mod saved;
mod skeleton;
mod surface;
#[cfg(test)]
mod tests;

use std::io::Write;
use std::path::Path;

use crate::Error;

pub use avatar::{Atlas, Avatar, Clip, Joint, MAX_ATLAS_SIDE, MAX_JOINTS};
pub use draw::BakedPerson;
pub use make::{BakeOptions, BakeReport, bake, fit};
pub use motion::{motion_of_bones, turn_upright};
pub use renderer::BakedRenderer;
pub use skeleton::skeleton;
pub use surface::SurfaceReport;

/// Replaces a file atomically.
fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    crate::replace_file(path, |to| to.write_all(bytes)).map_err(|source| Error::Io { path: path.to_owned(), source })
}
