use serde::{Deserialize, Serialize};

use super::CaptureError;
use super::image::MAX_SIDE;

/// Options of loading a capture, valid for every layout except `camera`, for raw ZJU-MoCap only.
/// Equality is that of the loaded data: `max_bytes` and `unseen` are not compared.
///
/// ```
/// use capture::{LoadOptions, load_capture};
///
/// let options = LoadOptions { resize: Some(48), stride: 10, ..LoadOptions::default() };
/// let capture = load_capture("../../xtask/demo".as_ref(), &smpl::BodyModel::embedded(), &options)?;
/// let frame = &capture.train[1];
/// assert_eq!((frame.name.as_str(), frame.camera.width), ("frame_000010", 48));
/// # Ok::<(), capture::CaptureError>(())
/// ```
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LoadOptions {
    /// Image coordinate of the first pixel's centre in the intrinsics: 0.5, or 0 as in HumanNeRF's
    /// own rays.
    pub pixel_centre: f32,
    /// Largest side after resizing, pixels; `None` keeps all sizes.
    pub resize: Option<u32>,
    /// Stride of training frames.
    pub stride: usize,
    /// At most this many training frames, the first ones after `stride`.
    pub max_frames: Option<usize>,
    /// Stride of training frames whose evaluation views are loaded.
    pub eval_stride: usize,
    /// Memory limit in bytes for the bodies of all frames (24 a vertex), the labels of the training
    /// frames (3 bits a pixel), packed pictures (4 or 16 a pixel of the person) and pictures being
    /// decoded (48 a pixel of the file). Pictures beyond it are decoded at every use.
    pub max_bytes: u64,
    /// The training camera: its folder's name, or its number counted from 1. The first if `None`.
    pub camera: Option<String>,
    /// Whether cameras without the body in view are accepted, for `occnerf::check` to diagnose.
    #[serde(skip)]
    pub unseen: bool,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self {
            pixel_centre: 0.5,
            resize: None,
            stride: 1,
            max_frames: None,
            eval_stride: 1,
            max_bytes: 1 << 30,
            camera: None,
            unseen: false,
        }
    }
}

impl PartialEq for LoadOptions {
    fn eq(&self, other: &Self) -> bool {
        fn read(options: &LoadOptions) -> impl PartialEq + '_ {
            let LoadOptions { pixel_centre, resize, stride, max_frames, eval_stride, max_bytes: _, camera, unseen: _ } =
                options;
            (pixel_centre, resize, stride, max_frames, eval_stride, camera)
        }
        read(self) == read(other)
    }
}

impl LoadOptions {
    pub(super) fn check(&self) -> Result<(), CaptureError> {
        let within = |name, ok: bool, expected: String, actual: &dyn ToString| {
            if ok { Ok(()) } else { Err(CaptureError::setting(name, expected, actual.to_string())) }
        };
        let centre = &self.pixel_centre;
        within("pixel_centre", centre.is_finite(), "a finite number (0 or 0.5)".to_owned(), centre)?;
        if let Some(side) = &self.resize {
            within("resize", (1..=MAX_SIDE).contains(side), format!("1 to {MAX_SIDE} pixels"), side)?;
        }
        within("stride", self.stride > 0, "at least 1".to_owned(), &self.stride)?;
        within("eval_stride", self.eval_stride > 0, "at least 1".to_owned(), &self.eval_stride)?;
        if let Some(frames) = &self.max_frames {
            within("max_frames", *frames > 0, "at least 1".to_owned(), frames)?;
        }
        Ok(())
    }

    /// The items that `stride` and `max_frames` leave.
    pub(super) fn select<T>(&self, items: impl IntoIterator<Item = T>) -> Vec<T> {
        items.into_iter().step_by(self.stride).take(self.max_frames.unwrap_or(usize::MAX)).collect()
    }

    /// Errors for an option without meaning in `layout`.
    pub(super) fn only_zju(&self, layout: &str) -> Result<(), CaptureError> {
        if let Some(camera) = &self.camera {
            let expected = format!("none ({layout} has one training camera)");
            return Err(CaptureError::setting("camera", expected, camera));
        }
        Ok(())
    }

    /// Width and height of a picture after `resize`.
    pub(super) fn resized(&self, (width, height): (u32, u32)) -> (u32, u32) {
        let longest = width.max(height);
        let Some(side) = self.resize.filter(|side| *side < longest) else { return (width, height) };
        let scale = f64::from(side) / f64::from(longest);
        let scaled = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        (scaled(width), scaled(height))
    }
}
