//! Adam (Kingma and Ba 2015), dense, one instance for each parameter group.

use rayon::prelude::*;

const BETA_1: f32 = 0.9;
/// Small beside any gradient that matters; hash-grid gradients are often below 1e-8 (Müller et al. 2022 use 1e-15).
const EPSILON: f32 = 1e-12;
const CHUNK: usize = 1 << 14;

/// First and second moments of a group, with the number of steps taken.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Adam {
    pub first: Vec<f32>,
    pub second: Vec<f32>,
    pub steps: u64,
}

impl Adam {
    pub fn new(parameters: usize) -> Self {
        Self { first: vec![0.0; parameters], second: vec![0.0; parameters], steps: 0 }
    }

    /// One step down `gradient`. Entries whose gradient is not finite are left alone; returns how many there were.
    pub fn step(&mut self, rate: f32, beta_2: f32, parameters: &mut [f32], gradient: &[f32]) -> usize {
        assert_eq!(parameters.len(), self.first.len());
        assert_eq!(gradient.len(), self.first.len());
        self.steps += 1;
        let exponent = i32::try_from(self.steps).unwrap_or(i32::MAX);
        let correction_1 = 1.0 / (1.0 - f64::from(BETA_1).powi(exponent)) as f32;
        let correction_2 = 1.0 / (1.0 - f64::from(beta_2).powi(exponent)) as f32;
        let chunks = (self.first.par_chunks_mut(CHUNK), self.second.par_chunks_mut(CHUNK));
        (parameters.par_chunks_mut(CHUNK), gradient.par_chunks(CHUNK), chunks.0, chunks.1)
            .into_par_iter()
            .map(|(p, g, m, v)| {
                pulp::Arch::new().dispatch(Update { rate, beta_2, c1: correction_1, c2: correction_2, p, g, m, v })
            })
            .sum()
    }
}

struct Update<'a> {
    rate: f32,
    beta_2: f32,
    c1: f32,
    c2: f32,
    p: &'a mut [f32],
    g: &'a [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
}

impl pulp::WithSimd for Update<'_> {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> usize {
        let (rate, beta_2, c1, c2) = (self.rate, self.beta_2, self.c1, self.c2);
        let mut bad = 0;
        for (((p, &g), m), v) in self.p.iter_mut().zip(self.g).zip(self.m).zip(self.v) {
            let finite = g.is_finite();
            bad += usize::from(!finite);
            let g = if finite { g } else { 0.0 };
            *m = BETA_1 * *m + (1.0 - BETA_1) * g;
            *v = beta_2 * *v + (1.0 - beta_2) * g * g;
            *p -= rate * (*m * c1) / ((*v * c2).sqrt() + EPSILON);
        }
        bad
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_step_moves_each_parameter_by_the_rate_against_its_sign() {
        let mut adam = Adam::new(3);
        let mut p = vec![1.0, 2.0, 3.0];
        assert_eq!(adam.step(0.1, 0.99, &mut p, &[5.0, -0.001, 0.0]), 0);
        for (p, expected) in p.iter().zip([0.9, 2.1, 3.0]) {
            assert!((p - expected).abs() < 1e-5, "{p} {expected}");
        }
    }

    #[test]
    fn minimum_of_a_quadratic_is_found() {
        let mut adam = Adam::new(2);
        let mut p = vec![4.0f32, -3.0];
        for _ in 0..2000 {
            let g = [2.0 * (p[0] - 1.0), 20.0 * (p[1] - 2.0)];
            adam.step(0.02, 0.99, &mut p, &g);
        }
        assert!((p[0] - 1.0).abs() < 0.02 && (p[1] - 2.0).abs() < 0.02, "{p:?}");
    }

    #[test]
    fn gradients_that_are_not_finite_are_counted_and_do_not_spread() {
        let mut adam = Adam::new(3);
        let mut p = vec![1.0; 3];
        assert_eq!(adam.step(0.1, 0.99, &mut p, &[f32::NAN, f32::INFINITY, 1.0]), 2);
        assert!(p.iter().all(|p| p.is_finite()) && p[0] == 1.0 && p[2] < 1.0);
    }
}
