//! Where the files of a capture go, and its pictures and matrices as files hold them.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{Affine3A, Mat3, Vec3};
use image::{GrayImage, ImageFormat, RgbImage};
use rayon::prelude::*;
use smpl::{BodyModel, Placement};

use capture::{CaptureError, Frame, Image};

/// The body model's file in a written capture.
pub const BODY: &str = "body.safetensors";

/// Where files go.
pub(super) struct Folder<'a> {
    pub dir: &'a Path,
    pub progress: &'a (dyn Fn(usize) + Sync),
    pub written: AtomicUsize,
}

impl<'a> Folder<'a> {
    /// Makes the folder, with the body model in it.
    pub fn new(dir: &'a Path, body: &BodyModel, progress: &'a (dyn Fn(usize) + Sync)) -> Result<Self, CaptureError> {
        let folder = Self { dir, progress, written: AtomicUsize::new(0) };
        folder.make("")?;
        body.save(&dir.join(BODY))?;
        Ok(folder)
    }

    pub fn make(&self, below: &str) -> Result<PathBuf, CaptureError> {
        let path = self.dir.join(below);
        std::fs::create_dir_all(&path).map_err(CaptureError::io(&path))?;
        Ok(path)
    }

    pub fn file(&self, name: &str, bytes: impl AsRef<[u8]>) -> Result<(), CaptureError> {
        let path = self.dir.join(name);
        std::fs::write(&path, bytes).map_err(CaptureError::io(&path))
    }

    /// Writes pictures side by side; `paint` gives each by its index.
    pub fn pictures<P: Into<image::DynamicImage>>(
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
            (self.progress)(self.written.fetch_add(1, Ordering::Relaxed) + 1);
            Ok(())
        };
        // Collected as results first, so that the error reported is the first in order whatever
        // finishes first.
        let saved: Vec<Result<(), CaptureError>> = names.par_iter().enumerate().map(save).collect();
        saved.into_iter().collect()
    }
}

pub(super) fn rgb(image: &Image) -> RgbImage {
    RgbImage::from_fn(image.width, image.height, |x, y| image::Rgb(image.rgb(x, y).map(byte)))
}

/// Colours as they are without what they were mixed with at edges, for readers that multiply by the
/// mask.
pub(super) fn unmixed(image: &Image, mask: &[f32]) -> RgbImage {
    let mut whole = image.clone();
    for (pixel, &coverage) in whole.pixels.chunks_exact_mut(3).zip(mask).filter(|(_, m)| **m > 0.0) {
        pixel.iter_mut().for_each(|c| *c /= coverage);
    }
    rgb(&whole)
}

/// Nearest of 256 levels, the lower of two: one half stays below the middle, as readers tell
/// subject from background.
pub(super) fn byte(value: f32) -> u8 {
    (value * 255.0 - 0.5).ceil().clamp(0.0, 255.0) as u8
}

/// Levels of a mask of the size of `like`.
pub(super) fn grey(mask: &[f32], like: &Image) -> GrayImage {
    GrayImage::from_fn(like.width, like.height, |x, y| image::Luma([byte(mask[(y * like.width + x) as usize])]))
}

pub(super) fn mask_rgb(mask: &[f32], like: &Image) -> RgbImage {
    image::DynamicImage::ImageLuma8(grey(mask, like)).into_rgb8()
}

/// The mask of a frame's visible subject.
pub(super) fn frame_mask(frame: &Frame) -> Result<RgbImage, CaptureError> {
    frame.pixels().map(|pixels| mask_rgb(&pixels.mask, &pixels.image))
}

/// A matrix row by row.
pub(super) fn rows(matrix: Mat3) -> [f32; 9] {
    matrix.transpose().to_cols_array()
}

/// Extrinsics (4, 4) row by row.
pub(super) fn extrinsics(world_to_camera: &Affine3A) -> [f32; 16] {
    glam::Mat4::from(*world_to_camera).transpose().to_cols_array()
}

pub(super) fn flat(points: &[Vec3]) -> Vec<f32> {
    points.iter().flat_map(|p| p.to_array()).collect()
}

/// Rotation and translation about the origin, as ZJU-MoCap has them. Synthetic frames are placed
/// so.
pub(super) fn origin(frame: &Frame) -> (Vec3, Vec3) {
    match frame.placement {
        Placement::Origin { rotation, translation } => (rotation, translation),
        Placement::Pelvis { translation } => (Vec3::ZERO, translation),
    }
}
