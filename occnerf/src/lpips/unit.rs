//! The distance of two sets of feature maps: channels scaled to unit length, squared differences,
//! weighted.

use rayon::prelude::*;

use super::maps::Maps;

/// Added to a length before it divides.
const EPSILON: f32 = 1e-10;

fn scale(features: &[f32]) -> (f32, f32) {
    let length = features.iter().map(|f| f * f).sum::<f32>().sqrt();
    (length, 1.0 / (length + EPSILON))
}

/// Mean over pixels of Σ_c w_c (â_c − b̂_c)², f̂ = f / (|f| + 1e-10), of image `i` and image `i` +
/// half of `maps`, whose second half is b.
pub(super) fn distances(maps: &Maps, weights: &[f32]) -> Vec<f64> {
    let (c, half) = (maps.channels, maps.data.len() / 2);
    let (a, b) = maps.data.split_at(half);
    let pixel = |(a, b): (&[f32], &[f32])| {
        let ((_, scale_a), (_, scale_b)) = (scale(a), scale(b));
        let terms = a.iter().zip(b).zip(weights).map(|((a, b), w)| w * (a * scale_a - b * scale_b).powi(2));
        f64::from(terms.sum::<f32>())
    };
    let pixels: Vec<f64> = a.par_chunks_exact(c).zip(b.par_chunks_exact(c)).map(pixel).collect();
    let area = maps.height * maps.width;
    pixels.chunks_exact(area).map(|image| image.iter().sum::<f64>() / area as f64).collect()
}

/// Adds `d_distance` × the gradient of each distance by a to `d_a`. A pixel without any feature
/// gets none: what reaches it is lost in the rectification before.
pub(super) fn distances_backward(maps: &Maps, weights: &[f32], d_distance: f32, d_a: &mut Maps) {
    let (c, half) = (maps.channels, maps.data.len() / 2);
    let (a, b) = maps.data.split_at(half);
    let share = 2.0 * d_distance / (maps.height * maps.width) as f32;
    d_a.data.par_chunks_exact_mut(c).zip(a.par_chunks_exact(c).zip(b.par_chunks_exact(c))).for_each(|(d_a, (a, b))| {
        let ((length, scale_a), (_, scale_b)) = (scale(a), scale(b));
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
