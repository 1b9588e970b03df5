//! The ways in which `bench stability` makes it hard.

use occnerf::{Config, Preset};
use synth::DemoConfig;

use super::difficulty::Difficulty;
use crate::methods::{Method, scale_rates};
use crate::sweep::{Job, Kind, Place, Point};

/// Training frames and scored views of the easy case.
const FRAMES: usize = 50;
const VIEWS: usize = 20;
/// Instants that are scored.
const INSTANTS: usize = 5;

/// One setting of one difficulty.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    pub value: f64,
    pub made: Difficulty,
    /// Whether this is the case that all axes share.
    pub easy: bool,
    /// Factor on every learning rate.
    pub rates: f32,
    /// Factor on the number of steps.
    pub steps: u64,
}

/// One way to make it hard: the easiest level first, the easy case that all share among them.
pub struct Axis {
    pub name: &'static str,
    pub unit: &'static str,
    pub levels: Vec<Level>,
}

impl Axis {
    /// Leaves the easy case and the hardest level.
    fn shorten(&mut self) {
        let hardest = self.levels.pop();
        self.levels.retain(|level| level.easy);
        self.levels.extend(hardest);
    }
}

impl Level {
    /// The run of a method.
    pub fn point(&self, axis: &Axis, method: Method, steps: u64, seed: u64) -> Point {
        let mut config = Config { seed, steps, ..method.preset(Preset::Fast) };
        (config.patches, config.samples) = (2, 32);
        if method.has_field() {
            // Nothing of this means anything to what trains no field.
            config.steps *= self.steps;
            scale_rates(&mut config.rates, self.rates);
        }
        Point {
            bench: "stability".to_owned(),
            name: format!("{} {}{}", axis.name, xtask::scale::number(self.value), axis.unit),
            factor: axis.name.to_owned(),
            level: Some(self.value),
            kind: if self.easy { Kind::Base } else { Kind::Level },
            command: None,
            job: Job::new(Place::Made(self.made), VIEWS, method, config),
        }
    }
}

/// The axis of these values, in a way that `change` describes: of the difficulty, of the factor on
/// every learning rate, or of that on the number of steps.
fn axis(
    easy: Difficulty,
    name: &'static str,
    unit: &'static str,
    values: &[f64],
    change: impl Fn(&mut Level, f64),
) -> Axis {
    let usual = Level { value: 0.0, made: easy, easy: true, rates: 1.0, steps: 1 };
    let level = |&value: &f64| {
        let mut level = usual.clone();
        change(&mut level, value);
        Level { value, easy: level == usual, ..level }
    };
    Axis { name, unit, levels: values.iter().map(level).collect() }
}

/// Sides of pictures, `side` and less.
fn sides(side: u32) -> [f64; 3] {
    [1.0, 0.5, 0.25].map(|share| (share * f64::from(side)).round().max(16.0))
}

/// Every axis of the demo, of pictures `side` pixels a side; the quick form has the easy case and
/// the hardest level of each.
pub fn all(side: u32, quick: bool) -> Vec<Axis> {
    let demo = DemoConfig { size: side, frames: FRAMES, eval_every: FRAMES / INSTANTS, ..DemoConfig::default() };
    let easy = Difficulty { demo, ..Difficulty::default() };
    let demo = |name, unit, values: &[f64], change: &dyn Fn(&mut DemoConfig, f32)| {
        axis(easy, name, unit, values, |level, v| change(&mut level.made.demo, v as f32))
    };
    let made = |name, unit, values: &[f64], change: &dyn Fn(&mut Difficulty, f32)| {
        axis(easy, name, unit, values, |level, v| change(&mut level.made, v as f32))
    };
    let frames = |demo: &mut DemoConfig, frames: usize| {
        (demo.frames, demo.eval_every) = (frames, (frames / INSTANTS).max(1));
    };
    let mut axes = vec![
        demo("hidden", " %", &[0.0, 50.0, 80.0, 95.0], &|d, v| d.occluded_fraction = v / 100.0),
        demo("frames", "", &[200.0, 50.0, 20.0, 5.0], &|d, v| frames(d, v as usize)),
        demo("pose noise", "°", &[0.0, 1.5, 5.0, 10.0], &|d, v| d.pose_noise_degrees = v),
        demo("wrong shape", " σ", &[0.15, 2.0], &|d, v| d.beta_noise = v),
        made("mask erosion", " px", &[0.0, 2.0, 4.0], &|d, v| d.wrong.mask_pixels = -(v as i32)),
        made("motion blur", " of a frame", &[0.0, 1.0], &|d, v| d.shutter = v),
        demo("image side", " px", &sides(side), &|d, v| d.size = v as u32),
        made("seen from within", "°", &[180.0, 70.0], &|d, v| {
            if v < 180.0 {
                // About as many frames are left as the easy case has.
                frames(&mut d.demo, 2 * FRAMES);
                d.facing_degrees = v;
            }
        }),
        demo("limbs pressed", "", &[0.0, 1.0], &|d, v| d.pressed = v),
        axis(easy, "training", " ×", &[1.0, 4.0], |level, v| level.steps = v as u64),
        axis(easy, "rates raised", " ×", &[1.0, 10.0, 100.0], |level, v| level.rates = v as f32),
        axis(easy, "rates lowered", " ×", &[1.0, 0.1], |level, v| level.rates = v as f32),
    ];
    if quick {
        axes.iter_mut().for_each(Axis::shorten);
    }
    axes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_axis_has_the_easy_case_and_a_harder_one() {
        for quick in [false, true] {
            let axes = all(96, quick);
            assert!(axes.len() > 8);
            for axis in &axes {
                assert_eq!(axis.levels.iter().filter(|l| l.easy).count(), 1, "{}", axis.name);
                assert!(!axis.levels[axis.levels.len() - 1].easy, "{}", axis.name);
                assert!(!quick || axis.levels.len() == 2, "{}", axis.name);
            }
            let levels: usize = axes.iter().map(|a| a.levels.len() - 1).sum();
            // Ours everywhere and two peers at the hardest levels, with the easy case of all three.
            assert!(levels + 2 * axes.len() + 3 <= 56, "{levels}");
        }
    }
}
