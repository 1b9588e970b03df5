//! A capture made on the spot: a clothed person walks and turns before a ring of cameras.

mod clothes;
mod face;
pub(super) mod landmarks;
pub(super) mod motion;
mod outfit;
mod person;
#[cfg(test)]
mod tests;
mod texture;

use std::f32::consts::TAU;

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smpl::{BodyModel, Shaped};

use self::landmarks::joint;
pub use self::outfit::Outfit;

use self::motion::{Pose, TrackerError, track, walk};
use self::person::Person;
use self::texture::{Dress, albedo};
use crate::film::render::{Lamp, Posture};
use crate::film::stage::{Progress, Stage, ring};
use crate::obstacle::Obstacle;
use capture::{Capture, CaptureError, Frame};
use volrender::RandomStream;

/// Shape coefficients of the person and of the tracker's guess that are not zero.
const BETAS: usize = 6;
/// Settings of the demo. The default is the one that figures are quoted for.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DemoConfig {
    /// Pixels a side, 16 to 2048.
    pub size: u32,
    /// Frames of the training video, 1 to 10 000. However many, they show the same walk.
    pub frames: usize,
    /// Cameras kept back for evaluation, evenly around the person, with the training camera midway
    /// between the first and the last of them: for five, 36° off it and 72° apart. At most 64.
    pub eval_cameras: usize,
    /// Evaluation cameras see one frame in this many, beginning with the first.
    pub eval_every: usize,
    /// Decides the person's shape, clothes and light, and the errors of the prior.
    pub seed: u64,
    /// Strength of the light that comes from one side, 0 (as much from everywhere) to 1.
    pub lamp: f32,
    /// Root mean square error of each bone's orientation in the prior, degrees.
    pub pose_noise_degrees: f32,
    /// Root mean square error of the prior's position, metres of a person 1.7 m tall.
    pub translation_noise: f32,
    /// Standard deviation of the prior's error in each shape coefficient.
    pub beta_noise: f32,
    /// Part of the subject's pixels in the occluded frames that are hidden, 0 (no obstacle) to
    /// 0.95.
    pub occluded_fraction: f32,
    /// Part of the training video, from its start, that is occluded, 0 to 1.
    pub occluded_share: f32,
    /// How far arms and legs are pressed against the body and each other, 0 (a free walk) to 1.
    pub pressed: f32,
    /// What the person wears over its clothes.
    pub outfit: Outfit,
    /// Whether the hands are fists; the prior's are flat.
    pub fist: bool,
    /// Whether training frames say which pixels the obstacle covers. Published captures do not.
    pub known_occluder: bool,
}

impl Default for DemoConfig {
    fn default() -> Self {
        Self {
            size: 192,
            frames: 100,
            eval_cameras: 5,
            eval_every: 10,
            seed: 0,
            lamp: 1.0,
            pose_noise_degrees: 1.5,
            translation_noise: 0.005,
            beta_noise: 0.15,
            occluded_fraction: 0.5,
            occluded_share: 0.8,
            pressed: 0.0,
            outfit: Outfit::Plain,
            fist: false,
            known_occluder: false,
        }
    }
}

impl DemoConfig {
    pub(super) fn check(&self) -> Result<(), CaptureError> {
        let within = |name, ok: bool, expected: &str, actual: &dyn ToString| {
            if ok { Ok(()) } else { Err(CaptureError::setting(name, expected, actual.to_string())) }
        };
        let size = &self.size;
        within("size", (16..=2048).contains(size), "16 to 2048 pixels", size)?;
        within("frames", (1..=10_000).contains(&self.frames), "1 to 10000", &self.frames)?;
        within("eval_cameras", self.eval_cameras <= 64, "at most 64", &self.eval_cameras)?;
        within("eval_every", self.eval_every > 0, "at least 1", &self.eval_every)?;
        for (name, value, limit) in [
            ("lamp", self.lamp, 1.0),
            ("pose_noise_degrees", self.pose_noise_degrees, 45.0),
            ("translation_noise", self.translation_noise, 1.0),
            ("beta_noise", self.beta_noise, 3.0),
            ("occluded_fraction", self.occluded_fraction, 0.95),
            ("occluded_share", self.occluded_share, 1.0),
            ("pressed", self.pressed, 1.0),
        ] {
            within(name, (0.0..=limit).contains(&value), &format!("0 to {limit}"), &value)?;
        }
        Ok(())
    }
}

/// Makes a video of a clothed person who walks and turns, occluded as in the paper's simulation,
/// with views of the same instants from other sides.
///
/// The person is `body` with a shape of its own, in clothes that stand 1 to 3 cm off it and that
/// the body model knows nothing of. The returned poses and betas are not the true ones but a
/// tracker's, with the errors of `config`; training and evaluation frames of one instant share
/// them. Pictures are anti-aliased: the mask is the share of 4 rays a pixel that meet the person,
/// the colour is on black. An obstacle as high as the picture covers the middle of the training
/// view in the first frames. The result depends on `config` and `body` alone, not on the number of
/// threads.
///
/// # Errors
/// [`CaptureError::Setting`] for values outside the stated ranges, and for a body without SMPL's 24
/// joints.
pub fn demo(config: &DemoConfig, body: &BodyModel) -> Result<Capture, CaptureError> {
    config.check()?;
    let joints = body.num_joints();
    if joints != joint::COUNT {
        return Err(CaptureError::setting("body", "SMPL's 24 joints", joints));
    }
    let mut capture = film(config, body, grounded_walk, &|_| {})?.0;
    occlude(&mut capture.train, config)?;
    Ok(capture)
}

/// The demo before anything stands in front of it, and the height that the cameras stand for.
/// `perform` gives the poses for a body of that shape, and that height.
pub(super) fn film(
    config: &DemoConfig,
    body: &BodyModel,
    perform: impl FnOnce(&DemoConfig, &BodyModel, &Shaped) -> (Vec<Pose>, f32),
    progress: &Progress<'_>,
) -> Result<(Capture, f32), CaptureError> {
    let (true_betas, betas) = shapes(config, body);
    let shaped = body.shaped(&true_betas);
    let person = Person::new(body, &shaped, config.outfit, config.fist);
    let (poses, height) = perform(config, body, &shaped);
    let error = TrackerError {
        seed: config.seed,
        rotation: config.pose_noise_degrees.to_radians(),
        translation: config.translation_noise * person.landmarks.unit,
    };
    let stage = Stage {
        cameras: ring(config.size, config.eval_cameras, height)?,
        eval_every: config.eval_every,
        priors: track(&poses, &body.parents, shaped.joints[joint::PELVIS], error),
        betas,
        progress,
    };
    let (dress, lamp) = (Dress::new(config.seed), Lamp::new(config.lamp, config.seed));
    let color = |face: u32, weights: [f32; 3]| {
        let corners = person.faces[face as usize].iter().zip(weights);
        let rest = corners.map(|(&v, w)| person.rest[v as usize] * w).sum();
        Some(match (face as usize) < person.sheets {
            true => albedo(&person.landmarks, &dress, rest),
            false => outfit::color(config.outfit, person.landmarks.figure(rest)),
        })
    };
    let capture = stage.film("demo", |i| {
        let posed = body.pose(&shaped, &poses[i].joints, poses[i].placement());
        let vertices = person.posed(&posed);
        let normals = surface_query::vertex_normals(&vertices, &person.faces);
        Posture::new(vertices, normals, &person.faces, &color, lamp)
    })?;
    Ok((capture, height))
}

/// The person's betas, and the tracker's.
fn shapes(config: &DemoConfig, body: &BodyModel) -> (Vec<f32>, Vec<f32>) {
    let count = body.num_betas().min(BETAS);
    let mut stream = RandomStream::new(&[config.seed, 0x6265_7461]);
    let truth: Vec<f32> = (0..count).map(|_| 1.6 * stream.uniform() - 0.8).collect();
    let guess = truth.iter().map(|b| b + config.beta_noise * stream.normal()).collect();
    (truth, guess)
}

/// The walk with the lower foot on the floor at y = 0, and a slight sway.
pub(super) fn grounded_walk(config: &DemoConfig, body: &BodyModel, shaped: &Shaped) -> (Vec<Pose>, f32) {
    let (pelvis, frames) = (shaped.joints[joint::PELVIS], config.frames);
    let lowest = shaped.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
    let high = shaped.vertices.iter().map(|v| v.y).fold(f32::NEG_INFINITY, f32::max);
    let poses = (0..frames)
        .into_par_iter()
        .map(|frame| {
            let mut pose = walk(frame, frames, config.pressed);
            let posed = body.pose(shaped, &pose.joints, pose.placement());
            let low = posed.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
            let turn = TAU * frame as f32 / frames as f32;
            let sway = Vec3::new(turn.sin(), 0.0, (2.0 * turn).sin()) * (0.035 * (high - low));
            let centred = pose.rotation * pelvis;
            pose.translation = Vec3::new(-centred.x, -low, -centred.z) + sway;
            pose
        })
        .collect();
    (poses, high - lowest)
}

/// Puts the obstacle in front of the first frames.
fn occlude(train: &mut [Frame], config: &DemoConfig) -> Result<(), CaptureError> {
    let obstacle = Obstacle { fraction: config.occluded_fraction, share: config.occluded_share, ..Obstacle::default() };
    let areas = obstacle.hide(train)?;
    if config.known_occluder {
        for (frame, hidden) in train.iter_mut().zip(areas) {
            let size = config.size;
            frame.source.edit(move |pixels| {
                let covered = (0..pixels.mask.len()).map(|p| hidden.contains(p, size)).collect();
                pixels.occluder = Some(covered);
            });
        }
    }
    Ok(())
}
