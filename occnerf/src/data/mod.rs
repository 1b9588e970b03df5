//! Captures: frames with images, masks, cameras and body parameters.
//!
//! A [`Capture`] comes from a directory ([`load_humannerf`]) or is made on the spot ([`demo`]). Either way the
//! images hold nothing of what the masks hide, so that no hidden pixel can reach training.

mod demo;
mod error;
mod humannerf;
mod image;

pub use self::demo::{DemoConfig, demo};
pub use self::error::DataError;
pub use self::humannerf::{LoadOptions, find_body, load_humannerf};
pub use self::image::Image;

use glam::Vec3;

/// One picture of the subject with everything that is known about it.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Name within its camera, such as `frame_000012`.
    pub name: String,
    /// Picture multiplied by `mask`: colours are premultiplied by coverage, and 0 where the mask is 0. Over a
    /// background B the picture is `image + (1 − mask) · B`.
    pub image: Image,
    /// Coverage of each pixel by the *visible* subject, 0 to 1, (H, W); above 0.5 the pixel counts as subject.
    pub mask: Vec<f32>,
    /// The camera, OpenCV convention, pixel centres at integer + 0.5.
    pub camera: volrender::Camera,
    /// Axis-angle rotation of each joint, (J). Joint 0 is zero where `placement` carries the global rotation.
    pub pose: Vec<Vec3>,
    /// How the posed body stands in the world.
    pub placement: smpl::Placement,
    /// Shape coefficients, at most as many as the body model has.
    pub betas: Vec<f32>,
    /// Pixels known to be covered by something in front of the subject, (H, W); `None` where nobody marked them.
    pub occluder: Option<Vec<bool>>,
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
