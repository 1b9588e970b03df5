//! Rendering humans from object-occluded monocular videos (OccNeRF, ICCV 2023), on a CPU.
//!
//! A video of a moving person, partly hidden behind objects, with a body model fitted to each
//! frame, becomes a field of density and colour in the body's rest pose that renders from any side.
//!
//! ```
//! use occnerf::capture::{LoadOptions, load_capture};
//! use occnerf::{Config, Method, Preset, Scene, Trainer};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let body = smpl::BodyModel::embedded();
//! let options = LoadOptions { resize: Some(48), max_frames: Some(4), ..Default::default() };
//! let capture = load_capture("../xtask/demo".as_ref(), &body, &options)?;
//! let mut config = Config::preset(Preset::Fast, Method::Occnerf);
//! config.steps = 2;
//! let scene = Scene::new(&capture, &body, &config)?;
//! let mut trainer = Trainer::new(&scene, config)?;
//! let first = trainer.step()?;
//! assert!(first.loss.is_finite() && first.live_samples > 0);
//! # Ok(())
//! # }
//! ```
//!
//! # Conventions
//! Right-handed, OpenCV cameras, pixel centres at integer + 0.5, sRGB in [0, 1]. Inside, lengths
//! are divided by the canonical body's height / 1.7 m, so that a capture in centimetres trains the
//! same. The same seed and inputs give the same bits on one instruction set, whatever the number of
//! threads, and so does resuming from a checkpoint.

pub mod bake;
mod check;
mod config;
mod error;
mod evaluate;
mod model;
mod render;
mod scene;
mod train;

pub use ::capture;
pub use ::lpips::Lpips;
pub use array_files::replace_file;
pub use check::{Check, Fault, FrameCheck, Limb, Mistake, body_silhouette, check, photograph, unknown_pixels};
pub use config::{
    Component, Config, ConfigError, DistanceKind, EncodingConfig, FieldConfig, LossConfig, Method, MotionConfig,
    MotionKind, OccludedRule, Preset, RateConfig, RegistrationConfig, SurfaceConfig,
};
pub use error::Error;
pub use evaluate::{FrameMetrics, SplitMetrics, evaluate, least_seen_quartile, nearest_vertices};
pub use model::body::{Body, PosedFrame};
pub use model::colors::PriorColors;
pub use model::encoder::PointEncoder;
pub use model::person::Person;
pub use model::saved::checkpoint_config;
pub use model::trained::{Model, upright};
pub use model::view::{PosedView, pinhole};
pub use render::{FieldRenderer, PriorRenderer, Renderer, Rendering};
pub use scene::labels::{Label, Labels};
pub use scene::masks::mend_masks;
pub use scene::prepared::{HELD_OUT, PreparedFrame, Scene};
pub use scene::registration::register;
pub use train::step::StepReport;
pub use train::trainer::Trainer;
