//! Captures made to order: a person or a character filmed, then hidden in part, ready to be written
//! to disk.

mod character;
mod config;
pub(super) mod noise;
mod objects;
mod perform;
pub(super) mod render;
pub(super) mod stage;
#[cfg(test)]
mod tests;
mod texture;

use std::sync::Arc;

use smpl::{BodyModel, Character, MotionClip};

pub use self::config::{Occlusion, SynthConfig};

use self::objects::Objects;
use self::render::Picture;
use super::demo::{DemoConfig, film, grounded_walk};
use super::pixels::{Area, Pixels};
use super::{Capture, CaptureError, Frame};

/// A capture made by [`synthesise`], with what only its maker knows.
pub struct Synthetic {
    /// The capture that training sees, the occlusion applied.
    pub capture: Capture,
    /// The body model that the capture's poses and betas are for.
    pub body: BodyModel,
    /// The configuration it was made of.
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

/// Films the embedded person, or `character`, moving as in `motion` (SMPL's joints), else in its
/// own way: the embedded person walks and turns, a character plays its first animation, or stands
/// where it has none. `progress` is called with the number of instants filmed.
///
/// The tracker's poses and betas are off by the configured errors. A character's body model is its
/// own mesh at rest with its skin and joints, and one coefficient that moves the surface inward.
/// Cameras stand still around the origin, so motions are brought there. The result depends on the
/// arguments alone, not on the number of threads.
///
/// # Errors
/// [`CaptureError::Setting`] for values outside their ranges, for more pixels than
/// [`LoadOptions::max_bytes`](crate::capture::LoadOptions::max_bytes) admits by default, and for
/// characters that no body can be made of, or that `motion` cannot drive.
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
