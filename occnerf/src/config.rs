//! Everything a run depends on, as one value that is written into its directory: every setting, the
//! named presets, and validation.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

/// Which model is trained; every method shares data, sampler, renderer, budget
/// and the losses but completeness.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// No field: the posed prior mesh, each place of it in the mean colour of the visible training
    /// pixels that saw it.
    Prior,
    /// No field: the prior's surface, displaced, and its texture, fitted to the training frames.
    Surface,
    /// Point-based: hash encoding of x̂ alone.
    HashPoint,
    /// The paper: point term and, in the preset `paper`, attended surface term.
    Occnerf,
}

impl Method {
    /// Whether it trains a field.
    pub fn has_field(self) -> bool {
        !matches!(self, Self::Prior | Self::Surface)
    }

    /// The name used on the command line and in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::Prior => "prior",
            Self::Surface => "surface",
            Self::HashPoint => "hash-point",
            Self::Occnerf => "occnerf",
        }
    }
}

/// What a pixel of the body's silhouette outside the mask is taken for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OccludedRule {
    /// Nothing is known of it: it enters no photometric term.
    Unknown,
    /// It is background, as the published code has it.
    Background,
}

impl OccludedRule {
    /// The name used on the command line and in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Background => "background",
        }
    }
}

/// How an observed point is mapped to the canonical pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionKind {
    /// The paper's learnable weight volume with oriented Gaussians as prior, which has holes at the
    /// joints.
    Volume,
    /// Skinning weights of the nearest point of the posed surface.
    Surface,
}

/// Where [v̂, d] comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DistanceKind {
    /// The paper's blend of the k nearest vertices by normal similarity.
    Blended,
    /// The closest point of the triangle mesh and its signed distance.
    Exact,
}

impl DistanceKind {
    /// Whether points need their neighbours for it.
    pub(crate) fn needs_neighbours(self) -> bool {
        self != Self::Exact
    }
}

/// A named set of defaults.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// For a first look.
    Fast,
    /// The default.
    Balanced,
    /// The paper's setting.
    Paper,
}

impl Preset {
    /// The name used on the command line and in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fast => "fast",
            Self::Balanced => "balanced",
            Self::Paper => "paper",
        }
    }
}

/// The paper's components that can be switched off one by one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Component {
    /// The surface term: F sees the point term alone.
    Surface,
    /// The attention: the surface term is the plain mean.
    Attention,
    /// The completeness loss.
    Completeness,
    /// The perceptual loss.
    Perceptual,
}

impl Component {
    /// The name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Surface => "surface",
            Self::Attention => "attention",
            Self::Completeness => "completeness",
            Self::Perceptual => "perceptual",
        }
    }
}

/// The perceptron F.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldConfig {
    /// Units of each hidden layer.
    pub width: usize,
    /// Hidden layers.
    pub depth: usize,
    /// Density σ = `density_scale` · softplus(raw + bias), per normalised metre.
    pub density_scale: f32,
    /// Bias at and inside the prior's surface. Positive, or an image that starts empty stays empty.
    pub density_bias: f32,
    /// Bias at the outer end of the margin; linear in between.
    pub density_bias_outside: f32,
    /// Whether colours start from those of the prior's nearest surface point
    /// ([`crate::PriorColors`]): the perceptron adds to their logits where some frame saw them.
    /// Asks for `motion.kind = surface`.
    pub prior_colors: bool,
    /// Whether those colours are separated from the light that all frames share.
    pub prior_light: bool,
}

/// The encoding γ.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncodingConfig {
    /// Levels of the hash grid.
    pub levels: usize,
    /// Features a level.
    pub features: usize,
    /// log₂ of a level's largest table.
    pub log2_table_size: u32,
    /// Cells an axis of the coarsest level.
    pub n_min: u32,
    /// Cells an axis of the finest level.
    pub n_max: u32,
    /// Lower clamp of d, normalised metres. A wide interval makes cells long in d, along which
    /// appearance changes little, and leaves more of the table to the surface.
    pub distance_min: f32,
    /// Upper clamp of d, normalised metres.
    pub distance_max: f32,
}

/// Surface queries and the surface term.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SurfaceConfig {
    /// Nearest vertices a level.
    pub k: usize,
    /// Levels beyond the finest.
    pub coarse_levels: usize,
    /// Where [v̂, d] comes from.
    pub distance: DistanceKind,
    /// Whether F sees the surface term.
    pub surface_term: bool,
    /// Whether the surface term is weighted by the visibility counts.
    pub attention: bool,
}

/// The motion field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionConfig {
    /// Volume or surface.
    pub kind: MotionKind,
    /// Samples an axis of the weight volume.
    pub resolution: usize,
    /// Distance from the prior's surface up to which a point can belong to the subject, normalised
    /// metres.
    pub margin: f32,
    /// Depth below the prior's surface down to which there are samples, normalised metres. No body
    /// is 0.3 deep: 0.3 keeps every sample.
    pub depth: f32,
    /// Steps between measurements of the field's outer end, beyond which samples are skipped; 0
    /// never skips, which `volume` asks for.
    pub shell_interval: usize,
}

/// Width of the fall of the likelihood to 0 beyond `motion.margin`, normalised metres.
pub(crate) const FALLOFF: f32 = 0.02;

impl MotionConfig {
    /// Distance from the prior's surface at which the likelihood is 0, normalised metres.
    pub fn reach(&self) -> f32 {
        self.margin + FALLOFF
    }
}

/// Corrections of the prior before training, from outlines and colours of all frames; see
/// [`crate::register`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegistrationConfig {
    /// Gauss-Newton steps; 0 leaves the prior as it is given.
    pub rounds: usize,
}

/// Weights of the losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossConfig {
    /// λ₁, mean squared error.
    pub mse: f32,
    /// λ₂, perceptual term.
    pub perceptual: f32,
    /// File or directory of weights that makes the perceptual term LPIPS (see
    /// [`crate::Lpips::load`]); empty: multi-scale SSIM, which needs none.
    pub perceptual_weights: String,
    /// λ₃, completeness.
    pub completeness: f32,
}

impl LossConfig {
    /// The perceptual term: `ms-ssim`, `lpips` or `none`.
    pub fn perceptual_name(&self) -> String {
        let name = if self.perceptual_weights.is_empty() { "ms-ssim" } else { "lpips" };
        if self.perceptual == 0.0 { "none" } else { name }.to_owned()
    }
}

/// Adam's learning rates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RateConfig {
    /// The perceptron F.
    pub field: f32,
    /// The vertices of the surface term; at 0 they stay on the prior and are no parameters.
    pub vertices: f32,
    /// The hash table.
    pub table: f32,
    /// The motion volume's log-weights.
    pub motion: f32,
    /// Every rate falls exponentially to this fraction over the run.
    pub final_fraction: f32,
    /// Decay of the second moment.
    pub beta_2: f32,
}

/// The configuration of a run.
///
/// ```
/// use occnerf::{Component, Config, Method, Preset};
///
/// let mut config = Config::preset(Preset::Paper, Method::Occnerf);
/// config.ablate(Component::Attention);
/// assert!(config.surface.surface_term && config.validate().is_ok());
/// config.samples = 0;
/// assert_eq!(config.validate().unwrap_err().key, "samples");
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Named defaults that this started from.
    pub preset: Preset,
    /// Model that is trained.
    pub method: Method,
    /// The pixel rule.
    pub occluded: OccludedRule,
    /// Seeds every random choice.
    pub seed: u64,
    /// Optimisation steps.
    pub steps: u64,
    /// Patches a step, all from one frame.
    pub patches: usize,
    /// Side of a patch in pixels.
    pub patch_size: u32,
    /// Samples a ray across the body's box.
    pub samples: usize,
    /// Transmittance, below 1, at which a training ray ends; 0 never.
    pub min_transmittance: f32,
    /// Every `held_out`-th training frame is registered with the others, but neither colours nor
    /// the field are learnt from it: it is scored in place of other cameras' views. 0 holds none
    /// out.
    pub held_out: usize,
    /// The perceptron.
    pub field: FieldConfig,
    /// The hash grid.
    pub encoding: EncodingConfig,
    /// Surface queries and the surface term.
    pub surface: SurfaceConfig,
    /// Corrections of the prior before training.
    pub registration: RegistrationConfig,
    /// Motion field.
    pub motion: MotionConfig,
    /// Losses.
    pub loss: LossConfig,
    /// Learning rates.
    pub rates: RateConfig,
}

impl Config {
    /// Whether F sees the surface term, which only [`Method::Occnerf`] has.
    pub(crate) fn has_surface_term(&self) -> bool {
        self.method == Method::Occnerf && self.surface.surface_term
    }

    /// Whether samples need their nearest vertices.
    pub(crate) fn needs_neighbours(&self) -> bool {
        self.has_surface_term() || self.surface.distance.needs_neighbours()
    }

    /// Switches a component of the method off.
    pub fn ablate(&mut self, component: Component) {
        match component {
            Component::Surface => self.surface.surface_term = false,
            Component::Attention => self.surface.attention = false,
            Component::Completeness => self.loss.completeness = 0.0,
            Component::Perceptual => self.loss.perceptual = 0.0,
        }
    }
}

impl Config {
    /// The defaults of a preset for a method.
    pub fn preset(preset: Preset, method: Method) -> Self {
        let mut config = match preset {
            Preset::Paper => paper(),
            Preset::Balanced => balanced(),
            Preset::Fast => fast(),
        };
        config.method = method;
        if method != Method::Occnerf {
            config.surface.surface_term = false;
            config.surface.attention = false;
            config.loss.completeness = 0.0;
        }
        config
    }
}

/// 2⁻²⁵, half the spacing of f32 below 1: a smaller contribution is lost in rounding.
const NEGLIGIBLE: f32 = 1.0 / (1 << 25) as f32;

/// The paper's method; it leaves the size of F open. Where it departs from the paper's text, which
/// `reproduce --story` takes back one by one, but for the steps:
///
/// - `registration`: the prior is corrected first, as it is for every baseline.
/// - `motion.kind`: weights of the nearest surface point in place of a weight volume of 32³, in
///   which an arm beside a hip claims the same points: on recorded walking a tenth of the vertices
///   are taken more than 28 cm from where they rest.
/// - `field.prior_colors`, `field.prior_light`: colours start from the corrected prior's, not grey.
/// - `rates`: 12 to 600 times the paper's, but for the vertices', falling to a tenth; `steps`: a
///   tenth.
fn paper() -> Config {
    Config {
        preset: Preset::Paper,
        method: Method::Occnerf,
        occluded: OccludedRule::Unknown,
        seed: 1,
        steps: 1000,
        patches: 6,
        patch_size: 32,
        samples: 128,
        min_transmittance: NEGLIGIBLE,
        held_out: 0,
        field: FieldConfig {
            width: 64,
            depth: 2,
            density_scale: 25.0,
            density_bias: 2.0,
            density_bias_outside: -2.0,
            prior_colors: true,
            prior_light: true,
        },
        encoding: EncodingConfig {
            levels: 16,
            features: 2,
            log2_table_size: 19,
            n_min: 16,
            n_max: 2048,
            distance_min: -0.2,
            distance_max: 0.3,
        },
        surface: SurfaceConfig {
            k: 5,
            coarse_levels: 3,
            distance: DistanceKind::Blended,
            surface_term: true,
            attention: true,
        },
        registration: RegistrationConfig { rounds: 16 },
        motion: MotionConfig { kind: MotionKind::Surface, resolution: 32, margin: 0.04, depth: 0.3, shell_interval: 0 },
        loss: LossConfig { mse: 0.2, perceptual: 1.0, perceptual_weights: String::new(), completeness: 10.0 },
        rates: RateConfig { field: 6e-3, vertices: 1e-4, table: 3e-2, motion: 1e-3, final_fraction: 0.1, beta_2: 0.99 },
    }
}

/// The default. Without the paper's surface term, and so its coarser levels, attention and
/// learnable vertices: they buy nothing where density and colours start from the prior's
/// (`reproduce --components`).
fn balanced() -> Config {
    Config {
        preset: Preset::Balanced,
        steps: 800,
        patches: 3,
        min_transmittance: 0.05,
        encoding: EncodingConfig {
            levels: 10,
            features: 2,
            log2_table_size: 16,
            n_min: 12,
            n_max: 384,
            distance_min: -0.4,
            distance_max: 0.6,
        },
        surface: SurfaceConfig {
            coarse_levels: 0,
            distance: DistanceKind::Exact,
            surface_term: false,
            attention: false,
            ..paper().surface
        },
        loss: LossConfig { mse: 5.0, ..paper().loss },
        motion: MotionConfig { depth: 0.04, shell_interval: 32, ..paper().motion },
        rates: RateConfig { vertices: 0.0, ..paper().rates },
        ..paper()
    }
}

/// A first look: half as many steps and rounds of registration.
fn fast() -> Config {
    let registration = RegistrationConfig { rounds: 8 };
    Config { preset: Preset::Fast, steps: 400, registration, ..balanced() }
}

/// A configuration that cannot be run: the key and why.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("config: `{key}` is {value}: {expected}")]
pub struct ConfigError {
    /// Dotted name of the field.
    pub key: &'static str,
    /// Value that was given.
    pub value: String,
    /// Values that are allowed.
    pub expected: &'static str,
}

fn check(holds: bool, key: &'static str, value: impl ToString, expected: &'static str) -> Result<(), ConfigError> {
    if holds { Ok(()) } else { Err(ConfigError { key, value: value.to_string(), expected }) }
}

impl Config {
    /// Checks every value that would otherwise fail later and less clearly.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let Self { field, encoding, surface, motion, loss, rates, .. } = self;
        let steps = usize::try_from(self.steps).unwrap_or(usize::MAX);
        let whole: [(&str, usize, RangeInclusive<usize>, &str); 10] = [
            ("patches", self.patches, 1..=1024, "expected 1 to 1024"),
            ("patch_size", self.patch_size as usize, 1..=256, "expected 1 to 256 pixels"),
            ("samples", self.samples, 1..=1024, "expected 1 to 1024"),
            ("field.width", field.width, 1..=1024, "expected 1 to 1024"),
            ("field.depth", field.depth, 1..=16, "expected 1 to 16"),
            ("registration.rounds", self.registration.rounds, 0..=100, "expected at most 100"),
            // At 128 the weights, their moments and their gradient take 1.3 GB.
            ("motion.resolution", motion.resolution, 2..=128, "expected 2 to 128"),
            ("surface.k", surface.k, 1..=32, "expected 1 to 32"),
            ("surface.coarse_levels", surface.coarse_levels, 0..=6, "expected 0 to 6"),
            ("steps", steps, 0..=100_000_000, "expected at most 10^8"),
        ];
        for (key, value, range, expected) in whole {
            check(range.contains(&value), key, value, expected)?;
        }
        // Products that decide about memory: 2²⁷ table entries are 2 GB with both moments; a live
        // sample takes 2 to 4 kB, and about a third live, so 2²³ samples are 6 to 12 GB.
        let rows = 1u64.checked_shl(encoding.log2_table_size).unwrap_or(u64::MAX);
        let table = (encoding.levels as u64).saturating_mul(encoding.features as u64).saturating_mul(rows);
        let expected = "levels · features · 2^log2_table_size may be at most 2^27";
        check(table <= 1 << 27, "encoding.log2_table_size", table, expected)?;
        let samples = self.patches * (self.patch_size as usize).pow(2) * self.samples;
        check(samples <= 1 << 23, "patches", samples, "patches · patch_size² · samples may be at most 2^23")?;
        let expected = "expected 0 for none or at least 2: with 1 nothing is left to learn from";
        check(self.held_out != 1, "held_out", self.held_out, expected)?;
        let (surface, interval) = (motion.kind == MotionKind::Surface, motion.shell_interval);
        let expected = "expected 0 unless motion.kind is surface";
        check(surface || interval == 0, "motion.shell_interval", interval, expected)?;
        let expected = "expected false unless motion.kind is surface";
        check(surface || !field.prior_colors, "field.prior_colors", true, expected)?;
        let transmittance = self.min_transmittance;
        let expected = "expected at least 0 and below 1";
        check((0.0..1.0).contains(&transmittance), "min_transmittance", transmittance, expected)?;
        let at_most = "expected at most 0.3 normalised metres";
        check(motion.margin <= 0.3, "motion.margin", motion.margin, at_most)?;
        let at_least_zero = "expected a finite number of at least 0";
        let above_zero = "expected a finite number above 0";
        let real = [
            ("field.density_scale", field.density_scale, f32::MIN_POSITIVE, above_zero),
            ("field.density_bias", field.density_bias, f32::MIN, "expected a finite number"),
            ("field.density_bias_outside", field.density_bias_outside, f32::MIN, "expected a finite number"),
            ("encoding.distance_max", encoding.distance_max, f32::MIN_POSITIVE, above_zero),
            ("-encoding.distance_min", -encoding.distance_min, f32::MIN_POSITIVE, above_zero),
            ("motion.margin", motion.margin, f32::MIN_POSITIVE, above_zero),
            ("motion.depth", motion.depth, f32::MIN_POSITIVE, above_zero),
            ("loss.mse", loss.mse, 0.0, at_least_zero),
            ("loss.perceptual", loss.perceptual, 0.0, at_least_zero),
            ("loss.completeness", loss.completeness, 0.0, at_least_zero),
            ("rates.field", rates.field, 0.0, at_least_zero),
            ("rates.vertices", rates.vertices, 0.0, at_least_zero),
            ("rates.table", rates.table, 0.0, at_least_zero),
            ("rates.motion", rates.motion, 0.0, at_least_zero),
            ("rates.final_fraction", rates.final_fraction, f32::MIN_POSITIVE, above_zero),
            ("rates.beta_2", rates.beta_2, 0.0, at_least_zero),
            ("1 - rates.beta_2", 1.0 - rates.beta_2, f32::MIN_POSITIVE, above_zero),
        ];
        for (key, value, least, expected) in real {
            check(value.is_finite() && value >= least, key, value, expected)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_of_every_method_is_valid_and_survives_toml() {
        for preset in [Preset::Fast, Preset::Balanced, Preset::Paper] {
            for method in [Method::Prior, Method::HashPoint, Method::Occnerf] {
                let config = Config::preset(preset, method);
                config.validate().unwrap();
                let text = toml::to_string(&config).unwrap();
                assert_eq!(toml::from_str::<Config>(&text).unwrap(), config);
            }
        }
    }
}
