//! Captures: frames with images, masks, cameras and body parameters.
//!
//! A [`Capture`] is loaded from a directory ([`load_capture`]), which [`import`] writes from the
//! results of body estimators and segmenters. Images are multiplied by their masks, so that no
//! masked pixel reaches training.

mod camera;
mod checks;
mod decode;
mod error;
mod files;
mod find;
mod frame;
mod gate;
mod humannerf;
mod image;
mod import;
mod item;
mod json;
mod light;
mod names;
mod options;
mod packed;
mod pictures;
mod pixels;
mod source;
#[cfg(test)]
pub(crate) mod testing;
mod undistort;
mod wild;
mod zju;

pub use self::camera::MAX_DISTANCE;
pub use self::checks::MAX_BETA;
pub use self::decode::PIXEL_BYTES;
pub use self::error::CaptureError;
pub use self::find::{Layout, find_body, own_body};
pub use self::frame::{Capture, EvalFrame, Frame, Keypoint, Mended, Mending, Registered};
pub use self::image::{Image, MAX_SIDE};
pub use self::import::{ImportOptions, Imported, Tool, import};
pub use self::light::Light;
pub use self::options::LoadOptions;
pub use self::packed::PackedPixels;
pub use self::pixels::{Area, MaskedPixel, Pixels};
pub use self::source::{PixelReader, PixelSource};

use std::path::Path;

/// Reads a capture from a directory in one of three published layouts, told apart by the files in
/// it:
///
/// - **raw ZJU-MoCap** (Peng et al. 2021; `annots.npy`, pictures by camera, `mask_cihp` or `mask`,
///   `new_params`): one camera for training, the others, as far as present, for evaluation;
///   `occlusion.json` gives a simulated obstacle.
/// - **HumanNeRF's prepared layout** (Weng et al. 2022; `cameras.pkl`, `mesh_infos.pkl`,
///   `canonical_joints.pkl`, `images`, `masks`), evaluation cameras in `eval/*`.
/// - **HumanNeRF's wild layout** (`metadata.json`, `images`, `masks`), with masks of occluders in
///   `occluders`, and unoccluded frames in `clean/images`, `clean/masks` for evaluation.
///
/// Pictures are decoded in parallel within [`LoadOptions::max_bytes`]; of the rest, headers are
/// checked, and each is decoded at every use.
///
/// Images are multiplied by their masks; both are undistorted and resized to
/// [`LoadOptions::resize`]. A frame may have no subject pixel (fully occluded), but not all frames
/// of a camera.
///
/// # Errors
/// The first problem in the order files are read, training before evaluation: an unknown layout;
/// files that are missing, unreadable, truncated (except undecoded pictures) or name anything to
/// execute; frames without camera or body parameters; images and masks of unequal sizes or above
/// 8192 pixels; bodies beyond [`LoadOptions::max_bytes`]; arrays of another shape, or not finite;
/// invalid cameras, or none with the body in view; a body model with other joints or vertices than
/// the file's; options outside their ranges.
pub fn load_capture(dir: &Path, body: &smpl::BodyModel, options: &LoadOptions) -> Result<Capture, CaptureError> {
    options.check()?;
    match find::Layout::detect(dir)? {
        find::Layout::ZjuMocap => zju::load(dir, body, options),
        find::Layout::Wild => wild::load(dir, body, options),
        find::Layout::HumanNerf => humannerf::load(dir, body, options),
    }
}
