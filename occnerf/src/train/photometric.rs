//! Photometric losses of a step: the error of its known pixels, and the perceptual term of its
//! patches.

use glam::Vec3;
use lpips::Lpips;
use rayon::prelude::*;

use crate::Error;
use crate::capture::PixelReader;
use crate::config::LossConfig;
use crate::scene::labels::Labels;
use crate::train::batch::{Batch, target};
use crate::train::loss::Dissimilarity;
use crate::train::step::{RayGroup, StepReport};

/// Buffers of the losses, kept from step to step; an entry a ray of the batch.
#[derive(Default)]
pub(crate) struct Photometric {
    targets: Vec<Option<Vec3>>,
    /// d loss / d colour.
    pub d_colors: Vec<Vec3>,
    /// Rays × 3, the two sides of the perceptual term: unknown pixels show the prediction on both.
    prediction: Vec<f32>,
    shown: Vec<f32>,
    /// Gradient of the perceptual term, rays × 3.
    d_prediction: Vec<f32>,
    /// Perceptual terms of the patches.
    dissimilarities: Vec<Dissimilarity>,
    values: Vec<f64>,
}

impl Photometric {
    /// Fills `d_colors`, and in `report` the error of the known pixels and the perceptual term.
    pub fn measure(
        &mut self,
        loss: &LossConfig,
        lpips: Option<&Lpips>,
        groups: &[RayGroup],
        batch: &Batch,
        (labels, pixels): (&Labels, &PixelReader),
        report: &mut StepReport,
    ) -> Result<(), Error> {
        let Self { targets, d_colors, prediction, .. } = self;
        prediction.resize(3 * batch.pixels.len(), 0.0);
        for group in groups {
            for (&ray, composite) in group.rays.iter().zip(&group.composites) {
                composite.color.write_to_slice(&mut prediction[3 * ray..]);
            }
        }
        targets.clear();
        targets.extend(batch.pixels.iter().map(|&p| target(labels, pixels, p, batch.background)));
        let known = targets.iter().flatten().count();
        let mut squares = 0.0f64;
        d_colors.clear();
        d_colors.extend(prediction.chunks_exact(3).zip(&*targets).map(|(color, target)| {
            let Some(target) = target else { return Vec3::ZERO };
            let error = Vec3::from_slice(color) - *target;
            squares += f64::from(error.length_squared());
            loss.mse * 2.0 / (3 * known) as f32 * error
        }));
        report.mse = squares / (3 * known.max(1)) as f64;
        report.psnr = -10.0 * report.mse.max(1e-12).log10();
        if loss.perceptual > 0.0 {
            report.perceptual = self.perceptual(loss.perceptual, lpips, batch.size)?;
        }
        Ok(())
    }

    /// Mean of the patches' perceptual terms; adds `weight` times its gradient to `d_colors` where
    /// the target is known.
    fn perceptual(&mut self, weight: f32, lpips: Option<&Lpips>, size: usize) -> Result<f64, Error> {
        let Self { targets, d_colors, prediction, shown, d_prediction, dissimilarities, values } = self;
        shown.clear();
        shown.extend_from_slice(prediction);
        for (shown, target) in shown.chunks_exact_mut(3).zip(&*targets) {
            if let Some(target) = target {
                target.write_to_slice(shown);
            }
        }
        d_prediction.clear();
        d_prediction.resize(prediction.len(), 0.0);
        let patch = 3 * size * size;
        let count = prediction.len() / patch;
        let scale = weight / count as f32;
        match lpips {
            Some(lpips) => {
                *values = lpips.distance_backward(prediction, shown, size, size, scale, d_prediction)?;
            }
            None => {
                dissimilarities.resize_with(count, Dissimilarity::default);
                d_prediction
                    .par_chunks_mut(patch)
                    .zip(prediction.par_chunks(patch).zip(shown.par_chunks(patch)))
                    .zip(dissimilarities)
                    .map(|((d_a, (a, b)), dissimilarity)| dissimilarity.backward(a, b, size, scale, d_a))
                    .collect_into_vec(values);
            }
        }
        for ((d_color, d), target) in d_colors.iter_mut().zip(d_prediction.chunks_exact(3)).zip(targets) {
            if target.is_some() {
                *d_color += Vec3::from_slice(d);
            }
        }
        Ok(values.iter().sum::<f64>() / count as f64)
    }
}
