//! The ways in which `bench stability` makes it hard.

use occnerf::data::DemoConfig;
use occnerf::{Config, Method, Preset};

use super::difficulty::Difficulty;
use super::job::{Job, Place};
use super::runner::{Kind, Point};

/// Training frames and scored views of the easy case.
const FRAMES: usize = 50;
const VIEWS: usize = 20;
/// Instants that are scored.
const INSTANTS: usize = 5;

/// One setting of one difficulty.
#[derive(Clone, Debug)]
pub struct Level {
    pub value: f64,
    pub difficulty: Difficulty,
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

/// The demo as all axes begin with it, `side` pixels a side.
fn easy(side: u32) -> Difficulty {
    let demo = DemoConfig { size: side, frames: FRAMES, eval_every: FRAMES / INSTANTS, ..DemoConfig::default() };
    Difficulty { demo, ..Difficulty::default() }
}

impl Axis {
    fn new(name: &'static str, unit: &'static str, values: &[f64], base: &Level, change: &dyn Fn(&mut Level)) -> Self {
        let of = |&value: &f64| {
            let mut level = Level { value, ..base.clone() };
            change(&mut level);
            level.easy = level.difficulty == base.difficulty && (level.rates, level.steps) == (1.0, 1);
            level
        };
        Self { name, unit, levels: values.iter().map(of).collect() }
    }

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
        let mut config = Config { seed, steps, ..Config::preset(Preset::Fast, method) };
        (config.patches, config.samples) = (2, 32);
        if method != Method::Prior {
            // Nothing of this means anything to the prior, which is measured once.
            config.steps *= self.steps;
            let rates = &mut config.rates;
            for rate in [&mut rates.field, &mut rates.vertices, &mut rates.table, &mut rates.motion, &mut rates.pose] {
                *rate *= self.rates;
            }
        }
        Point {
            bench: "stability".to_owned(),
            name: format!("{} {}{}", axis.name, super::scale::number(self.value), axis.unit),
            factor: axis.name.to_owned(),
            level: Some(self.value),
            kind: if self.easy { Kind::Base } else { Kind::Level },
            command: None,
            job: Job { place: Place::Made(self.difficulty), views: VIEWS, config, prune: false },
        }
    }
}

/// Every axis, of pictures `side` pixels a side; the quick form has the easy case and the hardest level of each.
pub fn all(side: u32, quick: bool) -> Vec<Axis> {
    let base = Level { value: 0.0, difficulty: easy(side), easy: true, rates: 1.0, steps: 1 };
    let axis = |name, unit, values: &[f64], change: &dyn Fn(&mut Level)| Axis::new(name, unit, values, &base, change);
    let demo = |name, unit, values: &[f64], change: &dyn Fn(&mut DemoConfig, f32)| {
        axis(name, unit, values, &|l| change(&mut l.difficulty.demo, l.value as f32))
    };
    let frames = |demo: &mut DemoConfig, frames: usize| {
        (demo.frames, demo.eval_every) = (frames, (frames / INSTANTS).max(1));
    };
    let sides = [1.0, 0.5, 0.25].map(|share| (share * f64::from(side)).round().max(16.0));
    let mut axes = vec![
        demo("hidden", " %", &[0.0, 50.0, 80.0, 95.0], &|d, v| d.occluded_fraction = v / 100.0),
        demo("frames", "", &[200.0, 50.0, 20.0, 5.0], &|d, v| frames(d, v as usize)),
        demo("pose noise", "°", &[0.0, 1.5, 5.0, 10.0], &|d, v| d.pose_noise_degrees = v),
        demo("wrong shape", " σ", &[0.15, 2.0], &|d, v| d.beta_noise = v),
        axis("mask erosion", " px", &[0.0, 2.0, 4.0], &|l| l.difficulty.erosion = l.value as u32),
        axis("motion blur", " of a frame", &[0.0, 1.0], &|l| l.difficulty.shutter = l.value as f32),
        demo("image side", " px", &sides, &|d, v| d.size = v as u32),
        axis("seen from within", "°", &[180.0, 70.0], &|l| {
            if l.value < 180.0 {
                // About as many frames are left as the easy case has.
                frames(&mut l.difficulty.demo, 2 * FRAMES);
                l.difficulty.facing_degrees = l.value as f32;
            }
        }),
        demo("limbs pressed", "", &[0.0, 1.0], &|d, v| d.pressed = v),
        axis("training", " ×", &[1.0, 4.0], &|l| l.steps = l.value as u64),
        axis("rates raised", " ×", &[1.0, 10.0, 100.0], &|l| l.rates = l.value as f32),
        axis("rates lowered", " ×", &[1.0, 0.1], &|l| l.rates = l.value as f32),
        axis("unit", " m", &[1.0, 0.01, 100.0], &|l| l.difficulty.unit = l.value as f32),
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
