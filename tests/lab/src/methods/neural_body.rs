//! Latent codes on the prior's vertices, spread through space by inverse distances over the nearest
//! ones of every level, beside frequencies of x̂ (after Peng et al. 2021, Neural Body, whose sparse
//! convolutions do the spreading).

use occnerf::PointEncoder;
use volrender::RandomStream;

use super::frequency::{FEATURES, encode};
use super::neighbours::Neighbours;

const SEED: u64 = 0x434F_4445;
/// Standard deviation of a code's entries before the first step.
const INITIAL: f32 = 0.1;

/// A code of [`FEATURES`] numbers a vertex.
#[derive(Debug)]
pub struct NeuralBody {
    neighbours: Neighbours,
    count: usize,
}

impl NeuralBody {
    pub fn new(neighbours: Neighbours) -> Self {
        Self { count: neighbours.query.neighbours_per_query(), neighbours }
    }
}

impl PointEncoder for NeuralBody {
    fn num_features(&self) -> usize {
        2 * FEATURES
    }

    fn initial(&self, seed: u64) -> Vec<f32> {
        let mut stream = RandomStream::new(&[seed, SEED]);
        (0..self.neighbours.vertices.len() * FEATURES).map(|_| INITIAL * stream.normal()).collect()
    }

    fn encode(&self, codes: &[f32], points: &[[f32; 3]], features: &mut [f32]) {
        self.neighbours.of(points, self.count, |index, x, vertices, shares| {
            let row = &mut features[2 * FEATURES * index..][..2 * FEATURES];
            encode(&x.to_array(), row);
            let row = &mut row[FEATURES..];
            row.fill(0.0);
            for (&v, &share) in vertices.iter().zip(shares) {
                let code = &codes[v as usize * FEATURES..][..FEATURES];
                row.iter_mut().zip(code).for_each(|(sum, x)| *sum = share.mul_add(*x, *sum));
            }
        });
    }

    fn encode_backward(&self, points: &[[f32; 3]], d_features: &[f32], d_codes: &mut [f32]) {
        self.neighbours.of(points, self.count, |index, _, vertices, shares| {
            let d_row = &d_features[2 * FEATURES * index + FEATURES..][..FEATURES];
            for (&v, &share) in vertices.iter().zip(shares) {
                let d_code = &mut d_codes[v as usize * FEATURES..][..FEATURES];
                d_code.iter_mut().zip(d_row).for_each(|(d, x)| *d = share.mul_add(*x, *d));
            }
        });
    }
}
