//! Validation of a fit before training.
//!
//! [`check`] compares the posed body's silhouette with the mask of every frame, detects temporal
//! outliers, and diagnoses common convention errors ([`Mistake`]) by undoing them.

mod faults;
mod mistakes;
#[cfg(test)]
mod tests;

pub use self::faults::{Fault, Limb};
pub use self::mistakes::Mistake;

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use smpl::BodyModel;
use visibility::{RayMesh, visible_vertices};
use volrender::Camera;

use self::faults::{Part, View};
use self::mistakes::{Overlap, posed};
use crate::capture::{Capture, CaptureError, Frame, Image, Pixels};
use crate::config::OccludedRule;
use crate::error::Error;
use crate::model::view::{pinhole, silhouette};
use crate::scene::labels::{Label, label_pixels};

/// Longest side of downsampled frames, pixels.
const SIDE: u32 = 192;
/// Most frames for detecting mistakes, and for the visible share of the surface.
const VIEWS: usize = 48;
const SURFACE_VIEWS: usize = 32;
/// Least overlap of a frame.
const LEAST_IOU: f32 = 0.6;

/// One frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameCheck {
    /// Name in the capture.
    pub name: String,
    /// Intersection over union of the silhouette with the mask and the unknown pixels within the
    /// silhouette; `None` where there is neither mask nor silhouette.
    pub iou: Option<f32>,
    /// Share of the silhouette that is unknown.
    pub hidden: f32,
    /// Share of the mask more than 5 cm from the silhouette.
    pub beyond: f32,
    /// Faults found.
    pub faults: Vec<Fault>,
}

/// A whole capture.
///
/// ```
/// use occnerf::capture::{LoadOptions, load_capture};
/// use occnerf::{Mistake, check};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let body = smpl::BodyModel::embedded();
/// let options = LoadOptions { resize: Some(96), stride: 6, ..Default::default() };
/// let mut capture = load_capture("../xtask/demo".as_ref(), &body, &options)?;
/// let found = check(&capture, &body)?;
/// assert!(found.mistakes.is_empty() && found.mean_iou() > 0.7);
/// capture.train.iter_mut().for_each(|frame| frame.camera.focal *= 2.0);
/// assert!(matches!(check(&capture, &body)?.mistakes[..], [Mistake::Focal(_)]));
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    /// The training frames in order.
    pub frames: Vec<FrameCheck>,
    /// Share of the body's vertices visible at a mask pixel in some frame.
    pub surface_seen: f32,
    /// Likely errors; none for a good capture.
    pub mistakes: Vec<Mistake>,
}

impl Check {
    /// Mean overlap of the frames that have one.
    #[must_use]
    pub fn mean_iou(&self) -> f32 {
        self.mean(|frame| frame.iou)
    }

    /// Mean share of the masks more than 5 cm from the silhouette.
    #[must_use]
    pub fn mean_beyond(&self) -> f32 {
        self.mean(|frame| Some(frame.beyond))
    }

    /// Mean share of the silhouette that is unknown.
    #[must_use]
    pub fn mean_hidden(&self) -> f32 {
        self.mean(|frame| Some(frame.hidden))
    }

    fn mean(&self, of: impl Fn(&FrameCheck) -> Option<f32>) -> f32 {
        let values: Vec<f32> = self.frames.iter().filter_map(of).collect();
        values.iter().sum::<f32>() / values.len().max(1) as f32
    }
}

/// Checks the training frames.
///
/// # Errors
/// Pictures that cannot be read.
pub fn check(capture: &Capture, body: &BodyModel) -> Result<Check, Error> {
    let small = small_views(capture)?;
    let parts = faults::parts(body);
    let checked: Vec<Result<FrameCheck, Error>> =
        small.par_iter().map(|view| one(&capture.train[view.index], view, body, &parts)).collect();
    let mut frames = checked.into_iter().collect::<Result<Vec<_>, _>>()?;
    for (frame, faults) in frames.iter_mut().zip(faults::jumps(capture, body)) {
        frame.faults.extend(faults);
    }
    let mistakes = likely(capture, body, small)?;
    Ok(Check { frames, surface_seen: surface_seen(capture, body)?, mistakes })
}

/// Likely mistakes by a sample of the frames with a mask.
fn likely(capture: &Capture, body: &BodyModel, small: Vec<View>) -> Result<Vec<Mistake>, Error> {
    let shown: Vec<View> = small.into_iter().filter(|view| view.mask.contains(&true)).collect();
    let every = shown.len().div_ceil(VIEWS).max(1);
    let views: Vec<View> = shown.into_iter().step_by(every).collect();
    if views.is_empty() { Ok(Vec::new()) } else { mistakes::find(capture, body, &views) }
}

fn small_views(capture: &Capture) -> Result<Vec<View>, CaptureError> {
    let small: Vec<Result<View, CaptureError>> =
        capture.train.par_iter().enumerate().map(|(i, frame)| View::new(i, frame)).collect();
    small.into_iter().collect()
}

/// Pixels (H × W) of a frame's picture that the posed body covers.
///
/// # Errors
/// A picture of more than 16384 pixels a side.
pub fn body_silhouette(frame: &Frame, body: &BodyModel) -> Result<Vec<bool>, Error> {
    Ok(silhouette(&posed(frame, body), &body.faces, &frame.camera)?)
}

/// The unmasked photograph of a frame, for display; the masked picture of pixels in memory.
///
/// # Errors
/// Pictures that cannot be read.
pub fn photograph(frame: &Frame) -> Result<Image, CaptureError> {
    match frame.source.photograph() {
        Some(image) => image,
        None => Ok(frame.pixels()?.image.clone()),
    }
}

/// Unknown pixels (H × W) of a frame, given the body's `silhouette`.
#[must_use]
pub fn unknown_pixels(frame: &Frame, pixels: &Pixels, silhouette: &[bool], body: &BodyModel) -> Vec<bool> {
    let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
    let scale = metre(&frame.camera, &posed.joints);
    unknown(&pixels.mask, silhouette, pixels.occluder.as_deref(), frame.camera.width, scale)
}

/// Pixels of a metre at the depth of the first joint.
fn metre(camera: &Camera, joints: &[Vec3]) -> f32 {
    let pelvis = joints.first().copied().unwrap_or(Vec3::ZERO);
    camera.focal.x / camera.world_to_camera.transform_point3(pelvis).z.max(1e-3)
}

fn unknown(mask: &[f32], silhouette: &[bool], occluder: Option<&[bool]>, width: u32, metre: f32) -> Vec<bool> {
    let labels = label_pixels(OccludedRule::Unknown, mask, silhouette, occluder, width as usize, metre);
    labels.into_iter().map(|label| label == Label::Unknown).collect()
}

impl View {
    fn new(index: usize, frame: &Frame) -> Result<Self, CaptureError> {
        let pixels = frame.pixels()?;
        let (width, height) = (frame.camera.width, frame.camera.height);
        let scale = (f64::from(SIDE) / f64::from(width.max(height))).min(1.0);
        let side = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        let camera = frame.camera.resized(side(width), side(height));
        // Nearest-neighbour sampling.
        let source = |i: u32| {
            let (x, y) = (i % camera.width, i / camera.width);
            let at = |i: u32, small: u32, large: u32| (2 * i + 1) as usize * large as usize / (2 * small as usize);
            at(y, camera.height, height) * width as usize + at(x, camera.width, width)
        };
        let count = camera.width * camera.height;
        let mask = (0..count).map(|i| pixels.mask[source(i)] > 0.5).collect();
        let occluder = pixels.occluder.as_ref().map(|o| (0..count).map(|i| o[source(i)]).collect());
        Ok(Self { index, camera, mask, occluder })
    }

    /// Whether the mask, or a known occluder, is at a pixel position, or the position is outside
    /// the image.
    fn shows(&self, at: Vec2) -> bool {
        let inside = at.cmpge(Vec2::ZERO).all() && at.x < self.camera.width as f32 && at.y < self.camera.height as f32;
        let pixel = at.y as usize * self.camera.width as usize + at.x as usize;
        !inside || self.mask[pixel] || self.occluder.as_ref().is_some_and(|occluder| occluder[pixel])
    }

    /// Share of the image border inside the mask.
    fn border(&self) -> f32 {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let outer =
            |i: usize| i < width || i >= width * (height - 1) || i.is_multiple_of(width) || i % width == width - 1;
        let border: Vec<bool> = (0..self.mask.len()).filter(|&i| outer(i)).map(|i| self.mask[i]).collect();
        border.iter().filter(|mask| **mask).count() as f32 / border.len().max(1) as f32
    }
}

fn one(frame: &Frame, view: &View, body: &BodyModel, parts: &[Part]) -> Result<FrameCheck, Error> {
    let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
    let silhouette = silhouette(&posed.vertices, &body.faces, &view.camera)?;
    let scale = metre(&view.camera, &posed.joints);
    let mask: Vec<f32> = view.mask.iter().map(|&m| f32::from(m)).collect();
    let unknown = unknown(&mask, &silhouette, view.occluder.as_deref(), view.camera.width, scale);
    let (mut known, mut either, mut hidden) = (0, 0, 0);
    for ((&body, &mask), &unknown) in silhouette.iter().zip(&view.mask).zip(&unknown) {
        known += usize::from(body && (mask || unknown));
        either += usize::from(body || mask);
        hidden += usize::from(body && unknown && !mask);
    }
    let covered = silhouette.iter().filter(|c| **c).count();
    let iou = (either > 0).then(|| known as f32 / either as f32);
    let empty = !view.mask.contains(&true);
    // A fit beside the mask may be unknown to a large part; its coverage of the mask decides.
    let beside = !empty && Overlap::of(&silhouette, view, false).covered() < 0.5;
    let (beyond, fault) = faults::beyond(view, &silhouette, &posed, parts, scale);
    let mut faults = Vec::new();
    if empty {
        faults.push(Fault::EmptyMask);
    } else if beside || iou.is_some_and(|iou| iou < LEAST_IOU) {
        faults.push(Fault::Overlap);
    } else {
        faults.extend(fault);
    }
    Ok(FrameCheck { name: frame.name.clone(), iou, hidden: hidden as f32 / covered.max(1) as f32, beyond, faults })
}

/// Share of the body's vertices visible at a mask pixel in at least one of up to 32 frames.
fn surface_seen(capture: &Capture, body: &BodyModel) -> Result<f32, CaptureError> {
    let every = capture.train.len().div_ceil(SURFACE_VIEWS).max(1);
    let mut seen = vec![false; body.num_vertices()];
    for frame in capture.train.iter().step_by(every) {
        let vertices = posed(frame, body);
        // A degenerate body has no visible vertices.
        let Ok(mesh) = RayMesh::new(&vertices, &body.faces) else { continue };
        let usable: Vec<bool> = frame.pixels()?.mask.iter().map(|&mask| mask > 0.5).collect();
        let now = visible_vertices(&mesh, &vertices, &pinhole(&frame.camera), Some(&usable));
        seen.iter_mut().zip(now).for_each(|(seen, now)| *seen |= now);
    }
    Ok(seen.iter().filter(|seen| **seen).count() as f32 / seen.len().max(1) as f32)
}
