//! Rendering humans from object-occluded monocular videos (OccNeRF, ICCV 2023), on a CPU.
//!
//! A video of a moving person, partly hidden behind objects, with a body model fitted to each frame, becomes a field
//! of density and colour in the body's rest pose that renders from any side.
//!
//! ```
//! use occnerf::{Config, Method, Preset, Scene, Trainer, capture};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let body = smpl::BodyModel::embedded();
//! let demo = capture::DemoConfig { size: 48, frames: 4, eval_cameras: 1, ..capture::DemoConfig::default() };
//! let capture = capture::demo(&demo, &body)?;
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
//! Right-handed, OpenCV cameras, pixel centres at integer + 0.5, sRGB in [0, 1]. Inside, lengths are divided by the
//! canonical body's height / 1.7 m, so that a capture in centimetres trains the same. The same seed and inputs give
//! the same bits on one instruction set, whatever the number of threads, and so does resuming from a checkpoint.

mod adam;
mod arena;
pub mod bake;
mod batch;
mod capacity;
pub mod capture;
mod checkpoint;
mod config;
mod correction;
mod encoder;
mod error;
mod evaluate;
mod field;
mod gemm;
mod loss;
#[cfg_attr(not(feature = "lpips"), path = "lpips/absent.rs")]
mod lpips;
mod mix;
mod mlp;
mod parameters;
mod photometric;
mod pixels;
#[cfg(test)]
mod plain;
mod pose_backward;
mod presets;
mod prior;
mod random;
mod render;
mod restarts;
mod runs;
mod samples;
mod scene;
mod shell;
mod step;
mod times;
mod trainer;
mod validate;
mod vertices;

pub use capacity::{Capacity, Choice, Measured, Pruned};
pub use checkpoint::checkpoint_config;
pub use config::{
    AttentionKind, Component, Config, DistanceKind, EncodingConfig, FieldConfig, LossConfig, Method, MotionConfig,
    MotionKind, OccludedRule, Preset, RateConfig, SurfaceConfig, VisibilityKind,
};
pub use error::Error;
pub use evaluate::{FrameMetrics, SplitMetrics, evaluate, evaluate_with, least_seen_quartile};
pub use lpips::{Lpips, Trunk};
pub use pixels::{Label, Labels, label_pixels};
pub use prior::VertexColors;
pub use render::{FieldRenderer, PriorRenderer, Renderer, Rendering, view_of};
pub use scene::{PreparedFrame, Scene};
pub use times::StepTimes;
pub use trainer::{StepReport, Trainer};
pub use validate::ConfigError;
