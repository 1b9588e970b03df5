//! Settings of a synthetic capture.

use serde::{Deserialize, Serialize};

use crate::demo::{DemoConfig, Outfit};
use crate::obstacle::Obstacle;
use capture::CaptureError;
use capture::PIXEL_BYTES;

/// Limit on the size of all pictures before they are packed, which leaves a small part.
const MOST_BYTES: u64 = 32 << 30;

/// What stands in front of the person in the training view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Occlusion {
    /// The paper's rectangle.
    Rectangle(Obstacle),
    /// A desk and two pillars of 3-D geometry, lit as the person is, before a room; in every frame.
    Objects {
        /// Part of the person's pixels that is hidden, 0 to 0.95: the objects are as wide as that
        /// takes.
        fraction: f32,
        /// How far they stand to the right of the person, in picture widths, −1 to 1.
        position: f32,
    },
}

/// Settings of a synthetic capture. The default gives the demo's.
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
    /// Decides the light, the embedded person's shape and clothes, and the errors of the prior.
    pub seed: u64,
    /// Strength of the light that comes from one side, 0 (as much from everywhere) to 1.
    pub lamp: f32,
    /// Root mean square error of each bone's orientation in the prior, degrees, 0 to 45.
    pub pose_noise_degrees: f32,
    /// Error of the prior's shape relative to the usual one, 0 to 3. At 1 the embedded person's
    /// coefficients are off by 0.15 (standard deviation), beside the clothes; the prior of a
    /// character lies 1 to 3 cm inside it.
    pub shape_noise: f32,
    /// Full turns added over the video to the motion of a clip or a character, −10 to 10, so that
    /// all sides are seen.
    pub turns: f32,
    /// What the embedded person wears over its clothes.
    pub outfit: Outfit,
    /// Whether the embedded person's hands are fists.
    pub fist: bool,
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
            lamp: demo.lamp,
            pose_noise_degrees: demo.pose_noise_degrees,
            shape_noise: 1.0,
            turns: 1.15,
            outfit: demo.outfit,
            fist: demo.fist,
            occlusion: Occlusion::Rectangle(Obstacle::default()),
        }
    }
}

impl SynthConfig {
    /// The demo of the same settings, nothing occluded.
    pub(super) fn demo(&self) -> DemoConfig {
        let usual = DemoConfig::default();
        DemoConfig {
            size: self.size,
            frames: self.frames,
            eval_cameras: self.eval_cameras,
            eval_every: self.eval_every,
            seed: self.seed,
            lamp: self.lamp,
            pose_noise_degrees: self.pose_noise_degrees,
            beta_noise: usual.beta_noise * self.shape_noise,
            occluded_fraction: 0.0,
            outfit: self.outfit,
            fist: self.fist,
            ..usual
        }
    }

    pub(super) fn check(&self) -> Result<(), CaptureError> {
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
        let views = self.frames + self.frames.div_ceil(self.eval_every) * self.eval_cameras;
        let bytes = (views as u64).saturating_mul(u64::from(self.size).pow(2) * PIXEL_BYTES);
        if bytes > MOST_BYTES {
            let expected =
                format!("at most {} GiB of pixels (fewer frames or views, or a smaller size)", MOST_BYTES >> 30);
            let actual = format!("{} GiB in {views} pictures of {1}×{1}", bytes >> 30, self.size);
            return Err(CaptureError::setting("frames", expected, actual));
        }
        Ok(())
    }
}
