//! A capture as plain data: training frames and evaluation views.

use glam::{Vec2, Vec3};

use super::CaptureError;
use super::pixels::Pixels;
use super::source::PixelSource;

/// A joint of the body as a detector found it in a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoint {
    /// Joint of the body model.
    pub joint: usize,
    /// Pixels, pixel centres at integer + 0.5.
    pub place: Vec2,
    /// 0 to 1.
    pub confidence: f32,
}

/// One picture of the subject with its camera and body parameters.
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
    /// Placement of the posed body in the world.
    pub placement: smpl::Placement,
    /// Shape coefficients, at most as many as the body model has.
    pub betas: Vec<f32>,
    /// Detected joints; empty where no detector ran.
    pub keypoints: Vec<Keypoint>,
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

/// An evaluation view, unoccluded over a black background.
#[derive(Clone, Debug)]
pub struct EvalFrame {
    /// Directory or given name of its camera.
    pub camera_name: String,
    /// Training frame of the same instant, with the same pose.
    pub train_index: usize,
    /// The picture, its camera and body parameters.
    pub frame: Frame,
}

/// A monocular video of one person, with evaluation views of the same instants.
///
/// ```
/// let body = smpl::BodyModel::embedded();
/// let capture = capture::load_capture("../../xtask/demo".as_ref(), &body, &Default::default())?;
/// assert_eq!(capture.train[0].pose.len(), body.num_joints());
/// // A view of the instant of a training frame has its pose.
/// let view = &capture.eval[0];
/// assert_eq!(view.frame.pose, capture.train[view.train_index].pose);
/// # Ok::<(), capture::CaptureError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Capture {
    /// Name of the directory it comes from, or `demo`.
    pub name: String,
    /// The training video in time order; never empty.
    pub train: Vec<Frame>,
    /// Evaluation views, by camera and then time; may be empty.
    pub eval: Vec<EvalFrame>,
    /// Shape of the canonical body (T-pose).
    pub mean_betas: Vec<f32>,
}

/// A capture with corrected masks, or with masks to be taken as they are.
///
/// ```
/// use capture::{LoadOptions, Mended, Registered, load_capture};
///
/// let few = LoadOptions { max_frames: Some(2), ..LoadOptions::default() };
/// let capture = load_capture("../../xtask/demo".as_ref(), &smpl::BodyModel::embedded(), &few)?;
/// // Exact masks and bodies need no correction.
/// let registered = Registered::from(Mended::from(capture).capture);
/// assert_eq!((registered.mending.growth, registered.fists), (0, [0.0; 2]));
/// # Ok::<(), capture::CaptureError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Mended {
    /// The capture.
    pub capture: Capture,
    /// What was changed.
    pub mending: Mending,
}

/// Corrections of the masks of a capture's training frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Mending {
    /// Pixels by which the masks were dilated; eroded where negative.
    pub growth: i32,
    /// Share of the masks that was removed as background.
    pub background: f32,
}

impl From<Capture> for Mended {
    /// Takes the masks as they are.
    fn from(capture: Capture) -> Self {
        Self { capture, mending: Mending::default() }
    }
}

/// A mended capture with registered bodies, or with bodies to be taken as they are.
#[derive(Clone, Debug)]
pub struct Registered {
    /// The capture.
    pub capture: Capture,
    /// Registered offset of clothes and hair along each vertex normal, in the capture's units;
    /// empty where unknown.
    pub clothes: Vec<f32>,
    /// [`Mended::mending`].
    pub mending: Mending,
    /// How far the fingers of the left and of the right hand are rolled up, 0 to 1.
    pub fists: [f32; 2],
}

impl From<Capture> for Registered {
    /// Takes masks and bodies as they are.
    fn from(capture: Capture) -> Self {
        Self { capture, clothes: Vec::new(), mending: Mending::default(), fists: [0.0; 2] }
    }
}
