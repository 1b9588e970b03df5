//! Captures made as hard as one likes.

use anyhow::{Result, ensure};
use glam::{Quat, Vec3};
use occnerf::capture::{Capture, Frame, Pixels};
use serde::{Deserialize, Serialize};
use smpl::{BodyModel, Placement};
use synth::{DemoConfig, Perturbation, demo};

/// Moments that a frame's exposure can be made of.
const MOMENTS: usize = 8;

/// A variation of the demo.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Difficulty {
    pub demo: DemoConfig,
    /// Errors of priors and masks.
    pub wrong: Perturbation,
    /// Exposure of a training frame as a share of the time from one frame to the next, 0 to 1.
    pub shutter: f32,
    /// Keep only training frames in which the person's front is within this angle of the camera;
    /// 180 keeps all.
    pub facing_degrees: f32,
}

impl Default for Difficulty {
    fn default() -> Self {
        Self { demo: DemoConfig::default(), wrong: Perturbation::NONE, shutter: 0.0, facing_degrees: 180.0 }
    }
}

impl Difficulty {
    /// The capture and its body model.
    pub fn make(&self) -> Result<(Capture, BodyModel)> {
        ensure!((0.0..=1.0).contains(&self.shutter), "shutter is {}: expected 0 to 1", self.shutter);
        let body = BodyModel::embedded();
        let mut capture = if self.shutter > 0.0 { self.exposed(&body)? } else { demo(&self.demo, &body)? };
        self.wrong.apply(&mut capture, &body)?;
        if self.facing_degrees < 180.0 {
            keep(&mut capture, |frame| facing(frame) <= self.facing_degrees);
            let degrees = self.facing_degrees;
            ensure!(!capture.train.is_empty(), "no frame has the front within {degrees}° of the camera");
        }
        Ok((capture, body))
    }

    /// Frames that are means over their exposure, with pose and camera of its middle.
    fn exposed(&self, body: &BodyModel) -> Result<Capture> {
        let (frames, every) = (self.demo.frames, self.demo.eval_every);
        let fine = DemoConfig { frames: frames * MOMENTS, eval_every: every * MOMENTS, ..self.demo };
        let mut capture = demo(&fine, body)?;
        let half = (self.shutter * MOMENTS as f32 / 2.0).round() as usize;
        let moments = std::mem::take(&mut capture.train);
        let pixels = moments.iter().map(Frame::pixels).collect::<Result<Vec<_>, _>>()?;
        capture.train = (0..frames)
            .map(|i| {
                let middle = i * MOMENTS;
                let exposure = &pixels[middle.saturating_sub(half)..=(middle + half).min(moments.len() - 1)];
                let mut shown = Pixels::clone(&pixels[middle]);
                let mean = |sum: &mut [f32], pick: fn(&Pixels) -> &[f32]| {
                    sum.fill(0.0);
                    for moment in exposure {
                        sum.iter_mut().zip(pick(moment)).for_each(|(s, x)| *s += x / exposure.len() as f32);
                    }
                };
                mean(&mut shown.image.pixels, |p| &p.image.pixels);
                mean(&mut shown.mask, |p| &p.mask);
                Frame { source: shown.into(), ..moments[middle].clone() }
            })
            .collect();
        capture.eval.iter_mut().for_each(|view| view.train_index /= MOMENTS);
        Ok(capture)
    }
}

/// Angle in degrees between the person's front and the direction to the camera, seen from above.
fn facing(frame: &Frame) -> f32 {
    let (rotation, at) = match frame.placement {
        Placement::Origin { rotation, translation } => (rotation, translation),
        _ => (frame.pose.first().copied().unwrap_or(Vec3::ZERO), Vec3::ZERO),
    };
    let level = |v: Vec3| Vec3::new(v.x, 0.0, v.z);
    let front = level(Quat::from_scaled_axis(rotation) * Vec3::Z);
    let eye = Vec3::from(frame.camera.world_to_camera.inverse().translation);
    front.angle_between(level(eye - at)).to_degrees()
}

/// Drops training frames, and the views of their instants.
fn keep(capture: &mut Capture, wanted: impl Fn(&Frame) -> bool) {
    let mut index = vec![None; capture.train.len()];
    let mut kept = Vec::new();
    for (i, frame) in std::mem::take(&mut capture.train).into_iter().enumerate() {
        if wanted(&frame) {
            index[i] = Some(kept.len());
            kept.push(frame);
        }
    }
    capture.train = kept;
    let views = std::mem::take(&mut capture.eval).into_iter();
    capture.eval = views
        .filter_map(|mut view| {
            view.train_index = index[view.train_index]?;
            Some(view)
        })
        .collect();
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small() -> Difficulty {
        let demo = DemoConfig { size: 24, frames: 8, eval_cameras: 1, eval_every: 2, ..DemoConfig::default() };
        Difficulty { demo, ..Difficulty::default() }
    }

    fn coverage(capture: &Capture) -> f32 {
        capture.train.iter().map(|f| f.pixels().unwrap().mask.iter().sum::<f32>()).sum()
    }

    #[test]
    fn an_exposure_smears_the_picture_and_keeps_its_sum() {
        let (sharp, _) = small().make().unwrap();
        let (smeared, _) = Difficulty { shutter: 1.0, ..small() }.make().unwrap();
        assert_eq!((smeared.train.len(), smeared.eval.len()), (sharp.train.len(), sharp.eval.len()));
        let partial = |c: &Capture| {
            let of = |f: &Frame| f.pixels().unwrap().mask.iter().filter(|m| (0.05..0.95).contains(*m)).count();
            c.train.iter().map(of).sum::<usize>()
        };
        assert!(partial(&smeared) > partial(&sharp) * 3 / 2, "{} {}", partial(&smeared), partial(&sharp));
        assert!((coverage(&smeared) / coverage(&sharp) - 1.0).abs() < 0.2);
        for (a, b) in smeared.eval.iter().zip(&sharp.eval) {
            assert_eq!(a.train_index, b.train_index);
        }
    }

    #[test]
    fn a_side_that_is_never_seen_is_left_out_and_views_stay_with_their_frames() {
        let (all, _) = small().make().unwrap();
        let (some, _) = Difficulty { facing_degrees: 80.0, ..small() }.make().unwrap();
        assert!(!some.train.is_empty() && some.train.len() < all.train.len());
        assert!(some.train.iter().all(|f| facing(f) <= 80.0));
        for view in &some.eval {
            assert_eq!(some.train[view.train_index].name, view.frame.name);
        }
        assert!(Difficulty { facing_degrees: 0.0, ..small() }.make().is_err());
    }
}
