//! The ways in which `bench stability` makes it hard.

use crate::scene::SceneOptions;
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
#[derive(Clone, Debug)]
pub struct Level {
    pub value: f64,
    pub place: Place,
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
            job: Job::new(self.place.clone(), VIEWS, method, config),
        }
    }
}

/// What a level may change: the capture, as `T` describes it, and how long and at which rates it is
/// trained on.
#[derive(Clone, PartialEq)]
struct Case<T> {
    capture: T,
    rates: f32,
    steps: u64,
}

/// Makes axes around an easy case.
struct Around<T> {
    easy: Case<T>,
    place: Box<dyn Fn(T) -> Place>,
}

impl<T: Clone + PartialEq> Around<T> {
    fn new(capture: T, place: impl Fn(T) -> Place + 'static) -> Self {
        Self { easy: Case { capture, rates: 1.0, steps: 1 }, place: Box::new(place) }
    }

    fn axis(&self, name: &'static str, unit: &'static str, values: &[f64], change: impl Fn(&mut Case<T>, f64)) -> Axis {
        let level = |&value: &f64| {
            let mut case = self.easy.clone();
            change(&mut case, value);
            let easy = case == self.easy;
            Level { value, place: (self.place)(case.capture), easy, rates: case.rates, steps: case.steps }
        };
        Axis { name, unit, levels: values.iter().map(level).collect() }
    }

    /// The axes of training, which any capture has.
    fn training(&self) -> [Axis; 3] {
        [
            self.axis("training", " ×", &[1.0, 4.0], |c, v| c.steps = v as u64),
            self.axis("rates raised", " ×", &[1.0, 10.0, 100.0], |c, v| c.rates = v as f32),
            self.axis("rates lowered", " ×", &[1.0, 0.1], |c, v| c.rates = v as f32),
        ]
    }
}

/// Sides of pictures, `side` and less.
fn sides(side: u32) -> [f64; 3] {
    [1.0, 0.5, 0.25].map(|share| (share * f64::from(side)).round().max(16.0))
}

fn shortened(mut axes: Vec<Axis>, quick: bool) -> Vec<Axis> {
    if quick {
        axes.iter_mut().for_each(Axis::shorten);
    }
    axes
}

/// Every axis of the demo, of pictures `side` pixels a side; the quick form has the easy case and
/// the hardest level of each.
pub fn of_demo(side: u32, quick: bool) -> Vec<Axis> {
    let demo = DemoConfig { size: side, frames: FRAMES, eval_every: FRAMES / INSTANTS, ..DemoConfig::default() };
    let around = Around::new(Difficulty { demo, ..Difficulty::default() }, Place::Made);
    let demo = |name, unit, values: &[f64], change: &dyn Fn(&mut DemoConfig, f32)| {
        around.axis(name, unit, values, |c, v| change(&mut c.capture.demo, v as f32))
    };
    let made = |name, unit, values: &[f64], change: &dyn Fn(&mut Difficulty, f32)| {
        around.axis(name, unit, values, |c, v| change(&mut c.capture, v as f32))
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
    ];
    axes.extend(around.training());
    shortened(axes, quick)
}

/// Every axis of a capture on disk, read as `load` says, pictures reduced to `side` pixels unless
/// `load` says otherwise. `obstacle`: whether its layout leaves open what hides the person.
pub fn of_capture(place: &Place, side: u32, obstacle: bool, quick: bool) -> Vec<Axis> {
    let Place::Scene { scene, body, load } = place.clone() else { return Vec::new() };
    let mut load = load;
    let side = *load.files.resize.get_or_insert(side);
    if obstacle {
        load.corruption.occlusion.get_or_insert_default();
    }
    let around = Around::new(load, move |load| Place::Scene { scene: scene.clone(), body: body.clone(), load });
    let axis = |name, unit, values: &[f64], change: &dyn Fn(&mut SceneOptions, f32)| {
        around.axis(name, unit, values, |c, v| change(&mut c.capture, v as f32))
    };
    let mut axes = Vec::new();
    if obstacle {
        let fraction = |load: &mut SceneOptions, v: f32| {
            load.corruption.occlusion.iter_mut().for_each(|obstacle| obstacle.fraction = v / 100.0);
        };
        axes.push(axis("hidden", " %", &[0.0, 50.0, 80.0, 95.0], &fraction));
    }
    axes.extend([
        axis("one frame of", "", &[1.0, 5.0, 20.0], &|l, v| l.files.stride *= v as usize),
        axis("pose noise", "°", &[0.0, 1.5, 5.0, 10.0], &|l, v| l.corruption.wrong.pose_degrees = v),
        axis("wrong shape", " σ", &[0.0, 2.0], &|l, v| l.corruption.wrong.shape = v),
        axis("mask erosion", " px", &[0.0, 2.0, 4.0], &|l, v| l.corruption.wrong.mask_pixels = -(v as i32)),
        axis("mask growth", " px", &[0.0, 4.0], &|l, v| l.corruption.wrong.mask_pixels = v as i32),
        axis("image side", " px", &sides(side), &|l, v| l.files.resize = Some(v as u32)),
    ]);
    axes.extend(around.training());
    shortened(axes, quick)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_axis_has_the_easy_case_and_a_harder_one() {
        let mut load = SceneOptions::default();
        load.files.stride = 2;
        let capture = Place::Scene { scene: "somewhere".to_owned(), body: None, load };
        for (quick, on_disk) in [(false, false), (true, false), (false, true), (true, true)] {
            let axes = if on_disk { of_capture(&capture, 96, true, quick) } else { of_demo(96, quick) };
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
        assert!(of_capture(&capture, 96, false, false).iter().all(|axis| axis.name != "hidden"));
    }
}
