//! The sweep of `bench pareto`: one factor at a time, then what is worth combining.

use anyhow::Result;
use occnerf::{Config, Preset};

use crate::methods::Method;
use crate::sweep::{Job, Kind, Line, Place, Point};
use xtask::settings;

/// One change of one factor.
pub struct Change {
    pub factor: &'static str,
    pub name: &'static str,
    /// As `train --set` takes it.
    pub set: &'static [&'static str],
    /// Whether the quick form has it.
    pub quick: bool,
}

const fn change(factor: &'static str, name: &'static str, set: &'static [&'static str], quick: bool) -> Change {
    Change { factor, name, set, quick }
}

/// Every change but of the number of steps, most telling first.
pub const CHANGES: [Change; 22] = [
    change("registration", "no registration", &["registration.rounds=0"], true),
    change("light", "even light", &["field.prior_light=false"], false),
    change("distance", "blended distance", &["surface.distance=blended"], true),
    change(
        "motion",
        "volume motion, grey, every sample",
        &["motion.kind=volume", "motion.shell_interval=0", "field.prior_colors=false"],
        true,
    ),
    change("span", "every sample", &["motion.shell_interval=0", "min_transmittance=0"], false),
    change("colours", "colours from grey", &["field.prior_colors=false"], true),
    change("samples", "48 samples", &["samples=48"], true),
    change("samples", "192 samples", &["samples=192"], false),
    change("span", "span 6 cm", &["motion.margin=0.06", "motion.depth=0.06"], false),
    change("surface term", "surface term", &["surface.surface_term=true"], true),
    change("neighbours", "k 1", &["surface.surface_term=true", "surface.k=1"], false),
    change("neighbours", "4 levels", &["surface.surface_term=true", "surface.coarse_levels=3"], true),
    change("attention", "attention", &["surface.surface_term=true", "surface.attention=true"], true),
    change("table", "table 2^13", &["encoding.log2_table_size=13"], true),
    change("table", "table 2^19", &["encoding.log2_table_size=19"], false),
    change("resolution", "6 levels", &["encoding.levels=6"], false),
    change("features", "4 features", &["encoding.features=4"], false),
    change("field", "width 32", &["field.width=32"], true),
    change("field", "width 128", &["field.width=128"], false),
    change("depth", "depth 1", &["field.depth=1"], false),
    change("rates", "rates / 3", &["rates.field=2e-3", "rates.table=1e-2"], true),
    change("loss", "no perceptual term", &["loss.perceptual=0"], true),
];

/// The baked base: with four samples a pixel, as `render --baked` draws, and with one.
const BAKED: [(&str, bool); 2] = [("baked, four a pixel", true), ("baked, one a pixel", false)];

/// A change that loses less than this, in dB, can be part of the lean combination, and one that
/// gains more of the rich.
const NOTHING: f64 = 0.03;
/// A change that takes more than this part of the base's time does not save any.
const SAVING: f64 = 0.98;

/// What the sweep is made of.
pub struct Sweep {
    pub place: Place,
    /// Arguments that make `train` read the same capture.
    pub scene_arguments: String,
    pub views: usize,
    /// Of the base and its changes.
    pub steps: u64,
    /// Steps of the base at which presets run their own number of steps.
    pub full_steps: u64,
    pub quick: bool,
}

/// Settings on top of a preset.
pub struct Setting<'a> {
    pub preset: Preset,
    pub method: Method,
    pub steps: u64,
    pub set: &'a [&'a str],
}

impl Sweep {
    /// A point of `bench pareto`.
    pub fn point(&self, name: &str, factor: &str, kind: Kind, setting: &Setting<'_>) -> Result<Point> {
        let Setting { preset, method, steps, set } = *setting;
        let mut config = Config { steps, seed: 1, ..method.preset(preset) };
        for assignment in set {
            config = settings::set(&config, assignment)?;
        }
        config.validate()?;
        let mut command = format!(
            "cargo xtask train{} --preset {} --method {} --seed 1",
            self.scene_arguments,
            preset.name(),
            method.name()
        );
        if method.has_field() {
            command.push_str(&format!(" --steps {steps}"));
        }
        set.iter().for_each(|assignment| command.push_str(&format!(" --set {assignment}")));
        Ok(Point {
            bench: "pareto".to_owned(),
            name: name.to_owned(),
            factor: factor.to_owned(),
            level: None,
            kind,
            command: method.is_product().then_some(command),
            job: Job::new(self.place.clone(), self.views, method, config),
        })
    }

    /// Everything that does not depend on what others gave.
    pub fn first(&self) -> Result<Vec<Point>> {
        let fast = |method, steps, set| Setting { preset: Preset::Fast, method, steps, set };
        let own = |kind, factor: &str, name: &str, method, steps, set: &'static [&'static str]| {
            self.point(name, factor, kind, &fast(method, steps, set))
        };
        let steps = self.steps;
        let mut points = vec![own(Kind::Base, "base", "base", Method::Occnerf, steps, &[])?];
        for method in [Method::Prior, Method::Surface, Method::HashPoint, Method::Humannerf] {
            points.push(own(Kind::Baseline, "method", method.name(), method, steps, &[])?);
        }
        for (name, steps) in [("half the steps", steps.div_ceil(2)), ("twice the steps", 2 * steps)] {
            points.push(own(Kind::Change, "steps", name, Method::Occnerf, steps, &[])?);
        }
        for change in CHANGES.iter().filter(|c| c.quick || !self.quick) {
            points.push(own(Kind::Change, change.factor, change.name, Method::Occnerf, steps, change.set)?);
        }
        for (name, smooth) in BAKED {
            let mut point = own(Kind::Baked, "baked", name, Method::Occnerf, steps, &[])?;
            (point.job.bake, point.command) = (Some(smooth), None);
            points.push(point);
        }
        // A tenth of the steps of `paper`: all of them take as long as much of the sweep.
        for (preset, divisor) in [(Preset::Fast, 1), (Preset::Balanced, 1), (Preset::Paper, 10)] {
            let whole = Method::Occnerf.preset(preset).steps;
            let steps = (whole * self.steps / (self.full_steps * divisor)).max(1);
            let name = if steps == whole {
                preset.name().to_owned()
            } else {
                format!("{}, {steps} of {whole} steps", preset.name())
            };
            let setting = Setting { preset, method: Method::Occnerf, steps, set: &[] };
            let point = self.point(&name, "preset", Kind::Preset, &setting)?;
            // Presets that differ by their steps alone are the base, and a change of its steps.
            let same = |p: &&mut Point| {
                p.job.bake.is_none()
                    && p.job.config == Config { preset: p.job.config.preset, ..point.job.config.clone() }
            };
            match points.iter_mut().find(same) {
                Some(same) => {
                    same.name = format!("{name} ({})", same.name);
                    same.command = point.command;
                    if same.kind != Kind::Base {
                        same.kind = Kind::Preset;
                    }
                }
                None => points.push(point),
            }
        }
        Ok(points)
    }

    /// The best combinations of single changes: `lean` takes of each factor the fastest that loses
    /// nothing, `rich` the one that gains most, `lean and rich` both, gain before speed. None where
    /// they would be a point there is.
    pub fn combinations(&self, lines: &[Line]) -> Result<Vec<Point>> {
        let Some(base) = lines.iter().find(|l| l.point.kind == Kind::Base) else { return Ok(Vec::new()) };
        let tried: Vec<(&Change, f64, f64)> = CHANGES
            .iter()
            .filter_map(|change| {
                let line = lines.iter().find(|l| l.point.kind == Kind::Change && l.point.name == change.name)?;
                let gain = worth(line)? - worth(base)?;
                Some((change, gain, line.outcome.train_seconds / base.outcome.train_seconds))
            })
            .collect();
        let of_factor = |wanted: &dyn Fn(f64, f64) -> bool, rank: &dyn Fn(f64, f64) -> f64| -> Vec<&Change> {
            let mut best: Vec<(&Change, f64)> = Vec::new();
            for &(change, gain, time) in tried.iter().filter(|t| wanted(t.1, t.2)) {
                let rank = rank(gain, time);
                match best.iter_mut().find(|(b, _)| b.factor == change.factor) {
                    Some(old) if old.1 < rank => *old = (change, rank),
                    Some(_) => {}
                    None => best.push((change, rank)),
                }
            }
            best.into_iter().map(|(change, _)| change).collect()
        };
        let lean = of_factor(&|gain, time| gain >= -NOTHING && time < SAVING, &|_, time| -time);
        let rich = of_factor(&|gain, _| gain > NOTHING, &|gain, _| gain);
        let mut both = rich.clone();
        both.extend(lean.iter().copied().filter(|l| rich.iter().all(|r| r.factor != l.factor)));
        let mut points: Vec<Point> = Vec::new();
        for (name, changes) in [("lean", lean), ("rich", rich), ("lean and rich", both)] {
            let set: Vec<&str> = changes.iter().flat_map(|c| c.set.iter().copied()).collect();
            let setting = Setting { preset: Preset::Fast, method: Method::Occnerf, steps: self.steps, set: &set };
            let point = self.point(name, "combination", Kind::Combination, &setting)?;
            if changes.len() > 1 && points.iter().all(|p| p.job.config != point.job.config) {
                points.push(point);
            }
        }
        Ok(points)
    }
}

/// What combinations go by: the mean of the two quantities that methods are ranked by, dB.
pub fn worth(line: &Line) -> Option<f64> {
    Some(0.5 * (line.outcome.psnr_mask? + line.outcome.psnr_hidden?))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;
    use crate::bench::Difficulty;
    use crate::sweep::tests::line;

    fn sweep(quick: bool) -> Sweep {
        let place = Place::Made(Difficulty::default());
        Sweep { place, scene_arguments: String::new(), views: 5, steps: 400, full_steps: 400, quick }
    }

    #[test]
    fn every_point_is_valid_has_a_name_of_its_own_and_a_command() {
        for quick in [false, true] {
            let points = sweep(quick).first().unwrap();
            // "About 25 runs of the fast kind", beside presets and baselines.
            let fast = points.iter().filter(|p| matches!(p.kind, Kind::Base | Kind::Change)).count();
            assert!(fast <= if quick { 15 } else { 25 }, "{fast}");
            for (i, a) in points.iter().enumerate() {
                assert!(points[..i].iter().all(|b| b.name != a.name && b.job != a.job), "{}", a.name);
                assert!(a.command.as_ref().is_none_or(|c| c.contains(a.job.method.name())));
                assert!(a.command.is_some() || a.job.bake.is_some() || !a.job.method.is_product());
            }
            for (preset, kind) in [("fast", Kind::Base), ("balanced", Kind::Preset), ("paper", Kind::Preset)] {
                assert!(points.iter().any(|p| p.kind == kind && p.name.starts_with(preset)), "{preset}");
            }
        }
    }

    #[test]
    fn all_baked_points_are_of_the_base() {
        for quick in [false, true] {
            let points = sweep(quick).first().unwrap();
            let base = points.iter().find(|p| p.kind == Kind::Base).unwrap();
            let baked: Vec<&Point> = points.iter().filter(|p| p.kind == Kind::Baked).collect();
            assert_eq!(baked.len(), BAKED.len());
            assert!(baked.iter().all(|p| p.job.config == base.job.config && p.job.bake.is_some()));
        }
    }

    #[test]
    fn combinations_take_what_loses_nothing_and_what_gains() {
        let lines = [
            line("base", "base", Kind::Base, 20.0, 10.0),
            line("48 samples", "samples", Kind::Change, 20.0, 6.0),
            line("width 32", "field", Kind::Change, 19.0, 5.0),
            line("k 1", "neighbours", Kind::Change, 20.0, 9.0),
            line("4 features", "features", Kind::Change, 20.5, 12.0),
            line("surface term", "surface term", Kind::Change, 20.2, 9.0),
        ];
        let points = sweep(false).combinations(&lines).unwrap();
        let set = |name: &str| &points.iter().find(|p| p.name == name).unwrap().job.config;
        let lean = set("lean");
        assert_eq!((lean.samples, lean.surface.k, lean.surface.coarse_levels), (48, 1, 0));
        assert_eq!((lean.field.width, lean.encoding.features), (64, 2));
        assert_eq!((set("rich").samples, set("rich").encoding.features), (128, 4));
        assert_eq!((set("lean and rich").samples, set("lean and rich").encoding.features), (48, 4));
        assert!(sweep(false).combinations(&lines[1..]).unwrap().is_empty());
        assert!(sweep(false).combinations(&lines[..1]).unwrap().is_empty());
    }
}
