//! The files of a frame: header checks and decoding.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use array_files::{decode_text, read_bounded};

use super::camera::Lens;
use super::gate::Gate;
use super::image::{dimensions, load_mask, resize};
use super::pixels::{Area, Pixels};
use super::undistort::undistort;
use super::{CaptureError, Image};

/// The files of a frame.
#[derive(Clone, Debug)]
pub(super) struct FrameFiles {
    pub image: PathBuf,
    /// The subject is their union; at least one.
    pub masks: Vec<PathBuf>,
    /// Whether masks hold part labels, with background 0, instead of coverage.
    pub labels: bool,
    pub occluder: Option<PathBuf>,
    /// Simulated obstacle, in pixels of the files.
    pub hidden: Option<Area>,
    pub lens: Lens,
}

/// The files of a frame, and parameters of decoding.
#[derive(Clone, Debug)]
pub(super) struct Files {
    pub of: FrameFiles,
    /// Width and height of every file, and after resizing.
    pub size: (u32, u32),
    pub to: (u32, u32),
    /// Name of the frame with `size`.
    pub first: Arc<str>,
    /// Memory limit of concurrent decoding.
    pub gate: Arc<Gate>,
}

/// Peak bytes per pixel of a file during decoding: integers and floats of picture and masks,
/// undistorted and resized.
const DECODED_BYTES: u64 = 48;

/// Bytes for decoding a picture of this width and height.
pub(super) fn decoding_bytes((width, height): (u32, u32)) -> u64 {
    u64::from(width) * u64::from(height) * DECODED_BYTES
}

/// Reads a text file of at most `most` bytes, of any encoding of [`decode_text`].
pub(super) fn read_text(path: &Path, most: u64) -> Result<String, CaptureError> {
    let text = decode_text(&read_bounded(path, most).map_err(CaptureError::io(path))?);
    match text.contains(char::REPLACEMENT_CHARACTER) {
        true => Err(CaptureError::invalid(path, "encoding", "UTF-8, or UTF-16 with its mark", "other bytes")),
        false => Ok(text),
    }
}

impl Files {
    /// The camera at the size of the files.
    pub fn camera(&self) -> volrender::Camera {
        volrender::Camera { width: self.size.0, height: self.size.1, ..self.of.lens.camera }
    }

    /// The files with a simulated obstacle over an area of the decoded pixels.
    pub fn hidden_behind(&self, area: &Area) -> Self {
        let scaled = |range: &Range<u32>, from: u32, to: u32| {
            let scale = f64::from(to) / f64::from(from.max(1));
            let at = |n: u32| (f64::from(n) * scale).round() as u32;
            at(range.start)..at(range.end)
        };
        let columns = scaled(&area.columns, self.to.0, self.size.0);
        let rows = scaled(&area.rows, self.to.1, self.size.1);
        let of = FrameFiles { hidden: Some(Area { columns, rows }), ..self.of.clone() };
        Self { of, ..self.clone() }
    }

    /// Checks the sizes in the headers against the memory budget's.
    pub fn check(&self) -> Result<(), CaptureError> {
        self.same_size(&self.of.image, dimensions(&self.of.image)?)?;
        self.of.masks.iter().chain(&self.of.occluder).try_for_each(|path| self.same_size(path, dimensions(path)?))
    }

    fn same_size(&self, path: &Path, found: (u32, u32)) -> Result<(), CaptureError> {
        if found == self.size {
            return Ok(());
        }
        let text = |(w, h): (u32, u32)| format!("{w}×{h}");
        let of = if path == self.of.image { format!("`{}`", self.first) } else { "its image".to_owned() };
        Err(CaptureError::invalid(path, "size", format!("{}, as of {of}", text(self.size)), text(found)))
    }

    /// A mask; its size is checked again.
    fn mask(&self, path: &Path) -> Result<Vec<f32>, CaptureError> {
        let (width, height, levels) = load_mask(path)?;
        self.same_size(path, (width, height)).map(|()| levels)
    }

    /// The unmasked picture at the size of the pixels.
    pub fn photograph(&self) -> Result<Image, CaptureError> {
        self.gate.pass(decoding_bytes(self.size), || {
            let image = Image::load(&self.of.image)?;
            self.same_size(&self.of.image, (image.width, image.height))?;
            let whole = undistort(image.pixels, 3, &self.camera(), &self.of.lens.distortion);
            Ok(Image { width: self.to.0, height: self.to.1, pixels: resize(whole, 3, self.size, self.to) })
        })
    }

    /// Decodes the pictures within the memory limit.
    pub fn decode(&self) -> Result<Pixels, CaptureError> {
        self.check()?;
        self.gate.pass(decoding_bytes(self.size), || self.decode_now())
    }

    fn decode_now(&self) -> Result<Pixels, CaptureError> {
        let size = self.size;
        let mut image = Image::load(&self.of.image)?;
        self.same_size(&self.of.image, (image.width, image.height))?;
        let mut mask = vec![0.0f32; size.0 as usize * size.1 as usize];
        for path in &self.of.masks {
            for (out, level) in mask.iter_mut().zip(self.mask(path)?) {
                let level = if self.of.labels && level > 0.0 { 1.0 } else { level };
                *out = out.max(level);
            }
        }
        if let Some(Area { columns, rows }) = &self.of.hidden {
            let columns = columns.start.min(size.0) as usize..columns.end.min(size.0) as usize;
            let rows = (rows.start as usize, rows.end as usize);
            for row in mask.chunks_exact_mut(size.0 as usize).take(rows.1).skip(rows.0) {
                row[columns.clone()].fill(0.0);
            }
        }
        let occluder = match &self.of.occluder {
            Some(path) => Some(self.mask(path)?.into_iter().map(|level| f32::from(level > 0.5)).collect()),
            None => None,
        };
        // Masked first, since interpolation would mix hidden colours into the mask's edge.
        image.multiply(&mask);

        let (camera, distortion) = (self.camera(), self.of.lens.distortion);
        let to = self.to;
        let resample = |values: Vec<f32>, channels: usize| {
            resize(undistort(values, channels, &camera, &distortion), channels, size, to)
        };
        let occluder = occluder.map(|covered: Vec<f32>| {
            let everything = (!distortion.is_identity()).then(|| vec![1.0; covered.len()]);
            // A pixel touched by an occluder is unknown,
            let mut unknown: Vec<bool> = resample(covered, 1).into_iter().map(|covered| covered > 0.0).collect();
            if let Some(everything) = everything {
                // and so is one outside the distorted image.
                unknown.iter_mut().zip(resample(everything, 1)).for_each(|(unknown, seen)| *unknown |= seen < 0.5);
            }
            unknown
        });
        let image = Image { width: to.0, height: to.1, pixels: resample(image.pixels, 3) };
        Ok(Pixels { image, mask: resample(mask, 1), occluder })
    }
}
