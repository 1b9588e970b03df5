//! Cameras around a person, and the video that they take.

use std::f32::consts::TAU;

use glam::Vec3;
use rayon::prelude::*;
use volrender::Camera;

use super::render::{Posture, look_at};
use crate::demo::motion::Pose;
use capture::{Capture, CaptureError, EvalFrame, Frame, PixelSource, Pixels};

/// Focal length in picture sides.
const FOCAL: f32 = 1.45;
/// Distance of the cameras from the person's axis in heights of the person: fills three quarters of
/// the picture.
const DISTANCE: f32 = 1.97;
/// Height of the cameras and of the point they look at, in heights of the person.
const CAMERA_HEIGHT: f32 = 0.60;
const TARGET_HEIGHT: f32 = 0.505;

/// Called with the number of instants filmed so far, from any thread.
pub(crate) type Progress<'a> = dyn Fn(usize) + Sync + 'a;

/// The training camera, then `others` around the circle, for a person of `height` on the floor at
/// the origin.
pub(crate) fn ring(size: u32, others: usize, height: f32) -> Result<Vec<Camera>, CaptureError> {
    (0..=others)
        .map(|c| {
            let azimuth = if c == 0 { 0.0 } else { TAU * (c as f32 - 0.5) / others as f32 };
            let eye = Vec3::new(azimuth.sin() * DISTANCE, CAMERA_HEIGHT, azimuth.cos() * DISTANCE);
            look_at(eye * height, Vec3::Y * (TARGET_HEIGHT * height), size, FOCAL)
        })
        .collect()
}

/// Who looks, and what the tracker says.
pub(crate) struct Stage<'a> {
    /// The first is for training.
    pub cameras: Vec<Camera>,
    /// The others see one instant in this many.
    pub eval_every: usize,
    /// The tracker's pose of each instant.
    pub priors: Vec<Pose>,
    /// The tracker's shape.
    pub betas: Vec<f32>,
    pub progress: &'a Progress<'a>,
}

impl Stage<'_> {
    /// The video, with nothing in front of the person, and the views kept back; in a file of the
    /// system's temporary folder where they take more than [`LoadOptions::max_bytes`] by default.
    pub fn film<'p>(
        self,
        name: &str,
        posture: impl Fn(usize) -> Result<Posture<'p>, CaptureError> + Sync,
    ) -> Result<Capture, CaptureError> {
        let done = std::sync::atomic::AtomicUsize::new(0);
        let take = |posture: &Posture<'p>, camera: &Camera| -> PixelSource {
            let (image, mask) = posture.render(camera);
            Pixels { image, mask, occluder: None }.into()
        };
        let views: Vec<Result<Vec<PixelSource>, CaptureError>> = (0..self.priors.len())
            .into_par_iter()
            .map(|i| {
                let posture = posture(i)?;
                let seen = if i % self.eval_every == 0 { self.cameras.len() } else { 1 };
                let pictures = Ok(self.cameras[..seen].iter().map(|camera| take(&posture, camera)).collect());
                (self.progress)(done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1);
                pictures
            })
            .collect();
        let mut train = Vec::with_capacity(self.priors.len());
        let mut eval = Vec::new();
        for (i, views) in views.into_iter().enumerate() {
            for (c, source) in views?.into_iter().enumerate() {
                let frame = Frame {
                    name: format!("frame_{i:06}"),
                    source,
                    camera: self.cameras[c],
                    pose: self.priors[i].joints.clone(),
                    placement: self.priors[i].placement(),
                    betas: self.betas.clone(),
                    keypoints: Vec::new(),
                };
                if c == 0 {
                    train.push(frame);
                } else {
                    eval.push((c, EvalFrame { camera_name: format!("Camera_B{}", c + 1), train_index: i, frame }));
                }
            }
        }
        eval.sort_by_key(|(camera, frame)| (*camera, frame.train_index));
        Ok(Capture {
            name: name.to_owned(),
            train,
            eval: eval.into_iter().map(|(_, frame)| frame).collect(),
            mean_betas: self.betas,
        })
    }
}
