//! The files of a frame, checked by their headers and decoded to pixels.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::camera::Lens;
use super::gate::Gate;
use super::image::{dimensions, load_mask, resize};
use super::pixels::{Area, Pixels};
use super::undistort::undistort;
use super::{CaptureError, Image};

/// The files of a frame, and how they become its pixels.
#[derive(Clone, Debug)]
pub(super) struct Files {
    pub image: PathBuf,
    /// The subject is where any of these says so; at least one.
    pub masks: Vec<PathBuf>,
    /// Masks hold labels, each but 0 a part of the subject, rather than coverage with 255 for all.
    pub labels: bool,
    pub occluder: Option<PathBuf>,
    /// Pixels of the files that a simulated obstacle hides.
    pub hidden: Option<Area>,
    pub lens: Lens,
    /// Columns and rows of every file, and what they are reduced to.
    pub size: (u32, u32),
    pub to: (u32, u32),
    /// Name of the frame that `size` was read from.
    pub first: Arc<str>,
    /// Lets as many decode at once as there is memory for.
    pub gate: Arc<Gate>,
}

/// Bytes that a pixel of a file takes while it is decoded, at the worst: picture and masks as they
/// come out of the file and in floats, rectified and reduced.
const DECODED_BYTES: u64 = 48;

/// Bytes that decoding a picture of so many columns and rows takes.
pub(super) fn decoding_bytes((width, height): (u32, u32)) -> u64 {
    u64::from(width) * u64::from(height) * DECODED_BYTES
}

impl Files {
    /// The same files behind an obstacle over an area of the decoded pixels.
    pub fn hidden_behind(&self, area: &Area) -> Self {
        let scaled = |range: &Range<u32>, from: u32, to: u32| {
            let scale = f64::from(to) / f64::from(from.max(1));
            let at = |n: u32| (f64::from(n) * scale).round() as u32;
            at(range.start)..at(range.end)
        };
        let columns = scaled(&area.columns, self.to.0, self.size.0);
        let rows = scaled(&area.rows, self.to.1, self.size.1);
        Self { hidden: Some(Area { columns, rows }), ..self.clone() }
    }

    /// Whether the headers say what they should; nothing is decoded that the memory check did not
    /// count.
    pub fn check(&self) -> Result<(), CaptureError> {
        self.same_size(&self.image, dimensions(&self.image)?)?;
        self.masks.iter().chain(&self.occluder).try_for_each(|path| self.same_size(path, dimensions(path)?))
    }

    fn same_size(&self, path: &Path, found: (u32, u32)) -> Result<(), CaptureError> {
        if found == self.size {
            return Ok(());
        }
        let text = |(w, h): (u32, u32)| format!("{w}×{h}");
        let of = if path == self.image { format!("`{}`", self.first) } else { "its image".to_owned() };
        Err(CaptureError::invalid(path, "size", format!("{}, as of {of}", text(self.size)), text(found)))
    }

    /// A mask, which may have changed since its header was read.
    fn mask(&self, path: &Path) -> Result<Vec<f32>, CaptureError> {
        let (width, height, levels) = load_mask(path)?;
        self.same_size(path, (width, height)).map(|()| levels)
    }

    /// The picture without its mask, as large as the pixels are.
    pub fn photograph(&self) -> Result<Image, CaptureError> {
        self.gate.pass(decoding_bytes(self.size), || {
            let image = Image::load(&self.image)?;
            self.same_size(&self.image, (image.width, image.height))?;
            let camera = volrender::Camera { width: self.size.0, height: self.size.1, ..self.lens.camera };
            let whole = undistort(image.pixels, 3, &camera, &self.lens.distortion);
            Ok(Image { width: self.to.0, height: self.to.1, pixels: resize(whole, 3, self.size, self.to) })
        })
    }

    /// Reads the pictures, when there is room for it.
    pub fn decode(&self) -> Result<Pixels, CaptureError> {
        self.check()?;
        self.gate.pass(decoding_bytes(self.size), || self.decode_now())
    }

    fn decode_now(&self) -> Result<Pixels, CaptureError> {
        let size = self.size;
        let mut image = Image::load(&self.image)?;
        self.same_size(&self.image, (image.width, image.height))?;
        let mut mask = vec![0.0f32; size.0 as usize * size.1 as usize];
        for path in &self.masks {
            for (out, level) in mask.iter_mut().zip(self.mask(path)?) {
                let level = if self.labels && level > 0.0 { 1.0 } else { level };
                *out = out.max(level);
            }
        }
        if let Some(Area { columns, rows }) = &self.hidden {
            let columns = columns.start.min(size.0) as usize..columns.end.min(size.0) as usize;
            let rows = (rows.start as usize, rows.end as usize);
            for row in mask.chunks_exact_mut(size.0 as usize).take(rows.1).skip(rows.0) {
                row[columns.clone()].fill(0.0);
            }
        }
        let occluder = match &self.occluder {
            Some(path) => Some(self.mask(path)?.into_iter().map(|level| f32::from(level > 0.5)).collect()),
            None => None,
        };
        // Masked first, or interpolation would draw hidden colours into the mask's edge.
        image.multiply(&mask);

        let Lens { camera, distortion } = self.lens;
        let camera = volrender::Camera { width: size.0, height: size.1, ..camera };
        let to = self.to;
        let resample = |values: Vec<f32>, channels: usize| {
            resize(undistort(values, channels, &camera, &distortion), channels, size, to)
        };
        // Without known occluders the silhouette tells what is unknown.
        let occluder = occluder.map(|covered: Vec<f32>| {
            let everything = (!distortion.is_identity()).then(|| vec![1.0; covered.len()]);
            // A pixel that an occluder touches is not known to show background.
            let mut unknown: Vec<bool> = resample(covered, 1).into_iter().map(|covered| covered > 0.0).collect();
            if let Some(everything) = everything {
                // Nor is one that the lens never saw.
                unknown.iter_mut().zip(resample(everything, 1)).for_each(|(unknown, seen)| *unknown |= seen < 0.5);
            }
            unknown
        });
        let image = Image { width: to.0, height: to.1, pixels: resample(image.pixels, 3) };
        Ok(Pixels { image, mask: resample(mask, 1), occluder })
    }
}
