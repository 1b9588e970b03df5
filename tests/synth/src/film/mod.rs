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

use rayon::prelude::*;
use rigged::Character;
use smpl::{BodyModel, MotionClip};

pub use self::config::{Occlusion, SynthConfig};

use self::objects::Objects;
use self::render::Lamp;
use crate::demo::{DemoConfig, film, grounded_walk};
use capture::Area;
use capture::{Capture, CaptureError, Frame, PixelSource};

/// A capture made by [`synthesise`], with what only its maker knows.
pub struct Synthetic {
    /// The capture that training sees, the occlusion applied.
    pub capture: Capture,
    /// The body model that the capture's poses and betas are for.
    pub body: BodyModel,
    /// Names of a character's joints, in the order of `body`; none for the embedded person.
    pub joints: Vec<String>,
    /// The configuration it was made of.
    pub config: SynthConfig,
    /// Part of the subject's pixels that is hidden, over the frames in which anything is.
    pub hidden_fraction: f32,
    /// The training view without the occlusion.
    pub(super) clear: Vec<PixelSource>,
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
/// [`CaptureError::Setting`] for values outside their ranges, and for characters that no body can
/// be made of, or that `motion` cannot drive; [`CaptureError::Io`] where pictures that memory has
/// no room for cannot be put into the system's temporary folder.
pub fn synthesise(
    character: Option<&Character>,
    motion: Option<&MotionClip>,
    config: &SynthConfig,
    progress: &(dyn Fn(usize) + Sync),
) -> Result<Synthetic, CaptureError> {
    config.check()?;
    let (mut capture, height, body, joints) = match character {
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
            (capture, height, body, Vec::new())
        }
    };
    let clear: Vec<PixelSource> = capture.train.iter().map(|frame| frame.source.clone()).collect();
    let mut hidden = Vec::new();
    let mut objects = None;
    match config.occlusion {
        Occlusion::Rectangle(obstacle) => hidden = obstacle.hide(&mut capture.train)?,
        Occlusion::Objects { fraction, position } => {
            let made = Objects::new(&capture.train, height, (fraction, position), Lamp::new(config.lamp, config.seed))?;
            made.hide(&mut capture.train);
            objects = Some(made);
        }
    }
    let hidden_fraction = hidden_fraction(&clear, &capture.train)?;
    Ok(Synthetic { capture, body, joints, config: *config, hidden_fraction, clear, hidden, objects })
}

/// Part of the subject's pixels that is gone, over the frames that lost any.
fn hidden_fraction(clear: &[PixelSource], train: &[Frame]) -> Result<f32, CaptureError> {
    let count = |source: &PixelSource| -> Result<u64, CaptureError> {
        Ok(source.pixels()?.mask.iter().filter(|m| **m > 0.5).count() as u64)
    };
    let counts: Vec<Result<[u64; 2], CaptureError>> =
        clear.par_iter().zip(train).map(|(before, frame)| Ok([count(before)?, count(&frame.source)?])).collect();
    let (mut whole, mut gone) = (0u64, 0u64);
    for counts in counts {
        let [before, after] = counts?;
        if after < before {
            whole += before;
            gone += before - after;
        }
    }
    Ok(gone as f32 / whole.max(1) as f32)
}
