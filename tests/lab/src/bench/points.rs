//! The sweep of `bench pareto`: one factor at a time.

use std::path::PathBuf;

use anyhow::Result;
use occnerf::{Config, Preset};

use crate::methods::Method;
use crate::sweep::{Job, Kind, Place, Point};
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

/// Steps of the base at which presets run their own number of steps: those of `fast`.
pub const FULL_STEPS: u64 = 400;

/// What the sweep is made of.
pub struct Sweep {
    pub place: Place,
    /// Arguments that make `train` read the same capture.
    pub scene_arguments: String,
    pub views: usize,
    /// Of the base and its changes.
    pub steps: u64,
    pub quick: bool,
    /// Weights of LPIPS.
    pub lpips: Option<PathBuf>,
}

impl Sweep {
    /// A point of `bench pareto`, with settings on top of those of a preset.
    fn point(
        &self,
        [name, factor]: [&str; 2],
        kind: Kind,
        (preset, method, steps): (Preset, Method, u64),
        set: &[&str],
    ) -> Result<Point> {
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
            job: Job { lpips: self.lpips.clone(), ..Job::new(self.place.clone(), self.views, method, config) },
        })
    }

    /// Its points, the base first.
    pub fn points(&self) -> Result<Vec<Point>> {
        let own = |kind, factor: &str, name: &str, method, steps, set: &[&str]| {
            self.point([name, factor], kind, (Preset::Fast, method, steps), set)
        };
        let steps = self.steps;
        let mut points = vec![own(Kind::Base, "base", "base", Method::Occnerf, steps, &[])?];
        for method in [Method::Prior, Method::Surface, Method::Auto, Method::HashPoint, Method::Humannerf] {
            points.push(own(Kind::Baseline, "method", method.name(), method, steps, &[])?);
        }
        let surface = (Preset::Balanced, Method::Surface, steps);
        points.push(self.point(["surface, balanced", "method"], Kind::Baseline, surface, &[])?);
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
            let steps = (whole * self.steps / (FULL_STEPS * divisor)).max(1);
            let name = if steps == whole {
                preset.name().to_owned()
            } else {
                format!("{}, {steps} of {whole} steps", preset.name())
            };
            let point = self.point([&name, "preset"], Kind::Preset, (preset, Method::Occnerf, steps), &[])?;
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
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;
    use crate::bench::Difficulty;

    fn sweep(quick: bool) -> Sweep {
        let place = Place::Made(Difficulty::default());
        Sweep { place, scene_arguments: String::new(), views: 5, steps: FULL_STEPS, quick, lpips: None }
    }

    #[test]
    fn every_point_is_valid_has_a_name_of_its_own_and_a_command() {
        for quick in [false, true] {
            let points = sweep(quick).points().unwrap();
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
            let points = sweep(quick).points().unwrap();
            let base = points.iter().find(|p| p.kind == Kind::Base).unwrap();
            let baked: Vec<&Point> = points.iter().filter(|p| p.kind == Kind::Baked).collect();
            assert_eq!(baked.len(), BAKED.len());
            assert!(baked.iter().all(|p| p.job.config == base.job.config && p.job.bake.is_some()));
        }
    }
}
