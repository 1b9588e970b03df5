//! From a list of files to frames: the part that all layouts share.

use std::path::{Path, PathBuf};

use glam::Vec3;
use rayon::prelude::*;
use smpl::{BodyModel, Placement};

use super::camera::Lens;
use super::image::{dimensions, load_mask, resize};
use super::undistort::undistort;
use super::{DataError, Frame, Image, LoadOptions, checks};

/// Bytes that a pixel of a frame takes: three colours and coverage.
const PIXEL_BYTES: u64 = 16;

/// A frame whose pictures have not been read.
pub(super) struct Planned {
    pub name: String,
    pub image: PathBuf,
    /// The subject is where any of these says so; at least one.
    pub masks: Vec<PathBuf>,
    /// Masks hold labels, each but 0 a part of the subject, rather than coverage with 255 for all.
    pub labels: bool,
    pub occluder: Option<PathBuf>,
    /// Columns and rows from the first pair to below the second that something covers.
    pub hidden: Option<[(u32, u32); 2]>,
    pub lens: Lens,
    pub pose: Vec<Vec3>,
    pub placement: Placement,
    pub betas: Vec<f32>,
}

/// The frames of one camera, all of one size.
pub(super) struct View {
    frames: Vec<Planned>,
    size: (u32, u32),
    /// Named where no mask shows the subject, and where no camera sees the body.
    masks: PathBuf,
    cameras: PathBuf,
}

impl View {
    /// `masks` and `cameras` are named in errors about all frames. There must be a frame.
    pub fn new(frames: Vec<Planned>, masks: &Path, cameras: &Path) -> Result<Self, DataError> {
        let first = frames.first().ok_or_else(|| DataError::invalid(cameras, "all frames", "a frame", "none"))?;
        let size = dimensions(&first.image)?;
        Ok(Self { frames, size, masks: masks.to_owned(), cameras: cameras.to_owned() })
    }

    fn bytes(&self, options: &LoadOptions) -> u64 {
        let (width, height) = options.resized(self.size);
        self.frames.len() as u64 * u64::from(width) * u64::from(height) * PIXEL_BYTES
    }

    /// Reads the pictures and checks them together.
    pub fn decode(self, body: &BodyModel, options: &LoadOptions) -> Result<Vec<Frame>, DataError> {
        let first = self.frames[0].name.clone();
        // Collected as results first, so that the error reported is the first in order whatever finishes first.
        let frames: Vec<_> = self.frames.into_par_iter().map(|f| decode(f, self.size, &first, options)).collect();
        let frames: Vec<Frame> = frames.into_iter().collect::<Result<_, _>>()?;
        checks::subject_is_seen(&self.masks, &frames)?;
        checks::body_is_seen(&self.cameras, &frames, body)?;
        Ok(frames)
    }
}

/// Errors where the pixels of all views would take more than [`LoadOptions::max_bytes`], naming values that fit.
pub(super) fn check_memory(train: &View, eval: &[View], options: &LoadOptions) -> Result<(), DataError> {
    let (train_bytes, limit) = (train.bytes(options), options.max_bytes);
    let total = train_bytes + eval.iter().map(|view| view.bytes(options)).sum::<u64>();
    if total <= limit {
        return Ok(());
    }
    let longest = |view: &View| options.resized(view.size);
    let side = std::iter::once(train).chain(eval).map(longest).map(|(w, h)| w.max(h)).max().unwrap_or(1);
    let resize = (f64::from(side) * (limit as f64 / total as f64).sqrt()).floor();
    let mut ways = Vec::new();
    if resize >= 1.0 {
        ways.push(format!("resize {resize}"));
    }
    ways.push(format!("stride {}", total.div_ceil(limit.max(1)).saturating_mul(options.stride as u64)));
    if train_bytes < limit {
        let every = (total - train_bytes).div_ceil(limit - train_bytes);
        ways.push(format!("eval_stride {}", every.saturating_mul(options.eval_stride as u64)));
    }
    let mebibytes = |bytes: u64| bytes.div_ceil(1 << 20);
    ways.push(format!("memory {}", mebibytes(total)));
    let kept = eval.iter().map(|view| view.frames.len()).sum::<usize>();
    Err(DataError::setting(
        "max_bytes",
        format!("pixels of at most {} MiB (would fit: {})", mebibytes(limit), ways.join(", or ")),
        format!("{} MiB in {} training frames and {kept} views kept back", mebibytes(total), train.frames.len()),
    ))
}

fn decode(plan: Planned, size: (u32, u32), first: &str, options: &LoadOptions) -> Result<Frame, DataError> {
    let same_size = |path: &Path, found: (u32, u32), of: &str| {
        let text = |(w, h): (u32, u32)| format!("{w}×{h}");
        let expected = || format!("{}, as of {of}", text(size));
        if found == size { Ok(()) } else { Err(DataError::invalid(path, "size", expected(), text(found))) }
    };
    // Headers before pictures: nothing is decoded that the memory check did not count.
    same_size(&plan.image, dimensions(&plan.image)?, &format!("`{first}`"))?;
    for path in plan.masks.iter().chain(&plan.occluder) {
        same_size(path, dimensions(path)?, "its image")?;
    }
    let mut image = Image::load(&plan.image)?;
    let mut mask = vec![0.0f32; size.0 as usize * size.1 as usize];
    for path in &plan.masks {
        for (out, level) in mask.iter_mut().zip(load_mask(path)?.2) {
            let level = if plan.labels && level > 0.0 { 1.0 } else { level };
            *out = out.max(level);
        }
    }
    if let Some([(x0, y0), (x1, y1)]) = plan.hidden {
        let columns = x0.min(size.0) as usize..x1.min(size.0) as usize;
        for row in mask.chunks_exact_mut(size.0 as usize).take(y1 as usize).skip(y0 as usize) {
            row[columns.clone()].fill(0.0);
        }
    }
    let occluder = match &plan.occluder {
        Some(path) => Some(load_mask(path)?.2.into_iter().map(|level| f32::from(level > 0.5)).collect()),
        None => None,
    };
    // Masked first, or interpolation would draw hidden colours into the mask's edge.
    image.multiply(&mask);

    let Lens { camera, distortion } = plan.lens;
    let camera = volrender::Camera { width: size.0, height: size.1, ..camera };
    let to = options.resized(size);
    let resample = |values: Vec<f32>, channels: usize| {
        resize(undistort(values, channels, &camera, &distortion), channels, size, to)
    };
    // Without known occluders the silhouette tells what is unknown.
    let occluder = occluder.map(|covered: Vec<f32>| {
        let everything = (!distortion.is_none()).then(|| vec![1.0; covered.len()]);
        // A pixel that an occluder touches is not known to show background.
        let mut unknown: Vec<bool> = resample(covered, 1).into_iter().map(|covered| covered > 0.0).collect();
        if let Some(everything) = everything {
            // Nor is one that the lens never saw.
            unknown.iter_mut().zip(resample(everything, 1)).for_each(|(unknown, seen)| *unknown |= seen < 0.5);
        }
        unknown
    });
    Ok(Frame {
        name: plan.name,
        image: Image { width: to.0, height: to.1, pixels: resample(image.pixels, 3) },
        mask: resample(mask, 1),
        camera: camera.resized(to.0, to.1),
        pose: plan.pose,
        placement: plan.placement,
        betas: plan.betas,
        occluder,
    })
}
