//! Frequency encoding of x̂.

use occnerf::PointEncoder;

/// Bands of the encoding (Weng et al. 2022).
const BANDS: usize = 10;
/// Features of a point.
pub const FEATURES: usize = 3 + 6 * BANDS;

/// x̂ and sin and cos of 2^b · x̂.
#[derive(Debug)]
pub struct Frequencies;

impl PointEncoder for Frequencies {
    fn num_features(&self) -> usize {
        FEATURES
    }

    fn encode(&self, _: &[f32], points: &[[f32; 3]], features: &mut [f32]) {
        points.iter().zip(features.chunks_exact_mut(FEATURES)).for_each(|(x, row)| encode(x, row));
    }

    fn encode_backward_points(&self, points: &[[f32; 3]], d_features: &[f32], d_points: &mut [[f32; 3]]) {
        for ((d, x), d_row) in d_points.iter_mut().zip(points).zip(d_features.chunks_exact(FEATURES)) {
            for axis in 0..3 {
                d[axis] += d_row[axis];
                for (band, pair) in d_row[3..].chunks_exact(6).enumerate() {
                    let frequency = (1u32 << band) as f32;
                    let (sin, cos) = (x[axis] * frequency).sin_cos();
                    d[axis] += frequency * (cos * pair[axis] - sin * pair[3 + axis]);
                }
            }
        }
    }
}

/// Writes the features of one point.
pub fn encode(x: &[f32; 3], row: &mut [f32]) {
    row[..3].copy_from_slice(x);
    for (band, pair) in row[3..FEATURES].chunks_exact_mut(6).enumerate() {
        let frequency = (1u32 << band) as f32;
        for axis in 0..3 {
            (pair[axis], pair[3 + axis]) = (x[axis] * frequency).sin_cos();
        }
    }
}
