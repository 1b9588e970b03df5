//! Synthetic captures on disk, in the layouts that the loaders read.

mod humannerf;
pub(super) mod pickle;
#[cfg(test)]
mod tests;
mod wild;
mod zju;

use std::path::{Path, PathBuf};

use glam::{Affine3A, Mat3, Vec3};
use image::{GrayImage, ImageFormat, RgbImage};
use rayon::prelude::*;
use smpl::Placement;

use self::pickle::Py;
use super::synth::Synthetic;
use super::{CaptureError, Frame, Image, Layout};

/// The body model's file, found by [`super::find_body`].
const BODY: &str = "body.safetensors";

impl Synthetic {
    /// Writes the capture into `dir`, which is made if it is not there, for [`super::load_capture`] to read, with the body model
    /// as `body.safetensors`.
    ///
    /// What a rectangle hides is black in HumanNeRF's layouts and 0 in their masks; raw ZJU-MoCap gets clean pictures and
    /// an `occlusion.json`, as its occlusion is simulated by those who read it. Objects are in the pictures, before a
    /// room; the wild layout says where, in `occluders`. It holds back clean pictures by the training camera, every
    /// `eval_every`-th; the others hold back the other cameras. `progress` is called with the number of pictures written.
    ///
    /// # Errors
    /// [`CaptureError::Io`], [`CaptureError::Picture`], [`CaptureError::Array`]. What has been written by then stays.
    pub fn write(&self, dir: &Path, layout: Layout, progress: &(dyn Fn(usize) + Sync)) -> Result<(), CaptureError> {
        let folder = Folder { dir, progress, written: std::sync::atomic::AtomicUsize::new(0) };
        folder.make("")?;
        self.body.save(&dir.join(BODY))?;
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
        let clear = &self.clear[i];
        if let Some(objects) = &self.objects {
            return Ok(rgb(&objects.photograph(clear, occluded)));
        }
        if occluded {
            let pixels = self.capture.train[i].pixels()?;
            return Ok(unmixed(&pixels.image, &pixels.mask));
        }
        Ok(unmixed(&clear.0, &clear.1))
    }
}

/// Where files go.
struct Folder<'a> {
    dir: &'a Path,
    progress: &'a (dyn Fn(usize) + Sync),
    written: std::sync::atomic::AtomicUsize,
}

impl Folder<'_> {
    fn make(&self, below: &str) -> Result<PathBuf, CaptureError> {
        let path = self.dir.join(below);
        std::fs::create_dir_all(&path).map_err(CaptureError::io(&path))?;
        Ok(path)
    }

    fn file(&self, name: &str, bytes: impl AsRef<[u8]>) -> Result<(), CaptureError> {
        let path = self.dir.join(name);
        std::fs::write(&path, bytes).map_err(CaptureError::io(&path))
    }

    /// Writes pictures side by side; `paint` gives each by its index.
    fn pictures<P: Into<image::DynamicImage>>(
        &self,
        names: &[String],
        paint: impl Fn(usize) -> Result<P, CaptureError> + Sync,
    ) -> Result<(), CaptureError> {
        let save = |(i, name): (usize, &String)| {
            let path = self.dir.join(name);
            let picture: image::DynamicImage = paint(i)?.into();
            picture.save_with_format(&path, ImageFormat::Png).map_err(|source| match source {
                image::ImageError::IoError(source) => CaptureError::Io { path, source },
                source => CaptureError::Picture { path, source },
            })?;
            (self.progress)(self.written.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1);
            Ok(())
        };
        // Collected as results first, so that the error reported is the first in order whatever finishes first.
        let saved: Vec<Result<(), CaptureError>> = names.par_iter().enumerate().map(save).collect();
        saved.into_iter().collect()
    }
}

fn rgb(image: &Image) -> RgbImage {
    RgbImage::from_fn(image.width, image.height, |x, y| image::Rgb(image.rgb(x, y).map(byte)))
}

/// Colours as they are without what they were mixed with at edges, for readers that multiply by the mask.
fn unmixed(image: &Image, mask: &[f32]) -> RgbImage {
    let mut whole = image.clone();
    for (pixel, &coverage) in whole.pixels.chunks_exact_mut(3).zip(mask).filter(|(_, m)| **m > 0.0) {
        pixel.iter_mut().for_each(|c| *c /= coverage);
    }
    rgb(&whole)
}

/// Nearest of 256 levels, the lower of two: one half stays below the middle, as readers tell subject from background.
fn byte(value: f32) -> u8 {
    (value * 255.0 - 0.5).ceil().clamp(0.0, 255.0) as u8
}

/// Levels of a mask of the size of `like`.
fn grey(mask: &[f32], like: &Image) -> GrayImage {
    GrayImage::from_fn(like.width, like.height, |x, y| image::Luma([byte(mask[(y * like.width + x) as usize])]))
}

fn mask_rgb(mask: &[f32], like: &Image) -> RgbImage {
    image::DynamicImage::ImageLuma8(grey(mask, like)).into_rgb8()
}

/// The mask of a frame's visible subject.
fn frame_mask(frame: &Frame) -> Result<RgbImage, CaptureError> {
    frame.pixels().map(|pixels| mask_rgb(&pixels.mask, &pixels.image))
}

/// A matrix row by row.
fn rows(matrix: Mat3) -> [f32; 9] {
    matrix.transpose().to_cols_array()
}

/// Extrinsics (4, 4) row by row.
fn extrinsics(world_to_camera: &Affine3A) -> [f32; 16] {
    glam::Mat4::from(*world_to_camera).transpose().to_cols_array()
}

fn flat(points: &[Vec3]) -> Vec<f32> {
    points.iter().flat_map(|p| p.to_array()).collect()
}

/// Rotation and translation about the origin, as ZJU-MoCap has them. Synthetic frames are placed so.
fn origin(frame: &Frame) -> (Vec3, Vec3) {
    match frame.placement {
        Placement::Origin { rotation, translation } => (rotation, translation),
        Placement::Pelvis { translation } => (Vec3::ZERO, translation),
    }
}
