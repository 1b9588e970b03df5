//! Distance of two feature maps: normalised over channels, squared differences, weighted.

use rayon::prelude::*;

use crate::maps::Maps;

/// Added to a feature's length before division.
const EPSILON: f32 = 1e-10;

/// Length of a pixel's features, and the factor that normalises them.
fn length_and_scale(features: &[f32]) -> (f32, f32) {
    let length = features.iter().map(|f| f * f).sum::<f32>().sqrt();
    (length, 1.0 / (length + EPSILON))
}

/// Mean over pixels of Σ_c w_c (â_c − b̂_c)² with f̂ = f / (|f| + 1e-10) (Zhang et al. 2018, eq.
/// 1), a value for each image of a. The first half of `maps` is a, the second half is b.
pub(crate) fn distances(maps: &Maps, weights: &[f32]) -> Vec<f64> {
    let (c, half) = (maps.channels, maps.data.len() / 2);
    let (a, b) = maps.data.split_at(half);
    let pixel = |(a, b): (&[f32], &[f32])| {
        let ((_, scale_a), (_, scale_b)) = (length_and_scale(a), length_and_scale(b));
        let terms = a.iter().zip(b).zip(weights).map(|((a, b), w)| w * (a * scale_a - b * scale_b).powi(2));
        f64::from(terms.sum::<f32>())
    };
    let pixels: Vec<f64> = a.par_chunks_exact(c).zip(b.par_chunks_exact(c)).map(pixel).collect();
    let area = maps.height * maps.width;
    pixels.chunks_exact(area).map(|image| image.iter().sum::<f64>() / area as f64).collect()
}

/// Adds `d_distance` × the gradient of [`distances`] by a to `d_a`. A pixel whose features are all
/// zero gets none: rectification would stop it.
pub(crate) fn distances_backward(maps: &Maps, weights: &[f32], d_distance: f32, d_a: &mut Maps) {
    let (c, half) = (maps.channels, maps.data.len() / 2);
    let (a, b) = maps.data.split_at(half);
    let share = 2.0 * d_distance / (maps.height * maps.width) as f32;
    d_a.data.par_chunks_exact_mut(c).zip(a.par_chunks_exact(c).zip(b.par_chunks_exact(c))).for_each(|(d_a, (a, b))| {
        let ((length, scale_a), (_, scale_b)) = (length_and_scale(a), length_and_scale(b));
        if length == 0.0 {
            return;
        }
        let d_unit = |a: f32, b: f32, w: f32| share * w * (a * scale_a - b * scale_b);
        let along: f32 = a.iter().zip(b).zip(weights).map(|((&a, &b), &w)| d_unit(a, b, w) * a * scale_a).sum();
        for (d, ((&a, &b), &w)) in d_a.iter_mut().zip(a.iter().zip(b).zip(weights)) {
            *d += scale_a * (d_unit(a, b, w) - a * along / length);
        }
    });
}
