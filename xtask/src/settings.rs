//! From the command line to a configuration.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use occnerf::{Component, Config, Method, OccludedRule, Preset};

/// Stride of the frames held out for scoring of captures without other cameras, and by `auto`.
pub const HOLD_OUT: usize = 10;

/// A method, or the choice of one by the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MethodChoice {
    /// [`Method::Surface`], or [`Method::Occnerf`] where a field gains on frames held out, and a
    /// skirt where one does.
    Auto,
    /// This one.
    Named(Method),
}

impl MethodChoice {
    fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Named(method) => method.name(),
        }
    }
}

const METHODS: &[(MethodChoice, &str)] = &[
    (MethodChoice::Named(Method::Prior), "The posed prior in mean colours; nothing is trained"),
    (MethodChoice::Named(Method::Surface), "The prior's surface, displaced, with a texture: no field, no steps"),
    (MethodChoice::Named(Method::HashPoint), "Point-based, hash encoding"),
    (MethodChoice::Named(Method::Occnerf), "Point term, and in `paper` the attended surface term"),
    (MethodChoice::Auto, "The surface, with a skirt or occnerf's field where they gain on frames held out"),
];
const PRESETS: &[(Preset, &str)] = &[
    (Preset::Fast, "A first look: the surface alone, in seconds; fields for half the default's time"),
    (Preset::Balanced, "The default: about a minute"),
    (Preset::Paper, "The paper's method: under ten minutes"),
];
const COMPONENTS: &[(Component, &str)] = &[
    (Component::Surface, "The surface term, which only `paper` has: F sees the point term alone"),
    (Component::Attention, "Its weights, which only `paper` has: the surface term is a plain mean"),
    (Component::Completeness, "The completeness loss"),
    (Component::Perceptual, "The perceptual loss"),
];
const RULES: &[(OccludedRule, &str)] = &[
    (OccludedRule::Unknown, "Pixels behind an occluder enter no photometric term"),
    (OccludedRule::Background, "They are taught to be background, as the published code has it"),
];

/// Parses the name of one of `values`, each with its help.
fn named<T: Copy + Send + Sync + 'static>(
    values: &'static [(T, &'static str)],
    name: fn(T) -> &'static str,
) -> impl TypedValueParser<Value = T> {
    let possible = values.iter().map(move |&(value, help)| PossibleValue::new(name(value)).help(help));
    PossibleValuesParser::new(possible.collect::<Vec<_>>()).try_map(move |given| {
        let found = values.iter().find(|(value, _)| name(*value) == given);
        found.map(|(value, _)| *value).ok_or("no such name")
    })
}

/// Parses the name of a preset.
pub fn preset() -> impl TypedValueParser<Value = Preset> {
    named(PRESETS, Preset::name)
}

/// What a run is trained with.
#[derive(Args, Clone, Debug, Default)]
pub struct SettingArguments {
    /// Named settings [default: balanced]
    #[arg(long, value_parser = preset())]
    pub preset: Option<Preset>,
    /// Which model [default: surface for the preset fast, else occnerf]
    #[arg(long, value_parser = named(METHODS, MethodChoice::name))]
    pub method: Option<MethodChoice>,
    /// Components of the method to switch off, comma separated
    #[arg(long, value_delimiter = ',', value_parser = named(COMPONENTS, Component::name))]
    pub ablate: Vec<Component>,
    /// What a hidden pixel of the body's silhouette is taken for [default: unknown]
    #[arg(long, value_parser = named(RULES, OccludedRule::name))]
    pub occluded: Option<OccludedRule>,
    /// Optimisation steps [default: the preset's]
    #[arg(long)]
    pub steps: Option<u64>,
    /// Seed of every random choice [default: 1]
    #[arg(long, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub seed: Option<u64>,
    /// Weights that make the perceptual term LPIPS: SqueezeNet 1.1, VGG16 or AlexNet with LPIPS's
    /// linear layers, .safetensors or .pth, a file or a directory [default: multi-scale SSIM]
    #[arg(long, value_name = "PATH")]
    pub perceptual_weights: Option<String>,
    /// Any other value of the train table in config.toml, such as encoding.n_max=512; may be
    /// repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

impl SettingArguments {
    /// The preset with everything given on the command line applied.
    pub fn config(&self) -> Result<Config> {
        let preset = self.preset.unwrap_or(Preset::Balanced);
        let usual = if preset == Preset::Fast { Method::Surface } else { Method::Occnerf };
        let method = match self.method {
            Some(MethodChoice::Named(method)) => method,
            Some(MethodChoice::Auto) => Method::Occnerf,
            None => usual,
        };
        if let Some(steps) = self.steps.filter(|_| !method.has_field()) {
            bail!("--steps {steps}: the method {} takes no steps", method.name());
        }
        let config = self.apply(Config::preset(preset, method))?;
        // Found missing now, not after registration.
        let weights = Path::new(&config.loss.perceptual_weights);
        ensure!(weights.as_os_str().is_empty() || weights.exists(), "{}: no such weights", weights.display());
        Ok(config)
    }

    /// Whether the scene chooses the method.
    pub fn is_auto(&self) -> bool {
        self.method == Some(MethodChoice::Auto)
    }

    /// [`SettingArguments::config`] of the surface in place of a field.
    pub fn without_field(&self) -> Result<Config> {
        Self { method: Some(MethodChoice::Named(Method::Surface)), steps: None, ..self.clone() }.config()
    }

    /// `config` with everything but preset and method applied.
    pub fn apply(&self, mut config: Config) -> Result<Config> {
        self.ablate.iter().for_each(|component| config.ablate(*component));
        config.occluded = self.occluded.unwrap_or(config.occluded);
        config.steps = self.steps.unwrap_or(config.steps);
        config.seed = self.seed.unwrap_or(config.seed);
        if let Some(path) = &self.perceptual_weights {
            config.loss.perceptual_weights.clone_from(path);
        }
        for assignment in &self.set {
            config = set(&config, assignment).with_context(|| format!("--set {assignment}"))?;
        }
        config.validate()?;
        Ok(config)
    }

    /// Checks that a run to be resumed was trained with what is asked for; the number of steps may
    /// change.
    pub fn resumed(&self, saved: Config) -> Result<Config> {
        // What the scene chose stays.
        let method = if self.is_auto() { Some(MethodChoice::Named(saved.method)) } else { self.method };
        let mut asked = match (self.preset, method) {
            (None, None) => saved.clone(),
            _ => Self { method, ..self.clone() }.config()?,
        };
        asked.held_out = saved.held_out;
        let asked = self.apply(asked)?;
        let steps = self.steps.unwrap_or(saved.steps);
        let same = Config { steps, ..asked.clone() } == Config { steps, ..saved.clone() };
        if !same {
            bail!("the run to resume was trained with other settings; leave them out, or start a new run with --out");
        }
        Ok(Config { steps, ..saved })
    }
}

/// Replaces one value by its dotted key.
pub fn set(config: &Config, assignment: &str) -> Result<Config> {
    let (key, value) = assignment.split_once('=').context("expected KEY=VALUE")?;
    let mut table = toml::Table::try_from(config)?;
    let mut at = &mut table;
    let mut parts: Vec<&str> = key.split('.').collect();
    let last = parts.pop().unwrap_or_default();
    for part in parts {
        at = at.get_mut(part).and_then(toml::Value::as_table_mut).with_context(|| format!("no table `{part}`"))?;
    }
    let known = at.keys().cloned().collect::<Vec<_>>().join(", ");
    let old = at.get(last).with_context(|| format!("no key `{last}`; there are {known}"))?;
    let new = match old {
        toml::Value::Integer(_) => toml::Value::Integer(value.parse().context("expected a whole number")?),
        toml::Value::Float(_) => toml::Value::Float(value.parse().context("expected a number")?),
        toml::Value::Boolean(_) => toml::Value::Boolean(value.parse().context("expected true or false")?),
        _ => toml::Value::String(value.to_owned()),
    };
    at.insert(last.to_owned(), new);
    Ok(table.try_into()?)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_run_keeps_the_method_that_its_scene_chose_and_its_frames_held_out() {
        for method in [Method::Occnerf, Method::Surface] {
            let saved = Config { held_out: HOLD_OUT, ..Config::preset(Preset::Balanced, method) };
            for choice in [MethodChoice::Auto, MethodChoice::Named(method)] {
                let asked = SettingArguments { method: Some(choice), ..SettingArguments::default() };
                assert_eq!(asked.resumed(saved.clone()).unwrap(), saved);
            }
            let set = SettingArguments { set: vec!["held_out=5".to_owned()], ..SettingArguments::default() };
            assert!(set.resumed(saved).is_err());
        }
        let other = SettingArguments { method: Some(MethodChoice::Named(Method::HashPoint)), ..Default::default() };
        assert!(other.resumed(Config::preset(Preset::Balanced, Method::Occnerf)).is_err());
    }
}
