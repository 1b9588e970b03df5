//! Everything a run depends on, as one value that is written into its directory.

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
    /// ([`crate::PriorColors`]): the perceptron adds to their logits where some frame saw them. Asks
    /// for `motion.kind = surface`.
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
    /// Depth below the prior's surface down to which there are samples, normalised metres. No body is
    /// 0.3 deep: 0.3 keeps every sample.
    pub depth: f32,
    /// Steps between measurements of the field's outer end, beyond which samples are skipped; 0 never
    /// skips, which `volume` asks for.
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
    /// Every `held_out`-th training frame is registered with the others, but neither colours nor the
    /// field are learnt from it: it is scored in place of other cameras' views. 0 holds none out.
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
