//! The report of a training step.

use crate::model::times::StepTimes;

/// Losses, counts and times of a training step.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct StepReport {
    /// Number of the step, from 1.
    pub step: u64,
    /// Weighted sum of the losses.
    pub loss: f64,
    /// Mean squared error over known pixels.
    pub mse: f64,
    /// Perceptual term.
    pub perceptual: f64,
    /// Completeness term.
    pub completeness: f64,
    /// PSNR over the known pixels of the step, decibels.
    pub psnr: f64,
    /// Live samples that were evaluated.
    pub live_samples: usize,
    /// Rays traced.
    pub rays: usize,
    /// Gradients that were not finite and were left out.
    pub bad_gradients: usize,
    /// Time of each stage.
    pub times: StepTimes,
}
