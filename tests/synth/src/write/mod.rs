//! Synthetic captures on disk, in the layouts that the loaders read.

mod folder;
mod humannerf;
pub(super) mod pickle;
#[cfg(test)]
mod tests;
mod wild;
mod zju;

use std::path::Path;

use image::RgbImage;

pub use self::folder::BODY;
use self::folder::{Folder, rgb, unmixed};
use crate::film::Synthetic;
use capture::{CaptureError, Layout};

impl Synthetic {
    /// Writes the capture into `dir`, which is made if it is not there, for `capture::load_capture`
    /// to read, with the body model as `body.safetensors`.
    ///
    /// What a rectangle hides is black in HumanNeRF's layouts and 0 in their masks; raw ZJU-MoCap
    /// gets clean pictures and an `occlusion.json`, as its occlusion is simulated by those who read
    /// it. Objects are in the pictures, before a room; the wild layout says where, in `occluders`.
    /// It holds back clean pictures by the training camera, every `eval_every`-th; the others hold
    /// back the other cameras. `progress` is called with the number of pictures written.
    ///
    /// # Errors
    /// [`CaptureError::Io`], [`CaptureError::Picture`], [`CaptureError::Array`]. What has been
    /// written by then stays.
    pub fn write(&self, dir: &Path, layout: Layout, progress: &(dyn Fn(usize) + Sync)) -> Result<(), CaptureError> {
        let folder = Folder::new(dir, &self.body, progress)?;
        match layout {
            Layout::HumanNerf => humannerf::write(self, &folder),
            Layout::ZjuMocap => zju::write(self, &folder),
            Layout::Wild => wild::write(self, &folder),
        }
    }

    /// How many pictures [`Synthetic::write`] writes.
    #[must_use]
    pub fn num_pictures(&self, layout: Layout) -> usize {
        let (train, eval) = (self.capture.train.len(), self.capture.eval.len());
        match layout {
            Layout::HumanNerf => 2 * (train + eval),
            Layout::ZjuMocap => 3 * (train + eval),
            Layout::Wild => 3 * train + 2 * train.div_ceil(self.config.eval_every),
        }
    }

    /// What a camera takes of training frame `i`.
    fn photograph(&self, i: usize, occluded: bool) -> Result<RgbImage, CaptureError> {
        if let Some(objects) = &self.objects {
            return Ok(rgb(&objects.photograph(&self.clear[i].pixels()?, occluded)));
        }
        let pixels = if occluded { self.capture.train[i].pixels() } else { self.clear[i].pixels() }?;
        Ok(unmixed(&pixels.image, &pixels.mask))
    }
}
