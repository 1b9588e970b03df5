//! The points of `bench capacity`: fixed sizes, and those chosen from the scene.

use anyhow::Result;
use occnerf::Preset;
use xtask::capacity;
use xtask::source::Source;

use super::points::{Setting, Sweep};
use crate::methods::Method;
use crate::sweep::{Kind, Point};

/// Fixed sizes around `balanced`: name, as `train --set` takes it, whether the quick form has it.
const AROUND: [(&str, &[&str], bool); 7] = [
    ("table 2^11", &["encoding.log2_table_size=11"], true),
    ("table 2^13", &["encoding.log2_table_size=13"], true),
    ("table 2^14", &["encoding.log2_table_size=14"], false),
    ("table 2^18", &["encoding.log2_table_size=18"], false),
    ("8 levels to 176", &["encoding.levels=8", "encoding.n_max=176"], false),
    ("width 16", &["field.width=16"], false),
    ("width 32", &["field.width=32"], true),
];

/// Every point of one capture. `paper_steps`: of the preset `paper` and what is chosen from it, if
/// they are wanted.
pub fn points(sweep: &Sweep, source: &Source, paper_steps: Option<u64>) -> Result<Vec<Point>> {
    let steps = sweep.steps;
    let setting = |preset, steps, set| Setting { preset, method: Method::Occnerf, steps, set };
    let mut points = Vec::new();
    // With one loss, the sizes alone differ.
    let mse = format!("loss.mse={}", Method::Occnerf.preset(Preset::Balanced).loss.mse);
    let loss = [mse.as_str()];
    // `fast` is `balanced` with fewer steps.
    let presets = [(Preset::Balanced, Some(steps), &[][..]), (Preset::Paper, paper_steps, &loss)];
    for (preset, steps, set) in presets.into_iter().filter_map(|(preset, steps, set)| Some((preset, steps?, set))) {
        let (name, setting) = (preset.name(), setting(preset, steps, set));
        points.push(sweep.point(name, name, Kind::Preset, &setting)?);
        let mut auto = sweep.point(&format!("{name}, auto"), name, Kind::Auto, &setting)?;
        capacity::measure(source, &auto.job.config, &[])?.apply(&mut auto.job.config);
        auto.job.config.validate()?;
        auto.job.prune = true;
        auto.command.iter_mut().for_each(|command| command.push_str(" --capacity auto"));
        points.push(auto);
    }
    let balanced = Preset::Balanced.name();
    for (name, set, quick) in AROUND {
        if quick || !sweep.quick {
            points.push(sweep.point(name, balanced, Kind::Change, &setting(Preset::Balanced, steps, set))?);
        }
    }
    points.iter_mut().for_each(|point| point.bench = "capacity".to_owned());
    Ok(points)
}
