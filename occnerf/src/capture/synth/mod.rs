//! Captures made to order: a person or a character filmed, then hidden in part, ready to be written to disk.

mod character;
pub(super) mod noise;
mod objects;
mod perform;
pub(super) mod render;
pub(super) mod stage;
#[cfg(test)]
mod tests;
mod texture;

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use smpl::{BodyModel, Character, MotionClip};

use self::objects::Objects;
use self::render::Picture;
use super::demo::{DemoConfig, film, grounded_walk};
use super::obstacle::Area;
use super::{Capture, CaptureError, Frame, LoadOptions, Obstacle, Pixels};

/// What stands in front of the person in the training view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Occlusion {
    /// The paper's rectangle.
    Rectangle(Obstacle),
    /// A desk and two pillars of 3-D geometry, lit as the person is, before a room; in every frame.
    Objects {
        /// Part of the person's pixels that is hidden, 0 to 0.95: the objects are as wide as that takes.
        fraction: f32,
        /// How far they stand to the right of the person, in picture widths, −1 to 1.
        position: f32,
    },
}

/// What a synthetic capture is made of. The default gives the demo's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SynthConfig {
    /// Pixels a side, 16 to 2048.
    pub size: u32,
    /// Frames of the training video, 1 to 10 000. However many, they show the whole motion.
    pub frames: usize,
    /// Cameras kept back for evaluation, evenly around the person, at most 64.
    pub eval_cameras: usize,
    /// Evaluation cameras see one frame in this many, beginning with the first.
    pub eval_every: usize,
    /// Decides the embedded person's shape and the errors of the prior.
    pub seed: u64,
    /// Root mean square error of each bone's orientation in the prior, degrees, 0 to 45.
    pub pose_noise_degrees: f32,
    /// Error of the prior's shape relative to the usual one, 0 to 3. At 1 the embedded person's coefficients are off by
    /// 0.15 (standard deviation), beside the clothes; the prior of a character lies 1 to 3 cm inside it.
    pub shape_noise: f32,
    /// Full turns added over the video to the motion of a clip or a character, −10 to 10, so that all sides are seen.
    pub turns: f32,
    /// What hides the person.
    pub occlusion: Occlusion,
}

impl Default for SynthConfig {
    fn default() -> Self {
        let demo = DemoConfig::default();
        Self {
            size: demo.size,
            frames: demo.frames,
            eval_cameras: demo.eval_cameras,
            eval_every: demo.eval_every,
            seed: demo.seed,
            pose_noise_degrees: demo.pose_noise_degrees,
            shape_noise: 1.0,
            turns: 1.15,
            occlusion: Occlusion::Rectangle(Obstacle::default()),
        }
    }
}

impl SynthConfig {
    /// The demo of the same settings, nothing occluded.
    fn demo(&self) -> DemoConfig {
        let usual = DemoConfig::default();
        DemoConfig {
            size: self.size,
            frames: self.frames,
            eval_cameras: self.eval_cameras,
            eval_every: self.eval_every,
            seed: self.seed,
            pose_noise_degrees: self.pose_noise_degrees,
            beta_noise: usual.beta_noise * self.shape_noise,
            occluded_fraction: 0.0,
            ..usual
        }
    }

    fn check(&self) -> Result<(), CaptureError> {
        let (fraction, position) = match self.occlusion {
            Occlusion::Rectangle(obstacle) => {
                obstacle.check()?;
                (0.0, 0.0)
            }
            Occlusion::Objects { fraction, position } => (fraction, position),
        };
        for (name, value, low, high) in [
            ("shape_noise", self.shape_noise, 0.0, 3.0),
            ("turns", self.turns, -10.0, 10.0),
            ("occlusion.fraction", fraction, 0.0, 0.95),
            ("occlusion.position", position, -1.0, 1.0),
        ] {
            if !(low..=high).contains(&value) {
                return Err(CaptureError::setting(name, format!("{low} to {high}"), value));
            }
        }
        self.demo().check()?;
        // All of it is in memory until it is written.
        let views = self.frames + self.frames.div_ceil(self.eval_every) * self.eval_cameras;
        let bytes = views as u64 * u64::from(self.size).pow(2) * 16;
        let limit = LoadOptions::default().max_bytes;
        if bytes > limit {
            let expected =
                format!("at most {} MiB of pixels in memory (fewer frames or views, or a smaller size)", limit >> 20);
            let actual = format!("{} MiB in {views} pictures of {1}×{1}", bytes >> 20, self.size);
            return Err(CaptureError::setting("frames", expected, actual));
        }
        Ok(())
    }
}

/// A capture made by [`synthesise`], with what only its maker knows.
pub struct Synthetic {
    /// What training sees: the occlusion applied.
    pub capture: Capture,
    /// The body model that the capture's poses and betas are for.
    pub body: BodyModel,
    /// What it was made of.
    pub config: SynthConfig,
    /// Part of the subject's pixels that is hidden, over the frames in which anything is.
    pub hidden_fraction: f32,
    /// The training view without the occlusion.
    pub(super) clear: Vec<Picture>,
    /// What the rectangle hides in each training frame; empty for objects.
    pub(super) hidden: Vec<Area>,
    /// The objects and the room.
    pub(super) objects: Option<Objects>,
}

/// Films the embedded person, or `character`, moving as in `motion` (SMPL's joints), else in its own way: the embedded
/// person walks and turns, a character plays its first animation, or stands where it has none. `progress` is called
/// with the number of instants filmed.
///
/// The tracker's poses and betas are off by the configured errors. A character's body model is its own mesh at rest
/// with its skin and joints, and one coefficient that moves the surface inward. Cameras stand still around the origin, so motions
/// are brought there. The result depends on the arguments alone, not on the number of threads.
///
/// # Errors
/// [`CaptureError::Setting`] for values outside their ranges, for more pixels than [`LoadOptions::max_bytes`] admits by
/// default, and for characters that no body can be made of, or that `motion` cannot drive.
pub fn synthesise(
    character: Option<&Character>,
    motion: Option<&MotionClip>,
    config: &SynthConfig,
    progress: &(dyn Fn(usize) + Sync),
) -> Result<Synthetic, CaptureError> {
    config.check()?;
    let (mut capture, height, body) = match character {
        Some(character) => character::film(character, motion, config, progress)?,
        None => {
            let body = BodyModel::embedded();
            let (capture, height) = match motion {
                None => film(&config.demo(), &body, grounded_walk, progress)?,
                Some(clip) => {
                    let perform = |demo: &DemoConfig, body: &_, shaped: &_| {
                        perform::embedded(clip, demo.frames, config.turns, body, shaped)
                    };
                    film(&config.demo(), &body, perform, progress)?
                }
            };
            (capture, height, body)
        }
    };
    let clear: Vec<Picture> = pixels(&capture.train)?.iter().map(|p| (p.image.clone(), p.mask.clone())).collect();
    let mut hidden = Vec::new();
    let mut objects = None;
    match config.occlusion {
        Occlusion::Rectangle(obstacle) => hidden = obstacle.hide(&mut capture.train)?,
        Occlusion::Objects { fraction, position } => {
            let made = Objects::new(&capture.train, height, fraction, position)?;
            made.hide(&mut capture.train)?;
            objects = Some(made);
        }
    }
    let hidden_fraction = hidden_fraction(&clear, &pixels(&capture.train)?);
    Ok(Synthetic { capture, body, config: *config, hidden_fraction, clear, hidden, objects })
}

fn pixels(frames: &[Frame]) -> Result<Vec<Arc<Pixels>>, CaptureError> {
    frames.iter().map(Frame::pixels).collect()
}

/// Part of the subject's pixels that is gone, over the frames that lost any.
fn hidden_fraction(clear: &[Picture], train: &[Arc<Pixels>]) -> f32 {
    let count = |mask: &[f32]| mask.iter().filter(|m| **m > 0.5).count() as u64;
    let (mut whole, mut gone) = (0u64, 0u64);
    for ((_, before), frame) in clear.iter().zip(train) {
        let (before, after) = (count(before), count(&frame.mask));
        if after < before {
            whole += before;
            gone += before - after;
        }
    }
    gone as f32 / whole.max(1) as f32
}
