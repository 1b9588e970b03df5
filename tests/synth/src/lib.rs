//! Synthetic captures with known truth, and corruptions of captures.
//!
//! [`demo`] and [`synthesise`] film a clothed person or a rigged character; [`Synthetic::write`]
//! puts the capture on disk in the layouts that [`capture::load_capture`] reads. [`Obstacle`] and
//! [`Perturbation`] turn a capture into a harder one.
//!
//! ```
//! let config = synth::SynthConfig { size: 32, frames: 2, eval_cameras: 1, ..Default::default() };
//! let made = synth::synthesise(None, None, &config, &|_| {})?;
//! assert_eq!(made.capture.train.len(), 2);
//! # Ok::<(), capture::CaptureError>(())
//! ```

mod demo;
mod film;
mod obstacle;
mod perturbation;
mod photograph;
mod write;

pub use self::demo::{DemoConfig, Outfit, demo};
pub use self::film::{Occlusion, SynthConfig, Synthetic, synthesise};
pub use self::obstacle::Obstacle;
pub use self::perturbation::Perturbation;
pub use self::write::BODY;
pub use self::write::pickle::Py;
