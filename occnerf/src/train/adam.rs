//! Adam (Kingma and Ba 2015), one instance for each parameter group. Blocks that no gradient has
//! reached are skipped: their step is 0, so the result equals the dense one to the bit.

use rayon::prelude::*;

use crate::config::RateConfig;
use crate::model::field::Parameters;

const BETA_1: f32 = 0.9;
/// Hash-grid gradients are often below 1e-8 (Müller et al. 2022 use 1e-15).
const EPSILON: f32 = 1e-12;
const CHUNK: usize = 1 << 14;
/// Numbers that are skipped together.
const BLOCK: usize = 64;

/// First and second moments of a group, with the number of steps taken.
#[derive(Clone, Debug, Default)]
pub(crate) struct Adam {
    pub first: Vec<f32>,
    pub second: Vec<f32>,
    pub steps: u64,
    /// Blocks that a gradient has reached; derived from the moments in the first step.
    reached: Vec<bool>,
}

impl Adam {
    pub fn new(parameters: usize) -> Self {
        Self { first: vec![0.0; parameters], second: vec![0.0; parameters], steps: 0, reached: Vec::new() }
    }

    /// One step down `gradient`. Entries whose gradient is not finite are left alone; returns how
    /// many there were.
    pub fn step(&mut self, rate: f32, beta_2: f32, parameters: &mut [f32], gradient: &[f32]) -> usize {
        assert_eq!(parameters.len(), self.first.len());
        assert_eq!(gradient.len(), self.first.len());
        if self.reached.is_empty() {
            let moments = self.first.chunks(BLOCK).zip(self.second.chunks(BLOCK));
            self.reached = moments.map(|(m, v)| !are_zero(m) || !are_zero(v)).collect();
        }
        self.steps += 1;
        let exponent = i32::try_from(self.steps).unwrap_or(i32::MAX);
        let correction_1 = 1.0 / (1.0 - f64::from(BETA_1).powi(exponent)) as f32;
        let correction_2 = 1.0 / (1.0 - f64::from(beta_2).powi(exponent)) as f32;
        let moments = (self.first.par_chunks_mut(CHUNK), self.second.par_chunks_mut(CHUNK));
        let reached = self.reached.par_chunks_mut(CHUNK / BLOCK);
        (parameters.par_chunks_mut(CHUNK), gradient.par_chunks(CHUNK), moments.0, moments.1, reached)
            .into_par_iter()
            .map(|(p, g, m, v, reached)| {
                let (c1, c2) = (correction_1, correction_2);
                pulp::Arch::new().dispatch(Update { rate, beta_2, c1, c2, p, g, m, v, reached })
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
    reached: &'a mut [bool],
}

/// Whether all values are zero, of either sign.
#[inline(always)]
fn are_zero(values: &[f32]) -> bool {
    values.iter().fold(0, |bits, value| bits | value.to_bits() << 1) == 0
}

impl pulp::WithSimd for Update<'_> {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> usize {
        let (rate, beta_2, c1, c2) = (self.rate, self.beta_2, self.c1, self.c2);
        let mut bad = 0;
        for (reached, g) in self.reached.iter_mut().zip(self.g.chunks(BLOCK)) {
            *reached = *reached || !are_zero(g);
        }
        let mut start = 0;
        for run in self.reached.chunk_by(|a, b| a == b) {
            let range = start..(start + run.len() * BLOCK).min(self.g.len());
            start = range.end;
            if !run[0] {
                continue;
            }
            let moments = self.m[range.clone()].iter_mut().zip(&mut self.v[range.clone()]);
            for ((p, &g), (m, v)) in self.p[range.clone()].iter_mut().zip(&self.g[range]).zip(moments) {
                let finite = g.is_finite();
                bad += usize::from(!finite);
                let g = if finite { g } else { 0.0 };
                *m = BETA_1 * *m + (1.0 - BETA_1) * g;
                *v = beta_2 * *v + (1.0 - beta_2) * g * g;
                *p -= rate * (*m * c1) / ((*v * c2).sqrt() + EPSILON);
            }
        }
        bad
    }
}

/// Gradients, and an Adam instance for each part.
#[derive(Clone, Debug)]
pub(crate) struct Optimiser {
    pub gradients: Parameters,
    pub moments: [Adam; 4],
}

impl Optimiser {
    /// An optimiser that has taken no step.
    pub fn new(parameters: &Parameters) -> Self {
        let lengths = parameters.0.each_ref().map(Vec::len);
        Self { gradients: parameters.zeros(), moments: lengths.map(Adam::new) }
    }

    pub fn clear_gradients(&mut self) {
        let all = self.gradients.0.iter_mut();
        all.for_each(|g| g.par_chunks_mut(1 << 16).for_each(|chunk| chunk.fill(0.0)));
    }

    /// One Adam step of every part at its rate times `decay`; returns the number of gradients that
    /// were not finite.
    pub fn step(&mut self, parameters: &mut Parameters, rates: &RateConfig, decay: f32) -> usize {
        let each = [rates.field, rates.table, rates.vertices, rates.motion];
        let parts = parameters.0.iter_mut().zip(&self.gradients.0).zip(&mut self.moments);
        parts.zip(each).map(|(((v, g), adam), rate)| adam.step(rate * decay, rates.beta_2, v, g)).sum()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Every number, whatever its gradient.
    fn dense_step(adam: &mut Adam, rate: f32, beta_2: f32, p: &mut [f32], gradient: &[f32]) {
        adam.steps += 1;
        let correction = |beta: f32| 1.0 / (1.0 - f64::from(beta).powi(adam.steps as i32)) as f32;
        let (c1, c2) = (correction(BETA_1), correction(beta_2));
        for (i, &g) in gradient.iter().enumerate() {
            let g = if g.is_finite() { g } else { 0.0 };
            adam.first[i] = BETA_1 * adam.first[i] + (1.0 - BETA_1) * g;
            adam.second[i] = beta_2 * adam.second[i] + (1.0 - beta_2) * g * g;
            p[i] -= rate * (adam.first[i] * c1) / ((adam.second[i] * c2).sqrt() + EPSILON);
        }
    }

    proptest! {
        /// Gradients of some stretches in each step, none of most; in between the moments are read
        /// back, as from a checkpoint.
        #[test]
        fn what_no_gradient_reaches_is_as_the_dense_step_leaves_it(
            n in 1usize..3 * CHUNK, resumed in 0usize..6,
            steps in prop::collection::vec(prop::collection::vec((any::<prop::sample::Index>(), 1usize..40, -1e3f32..1e3), 0..6), 6)
        ) {
            let start: Vec<f32> = (0..n).map(|i| [0.0, -0.0, 1.5, -2e-3][i % 4]).collect();
            let (mut lazy, mut dense) = ((Adam::new(n), start.clone()), (Adam::new(n), start));
            for (step, stretches) in steps.iter().enumerate() {
                if step == resumed {
                    lazy.0 = Adam { reached: Vec::new(), ..lazy.0 };
                }
                let mut gradient: Vec<f32> = (0..n).map(|i| if i % 3 == 0 { -0.0 } else { 0.0 }).collect();
                for (first, len, g) in stretches {
                    let first = first.index(n);
                    gradient[first..n.min(first + len)].fill(if *len == 7 { f32::NAN } else { *g });
                }
                lazy.0.step(0.01, 0.99, &mut lazy.1, &gradient);
                dense_step(&mut dense.0, 0.01, 0.99, &mut dense.1, &gradient);
            }
            let bits = |(adam, p): &(Adam, Vec<f32>)| -> Vec<u32> {
                p.iter().chain(&adam.first).chain(&adam.second).map(|x| x.to_bits()).collect()
            };
            prop_assert!(bits(&lazy) == bits(&dense));
        }
    }

    #[test]
    fn gradients_that_are_not_finite_are_counted_and_do_not_spread() {
        let mut adam = Adam::new(3);
        let mut p = vec![1.0; 3];
        assert_eq!(adam.step(0.1, 0.99, &mut p, &[f32::NAN, f32::INFINITY, 1.0]), 2);
        assert!(p.iter().all(|p| p.is_finite()) && p[0] == 1.0 && p[2] < 1.0);
    }

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
}
