//! The tables and their rows.

use anyhow::{Context, Result};
use occnerf::{Config, OccludedRule, Preset};

use crate::methods::Method;
use xtask::settings::set;

/// A row of a table.
#[derive(Clone, Debug)]
pub struct Row {
    /// On the command line, in the table and as a directory.
    pub name: String,
    /// What is trained.
    pub method: Method,
    /// The pixel rule.
    pub occluded: OccludedRule,
    /// Factor on the number of steps.
    pub times: f64,
    /// Where it starts from; `None`: the preset of the command line.
    preset: Option<Preset>,
    /// What differs from that, as `--set` takes it.
    changes: Vec<&'static str>,
    /// The row with the same settings whose people are baked, and scored so; `None`: people are
    /// trained.
    pub baked: Option<&'static str>,
}

/// A table that `reproduce` can make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Table {
    /// The paper's: methods and ablations.
    Methods,
    /// From the paper's text to the default, one change a row.
    Story,
    /// Each component left out, from our start, a grey and a faint one.
    Components,
    /// Settings of the default, judged by training frames that are held out.
    Choices,
}

use Method::{HashPoint, Humannerf, NeuralBody, Occnerf, Prior, SelfNerf, Surface};
use OccludedRule::{Background, Unknown};

/// Changes that make a start know nothing of the prior's colours and of how far its surface is.
const GREY: [&str; 3] = ["field.prior_colors=false", "field.prior_light=false", "field.density_bias_outside=2"];

/// What HumanNeRF itself has where every other row has this project's way.
const HUMANNERF: [&str; 6] =
    [GREY[0], GREY[1], GREY[2], "registration.rounds=0", "motion.kind=volume", "motion.shell_interval=0"];

/// A prior that is not corrected, in mean colours.
const AS_GIVEN: [&str; 2] = ["registration.rounds=0", "field.prior_light=false"];

/// The same, with so little density, and samples so deep, that an empty inside can be seen through:
/// where completeness has something to do.
const FAINT: [&str; 5] =
    [GREY[0], GREY[1], "field.density_bias_outside=-2", "field.density_bias=-2", "motion.depth=0.3"];

const SURFACE_TERM: &str = "surface.surface_term=true";

/// A component left out, put back, or replaced by what it competes with.
const COMPONENTS: [(&str, &[&str]); 11] = [
    ("full", &[]),
    ("surface-term", &[SURFACE_TERM]),
    ("attention", &[SURFACE_TERM, "surface.attention=true"]),
    ("no-completeness", &["loss.completeness=0"]),
    ("no-perceptual", &["loss.perceptual=0"]),
    ("one-neighbour", &[SURFACE_TERM, "surface.k=1"]),
    ("four-levels", &[SURFACE_TERM, "surface.coarse_levels=3"]),
    ("four-levels-attention", &[SURFACE_TERM, "surface.coarse_levels=3", "surface.attention=true"]),
    ("learnt-vertices", &[SURFACE_TERM, "rates.vertices=1e-4"]),
    ("no-registration", &["registration.rounds=0"]),
    ("even-light", &["field.prior_light=false"]),
];

/// The way from the paper's text to the default: each row keeps the changes of those before it. The
/// row `paper` is the preset `paper`; what stands before it are its departures from the text.
const STORY: [(&str, &[&str]); 15] = [
    (
        "text",
        &[
            GREY[0],
            GREY[1],
            "registration.rounds=0",
            "motion.kind=volume",
            "rates.table=5e-5",
            "rates.field=5e-4",
            "rates.motion=5e-5",
            "rates.beta_2=0.999",
            "rates.final_fraction=1",
        ],
    ),
    ("registered-prior", &["registration.rounds=16"]),
    ("finer-volume", &["motion.resolution=64"]),
    ("surface-motion", &["motion.kind=surface", "motion.resolution=32"]),
    ("table-rate", &["rates.table=5e-3", "rates.final_fraction=0.1"]),
    ("prior-colours", &["field.prior_colors=true", "field.prior_light=true"]),
    ("paper", &["rates.table=3e-2", "rates.field=6e-3", "rates.motion=1e-3", "rates.beta_2=0.99"]),
    ("squared-error", &["loss.mse=5"]),
    ("exact-distance", &["surface.distance=exact"]),
    (
        "smaller-grid",
        &[
            "encoding.levels=10",
            "encoding.log2_table_size=16",
            "encoding.n_min=12",
            "encoding.n_max=384",
            "encoding.distance_min=-0.4",
            "encoding.distance_max=0.6",
        ],
    ),
    ("one-level", &["surface.coarse_levels=0"]),
    ("plain-mean", &["surface.attention=false"]),
    ("fixed-vertices", &["rates.vertices=0"]),
    ("no-surface-term", &["surface.surface_term=false"]),
    ("balanced", &["patches=3", "min_transmittance=0.05", "motion.depth=0.04", "motion.shell_interval=32"]),
];

/// The default, and one setting changed in each row; every fifth training frame is held out.
const HELD_OUT: &str = "held_out=5";
const CHOICES: [(&str, &[&str]); 21] = [
    ("as-it-is", &[]),
    ("samples-48", &["samples=48"]),
    ("samples-96", &["samples=96"]),
    ("samples-192", &["samples=192"]),
    ("patches-2", &["patches=2"]),
    ("patches-4", &["patches=4"]),
    ("transmittance-0.01", &["min_transmittance=0.01"]),
    ("transmittance-0.1", &["min_transmittance=0.1"]),
    ("depth-2-cm", &["motion.depth=0.02"]),
    ("depth-8-cm", &["motion.depth=0.08"]),
    ("squared-error-1", &["loss.mse=1"]),
    ("squared-error-20", &["loss.mse=20"]),
    ("no-completeness", &["loss.completeness=0"]),
    ("surface-term", &[SURFACE_TERM]),
    ("rates-half", &["rates.table=1.5e-2", "rates.field=3e-3"]),
    ("rates-twice", &["rates.table=6e-2", "rates.field=1.2e-2"]),
    ("final-rate-0.03", &["rates.final_fraction=0.03"]),
    ("final-rate-0.3", &["rates.final_fraction=0.3"]),
    ("cells-192", &["encoding.n_max=192"]),
    ("cells-768", &["encoding.n_max=768"]),
    ("density-twice", &["field.density_scale=50"]),
];

fn row(name: &str, method: Method, occluded: OccludedRule) -> Row {
    let (name, changes) = (name.to_owned(), Vec::new());
    Row { name, method, occluded, times: 1.0, preset: None, changes, baked: None }
}

fn as_given() -> Row {
    Row { changes: AS_GIVEN.to_vec(), ..row("prior-as-given", Prior, Unknown) }
}

/// As many steps as the paper gave HumanNeRF.
fn four_times(name: &str, occluded: OccludedRule) -> Row {
    Row { times: 4.0, ..row(name, Humannerf, occluded) }
}

/// Methods, baselines first, and what each component of ours is worth. Row names say `bg` where
/// hidden pixels are taught to be background. Every method has the same start, motion and
/// corrections but `humannerf-style-paper`, which has its paper's.
fn methods() -> Vec<Row> {
    let mut rows = vec![
        as_given(),
        row("prior", Prior, Unknown),
        row("surface", Surface, Unknown),
        Row { changes: HUMANNERF.to_vec(), ..row("humannerf-style-paper", Humannerf, Background) },
        row("humannerf-style-bg", Humannerf, Background),
        four_times("humannerf-style-bg-4x", Background),
        row("humannerf-style", Humannerf, Unknown),
        four_times("humannerf-style-4x", Unknown),
        row("hash-point-bg", HashPoint, Background),
        row("hash-point", HashPoint, Unknown),
        row("neural-body-style", NeuralBody, Unknown),
        row("self-nerf-style", SelfNerf, Unknown),
        row("occnerf-bg", Occnerf, Background),
        row("occnerf", Occnerf, Unknown),
        Row { baked: Some("occnerf"), ..row("occnerf-baked", Occnerf, Unknown) },
        Row { preset: Some(Preset::Paper), ..row("paper", Occnerf, Unknown) },
    ];
    for name in ["surface-term", "no-completeness", "no-perceptual"] {
        let changes = COMPONENTS.iter().find(|(component, _)| *component == name).map_or(&[][..], |c| c.1);
        rows.push(Row { changes: changes.to_vec(), ..row(name, Occnerf, Unknown) });
    }
    rows
}

fn story() -> Vec<Row> {
    let mut changes = Vec::new();
    let step = |(name, more): &(&str, &[&'static str])| {
        changes.extend_from_slice(more);
        Row { preset: Some(Preset::Paper), changes: changes.clone(), ..row(name, Occnerf, Unknown) }
    };
    [as_given(), row("prior", Prior, Unknown)].into_iter().chain(STORY.iter().map(step)).collect()
}

fn components() -> Vec<Row> {
    let starts = [("ours", &[][..]), ("grey", &GREY[..]), ("faint", &FAINT[..])];
    let of = |(start, from): (&str, &[&'static str])| {
        let row = |(name, changes): &(&str, &[&'static str])| Row {
            changes: [from, changes].concat(),
            ..row(&format!("{start}-{name}"), Occnerf, Unknown)
        };
        // A grey start knows of no light.
        let rows = COMPONENTS.iter().filter(|(name, _)| start == "ours" || *name != "even-light");
        rows.map(row).collect::<Vec<_>>()
    };
    starts.into_iter().flat_map(of).collect()
}

fn choices() -> Vec<Row> {
    let of = |(name, changes): (&str, &[&'static str])| Row {
        changes: [&[HELD_OUT], changes].concat(),
        ..row(name, Occnerf, Unknown)
    };
    CHOICES.into_iter().map(of).collect()
}

impl Table {
    /// Its rows, baselines first.
    pub fn rows(self) -> Vec<Row> {
        match self {
            Self::Methods => methods(),
            Self::Story => story(),
            Self::Components => components(),
            Self::Choices => choices(),
        }
    }

    /// What its files and its section are called.
    pub fn name(self) -> &'static str {
        match self {
            Self::Methods => "reproduce",
            Self::Story => "story",
            Self::Components => "components",
            Self::Choices => "choices",
        }
    }

    /// Its heading, without the scene.
    pub fn title(self) -> &'static str {
        match self {
            Self::Methods => "Methods",
            Self::Story => "From the paper to the default",
            Self::Components => "What each component is worth",
            Self::Choices => "Settings by training frames that are held out",
        }
    }

    /// Rows whose pictures stand beside the truth.
    pub fn shown(self) -> &'static [&'static str] {
        match self {
            Self::Methods => &[
                "prior",
                "surface",
                "humannerf-style-bg",
                "humannerf-style",
                "hash-point",
                "neural-body-style",
                "self-nerf-style",
                "occnerf-bg",
                "occnerf",
                "occnerf-baked",
                "paper",
            ],
            Self::Story => &["prior", "text", "registered-prior", "paper", "balanced"],
            Self::Components => &["ours-full", "ours-surface-term", "grey-full", "grey-surface-term"],
            Self::Choices => &["as-it-is", "samples-48", "surface-term"],
        }
    }
}

impl Row {
    /// Whether there is anything to learn, and so to repeat with another seed.
    pub fn learns(&self) -> bool {
        self.method.has_field()
    }

    /// Directory, under that of the table, of the run with a seed.
    pub fn run(&self, seed: u64) -> String {
        if self.learns() { format!("{}-s{seed}", self.name) } else { self.name.clone() }
    }

    /// Number of runs.
    pub fn runs(&self, seeds: u64) -> u64 {
        if self.learns() { seeds } else { 1 }
    }

    /// Settings of a run, where a row of no more steps than usual has `steps`.
    ///
    /// # Errors
    /// If a change does not fit the settings.
    pub fn config(&self, preset: Preset, steps: u64, seed: u64) -> Result<Config> {
        let steps = ((steps as f64 * self.times).round() as u64).max(1);
        let preset = self.preset.unwrap_or(preset);
        let mut config = Config { occluded: self.occluded, steps, seed, ..self.method.preset(preset) };
        for change in &self.changes {
            config = set(&config, change).with_context(|| format!("row {}: {change}", self.name))?;
        }
        config.validate()?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use Table::{Choices, Components, Methods, Story};

    #[test]
    fn every_row_of_every_table_can_be_run_and_none_is_there_twice() {
        for table in [Methods, Story, Components, Choices] {
            let rows = table.rows();
            for (i, row) in rows.iter().enumerate() {
                assert!(rows[..i].iter().all(|other| other.name != row.name), "{}", row.name);
                for preset in [Preset::Fast, Preset::Balanced, Preset::Paper] {
                    row.config(preset, 9, 1).unwrap();
                }
            }
            assert!(table.shown().iter().all(|name| rows.iter().any(|row| row.name == *name)), "{table:?}");
        }
    }

    #[test]
    fn a_baked_row_comes_after_the_row_with_its_settings_that_trains_its_people() {
        let rows = methods();
        let at = rows.iter().position(|row| row.name == "occnerf-baked").unwrap();
        for (at, baked) in rows.iter().enumerate().filter(|(_, row)| row.baked.is_some()) {
            let trained = rows[..at].iter().find(|row| Some(&*row.name) == baked.baked).unwrap();
            assert!(trained.baked.is_none() && trained.learns() && trained.times == baked.times);
            assert_eq!(trained.config(Preset::Fast, 9, 1).unwrap(), baked.config(Preset::Fast, 9, 1).unwrap());
        }
        assert_eq!(rows[at].baked, Some("occnerf"));
    }

    #[test]
    fn each_row_of_the_story_changes_something_and_it_goes_through_paper_to_balanced() {
        let rows: Vec<Row> = story().into_iter().filter(Row::learns).collect();
        let settings = |row: &Row| row.config(Preset::Fast, 9, 1).unwrap();
        assert!(rows.windows(2).all(|pair| settings(&pair[0]) != settings(&pair[1])));
        let named = |name: &str| settings(rows.iter().find(|row| row.name == name).unwrap());
        for preset in [Preset::Paper, Preset::Balanced] {
            let whole = Method::Occnerf.preset(preset);
            let row = Config { preset, steps: whole.steps, seed: whole.seed, ..named(preset.name()) };
            assert_eq!(row, whole);
        }
    }
}
