//! The rows of the table.

use occnerf::{Component, Config, Method, OccludedRule, Preset};

/// How long a row trains.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Length {
    /// As many steps as every other row.
    Steps,
    /// Four times as many, which the paper gave HumanNeRF.
    FourTimes,
    /// As many seconds as `occnerf`.
    Seconds,
}

/// A row of the table.
#[derive(Debug)]
pub struct Row {
    /// On the command line, in the table and as a directory.
    pub name: &'static str,
    /// What is trained.
    pub method: Method,
    /// The pixel rule.
    pub occluded: OccludedRule,
    /// How long.
    pub length: Length,
    /// A component that is switched off.
    pub without: Option<Component>,
}

const fn row(name: &'static str, method: Method, occluded: OccludedRule, length: Length) -> Row {
    Row { name, method, occluded, length, without: None }
}

const fn ablation(name: &'static str, component: Component) -> Row {
    Row { without: Some(component), ..row(name, Method::Occnerf, OccludedRule::Unknown, Length::Steps) }
}

use Length::{FourTimes, Seconds, Steps};
use Method::{HashPoint, Humannerf, Occnerf, Prior};
use OccludedRule::{Background, Unknown};

/// Every row, baselines first. Row names say `bg` where hidden pixels are taught to be background.
pub const ROWS: [Row; 15] = [
    row("prior", Prior, Unknown, Steps),
    row("humannerf-bg", Humannerf, Background, Steps),
    row("humannerf-bg-4x", Humannerf, Background, FourTimes),
    row("humannerf-bg-time", Humannerf, Background, Seconds),
    row("humannerf", Humannerf, Unknown, Steps),
    row("humannerf-4x", Humannerf, Unknown, FourTimes),
    row("humannerf-time", Humannerf, Unknown, Seconds),
    row("hash-point-bg", HashPoint, Background, Steps),
    row("hash-point", HashPoint, Unknown, Steps),
    row("occnerf-bg", Occnerf, Background, Steps),
    row("occnerf", Occnerf, Unknown, Steps),
    ablation("no-surface", Component::Surface),
    ablation("no-attention", Component::Attention),
    ablation("no-completeness", Component::Completeness),
    ablation("no-perceptual", Component::Perceptual),
];

impl Row {
    /// Whether there is anything to learn, and so to repeat with another seed.
    pub fn learns(&self) -> bool {
        self.method != Method::Prior
    }

    /// Number of runs.
    pub fn runs(&self, seeds: u64) -> u64 {
        if self.learns() { seeds } else { 1 }
    }

    /// Everything but the number of steps.
    pub fn settings(&self, preset: Preset) -> Config {
        let mut config = Config { occluded: self.occluded, ..Config::preset(preset, self.method) };
        if let Some(component) = self.without {
            config.ablate(component);
        }
        config
    }
}
