//! Captures: frames with images, masks, cameras and body parameters.
//!
//! A [`Capture`] comes from a directory ([`load_capture`]) or is made on the spot ([`demo`]). Either way the
//! images hold nothing of what the masks hide, so that no hidden pixel can reach training.

mod camera;
mod check;
mod checks;
mod decode;
mod demo;
mod error;
mod find;
mod humannerf;
mod image;
mod import;
mod names;
mod obstacle;
mod options;
mod pictures;
mod records;
mod source;
mod synth;
#[cfg(test)]
mod testing;
mod undistort;
mod wild;
mod write;
mod wrong;
mod zju;

pub use self::check::{Check, Fault, FrameCheck, Mistake, body_silhouette, check, photograph, unknown_pixels};
pub use self::demo::{DemoConfig, demo};
pub use self::error::CaptureError;
pub use self::find::{Layout, find_body, own_body};
pub use self::image::Image;
pub use self::import::{ImportOptions, Imported, Tool, import};
pub use self::obstacle::Obstacle;
pub use self::options::LoadOptions;
pub use self::source::{PixelSource, Pixels};
pub use self::synth::{Occlusion, SynthConfig, Synthetic, synthesise};
pub use self::wrong::Wrong;

use std::path::Path;
use std::sync::Arc;

use glam::Vec3;

/// One picture of the subject with everything that is known about it.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Name within its camera, such as `frame_000012`.
    pub name: String,
    /// Picture, mask and occluder, each as large as the camera's image.
    pub source: PixelSource,
    /// The camera, OpenCV convention, pixel centres at integer + 0.5.
    pub camera: volrender::Camera,
    /// Axis-angle rotation of each joint, (J). Joint 0 is zero where `placement` carries the global rotation.
    pub pose: Vec<Vec3>,
    /// How the posed body stands in the world.
    pub placement: smpl::Placement,
    /// Shape coefficients, at most as many as the body model has.
    pub betas: Vec<f32>,
}

impl Frame {
    /// What it shows; see [`PixelSource::pixels`].
    ///
    /// # Errors
    /// For files that cannot be read; none for pixels in memory.
    pub fn pixels(&self) -> Result<Arc<Pixels>, CaptureError> {
        self.source.pixels()
    }
}

/// A picture kept back for evaluation: nothing occluded, black background.
#[derive(Clone, Debug)]
pub struct EvalFrame {
    /// Directory or given name of its camera.
    pub camera_name: String,
    /// The training frame of the same instant: same pose, and the occlusion that training saw then.
    pub train_index: usize,
    /// The picture, its camera and body parameters.
    pub frame: Frame,
}

/// A monocular video of one person, and views of the same instants from elsewhere.
#[derive(Clone, Debug)]
pub struct Capture {
    /// Where it comes from: a directory's name, or `demo`.
    pub name: String,
    /// The training video in time order; never empty.
    pub train: Vec<Frame>,
    /// Views kept back, by camera and then time; may be empty.
    pub eval: Vec<EvalFrame>,
    /// Shape of the canonical body (T-pose).
    pub mean_betas: Vec<f32>,
}

/// Reads a capture from a directory in one of three published layouts, told apart by the files in it:
///
/// - **raw ZJU-MoCap** (Peng et al. 2021; `annots.npy`, pictures by camera, `mask_cihp` or `mask`, `new_params`): one
///   camera is for training, the others are kept back. The training camera is occluded as in the paper, see
///   [`LoadOptions::occlusion`]. Kept-back pictures that are not there are left out.
/// - **HumanNeRF's prepared layout** (Weng et al. 2022; `cameras.pkl`, `mesh_infos.pkl`, `canonical_joints.pkl`,
///   `images`, `masks`), cameras kept back in `eval/*`.
/// - **HumanNeRF's wild layout** (`metadata.json`, `images`, `masks`), with `occluders` where it is known what
///   stands in front, and `clean/images`, `clean/masks` of the training camera kept back.
///
/// Pictures are decoded at once, in parallel, as far as [`LoadOptions::max_bytes`] admits; of the rest the headers are
/// looked at, and each is decoded whenever it is asked for.
///
/// Images are multiplied by their masks. Lens distortion is taken out of both, and both are reduced to
/// [`LoadOptions::resize`]. A frame without any subject pixel is kept (the subject may be wholly hidden for a while); a
/// camera without any in all its frames is an error. No views kept back leave [`Capture::eval`] empty.
///
/// # Errors
/// The first problem in the order files are read, training view before views kept back: a directory of no known layout;
/// files that are missing, unreadable, truncated (but for pictures that there is no room for, whose headers alone are read) or name
/// anything to execute; frames without camera or body parameters;
/// images and masks of unequal sizes or above 8192 pixels; more bodies than [`LoadOptions::max_bytes`] admits; arrays of
/// the wrong shape, or not finite; cameras that no projection fits, or that see nothing of the body in any frame; a
/// body model whose joints or vertices are not the file's; options outside their ranges.
pub fn load_capture(dir: &Path, body: &smpl::BodyModel, options: &LoadOptions) -> Result<Capture, CaptureError> {
    options.check()?;
    let mut capture = match find::Layout::detect(dir)? {
        find::Layout::ZjuMocap => zju::load(dir, body, options),
        find::Layout::Wild => wild::load(dir, body, options),
        find::Layout::HumanNerf => humannerf::load(dir, body, options),
    }?;
    options.wrong.apply(&mut capture, body)?;
    Ok(capture)
}
