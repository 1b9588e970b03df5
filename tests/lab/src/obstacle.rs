//! The simulated obstacle on the command line.

use anyhow::{Result, ensure};
use clap::{Args, ValueEnum};
use synth::Obstacle;

/// How far a moving obstacle moves to the right over the video, in picture widths.
const TRAVEL: f32 = 0.3;

/// A simulated obstacle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ObstacleName {
    /// No obstacle.
    None,
    /// The paper's: half of the person on four fifths of the frames.
    Central,
    /// The same, moving by three tenths of the picture.
    Moving,
}

/// Where the simulated obstacle stands, and how large it is.
#[derive(Args, Clone, Debug, serde::Serialize)]
pub struct ObstacleArguments {
    /// Part of the person's pixels that is hidden in the frames that the obstacle stands in, no
    /// more than its rows have [default: 0.5]
    #[arg(long, value_name = "0 to 0.95")]
    pub fraction: Option<f32>,
    /// Part of the video, from its start, that it stands in [default: 0.8]; objects stand in all of
    /// it
    #[arg(long, value_name = "0 to 1")]
    pub share: Option<f32>,
    /// How far it stands to the right of the person, in picture widths [default: 0]
    #[arg(long, value_name = "-1 to 1", allow_negative_numbers = true)]
    pub position: Option<f32>,
    /// How high it is, in picture heights, about the person's middle row [default: 1, a strip as
    /// high as the picture]
    #[arg(long, value_name = "above 0 to 1")]
    pub height: Option<f32>,
}

impl ObstacleArguments {
    /// Whether anything was asked for.
    pub fn given(&self) -> bool {
        self.fraction.or(self.share).or(self.position).or(self.height).is_some()
    }

    /// The obstacle of this name, but for what was asked for.
    pub fn named(&self, name: ObstacleName) -> Result<Obstacle> {
        let (none, paper) = (name == ObstacleName::None, Obstacle::default());
        ensure!(!(none && self.given()), "--occlusion none has no --fraction, --share, --position or --height");
        Ok(Obstacle {
            fraction: self.fraction.unwrap_or(if none { 0.0 } else { paper.fraction }),
            share: self.share.unwrap_or(paper.share),
            position: self.position.unwrap_or(paper.position),
            height: self.height.unwrap_or(paper.height),
            travel: if name == ObstacleName::Moving { TRAVEL } else { paper.travel },
        })
    }
}
