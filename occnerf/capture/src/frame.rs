//! A capture as plain data: frames, views kept back, and what they have in common.

use glam::Vec3;

use super::CaptureError;
use super::pixels::Pixels;
use super::source::PixelSource;

/// One picture of the subject with everything that is known about it.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Name within its camera, such as `frame_000012`.
    pub name: String,
    /// Picture, mask and occluder, each as large as the camera's image.
    pub source: PixelSource,
    /// The camera, OpenCV convention, pixel centres at integer + 0.5.
    pub camera: volrender::Camera,
    /// Axis-angle rotation of each joint, (J). Joint 0 is zero where `placement` carries the global
    /// rotation.
    pub pose: Vec<Vec3>,
    /// How the posed body stands in the world.
    pub placement: smpl::Placement,
    /// Shape coefficients, at most as many as the body model has.
    pub betas: Vec<f32>,
}

impl Frame {
    /// The pixels; see [`PixelSource::pixels`].
    ///
    /// # Errors
    /// For files that cannot be read; none for pixels in memory.
    pub fn pixels(&self) -> Result<Pixels, CaptureError> {
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
    /// Name of the directory it comes from, or `demo`.
    pub name: String,
    /// The training video in time order; never empty.
    pub train: Vec<Frame>,
    /// Views kept back, by camera and then time; may be empty.
    pub eval: Vec<EvalFrame>,
    /// Shape of the canonical body (T-pose).
    pub mean_betas: Vec<f32>,
    /// Whether registration has corrected the bodies.
    pub registered: bool,
    /// How far clothes and hair stand off each vertex of the body along its normal, in the capture's
    /// units, as registration has found it; empty where nothing is known.
    pub clothes: Vec<f32>,
    /// Whether masks that are too large or too small have been mended.
    pub mended: bool,
}
