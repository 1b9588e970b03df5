//! Captures: frames with images, masks, cameras and body parameters.
//!
//! A [`Capture`] comes from a directory ([`load_capture`]), which [`import`] makes of what body
//! estimators and segmenters write. Its images hold nothing of what the masks hide, so that no
//! hidden pixel can reach training.

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
mod light;
mod names;
mod options;
mod packed;
mod pictures;
mod pixels;
mod records;
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
pub use self::frame::{Capture, EvalFrame, Frame};
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
///   `new_params`): one camera is for training, the others are kept back. What
///   `occlusion.json` says of a simulated obstacle is hidden. Kept-back pictures that are not there
///   are left out.
/// - **HumanNeRF's prepared layout** (Weng et al. 2022; `cameras.pkl`, `mesh_infos.pkl`,
///   `canonical_joints.pkl`, `images`, `masks`), cameras kept back in `eval/*`.
/// - **HumanNeRF's wild layout** (`metadata.json`, `images`, `masks`), with `occluders` where it is
///   known what stands in front, and `clean/images`, `clean/masks` of the training camera kept
///   back.
///
/// Pictures are decoded at once, in parallel, as far as [`LoadOptions::max_bytes`] admits; of the
/// rest the headers are looked at, and each is decoded whenever it is asked for.
///
/// Images are multiplied by their masks. Lens distortion is taken out of both, and both are reduced
/// to [`LoadOptions::resize`]. A frame without any subject pixel is kept (the subject may be wholly
/// hidden for a while); a camera without any in all its frames is an error. No views kept back
/// leave [`Capture::eval`] empty.
///
/// # Errors
/// The first problem in the order files are read, training view before views kept back: a directory
/// of no known layout; files that are missing, unreadable, truncated (but for pictures that there
/// is no room for, whose headers alone are read) or name anything to execute; frames without camera
/// or body parameters; images and masks of unequal sizes or above 8192 pixels; more bodies than
/// [`LoadOptions::max_bytes`] admits; arrays of the wrong shape, or not finite; cameras that no
/// projection fits, or that see nothing of the body in any frame; a body model whose joints or
/// vertices are not the file's; options outside their ranges.
pub fn load_capture(dir: &Path, body: &smpl::BodyModel, options: &LoadOptions) -> Result<Capture, CaptureError> {
    options.check()?;
    match find::Layout::detect(dir)? {
        find::Layout::ZjuMocap => zju::load(dir, body, options),
        find::Layout::Wild => wild::load(dir, body, options),
        find::Layout::HumanNerf => humannerf::load(dir, body, options),
    }
}
