//! Shrinkage of a texture's details by their agreement between two halves of the frames.
//!
//! Frames of a moving person that are registered to a few pixels leave streaks in a least-squares texture:
//! noise, which differs between halves of the frames, where detail is the same. The correlation r of a
//! detail between the halves gives the Wiener gain of the whole, 2 r / (1 + r), as Fourier ring
//! correlation does for images of electron microscopes.

use std::ops::{Add, Mul};

use glam::Vec3;
use rayon::prelude::*;

/// Bands of detail, from 1 texel, each twice as wide as the one before.
const BANDS: u32 = 4;
/// Passes of the filter over products of details, each twice as wide as the one before.
const WINDOW: u32 = 3;
/// No texel.
const NONE: u32 = u32::MAX;

/// The texels that both halves show.
pub(super) struct Shown {
    /// Indices in the atlas, ascending.
    pub texels: Vec<u32>,
    /// Position in `texels` of each texel of the atlas, or [`NONE`].
    positions: Vec<u32>,
    width: usize,
}

impl Shown {
    /// Those of an atlas of this width whose weight in either half, (H · W), is at least `least`.
    pub fn new(width: usize, halves: [&[f32]; 2], least: f32) -> Self {
        let is_shown = |&i: &u32| halves.iter().all(|half| half[i as usize] >= least);
        let texels: Vec<u32> = (0..halves[0].len() as u32).filter(is_shown).collect();
        let mut positions = vec![NONE; halves[0].len()];
        texels.iter().zip(0..).for_each(|(&texel, position)| positions[texel as usize] = position);
        Self { texels, positions, width }
    }

    /// Binomial filter [1 2 1] / 4 of `values`, a shown texel each, along both axes, with taps `step`
    /// texels apart; a texel stands in for neighbours that are not shown.
    fn filter<T>(&self, values: &[T], step: usize) -> Vec<T>
    where
        T: Copy + Send + Sync + Add<Output = T> + Mul<f32, Output = T>,
    {
        let along = |values: &[T], stride: usize| -> Vec<T> {
            let near = |texel: Option<usize>, own: T| {
                let position = texel.and_then(|texel| self.positions.get(texel)).filter(|&&position| position != NONE);
                position.map_or(own, |&position| values[position as usize])
            };
            let filtered = |(&texel, &own): (&u32, &T)| {
                let (before, after) = ((texel as usize).checked_sub(stride), texel as usize + stride);
                own * 0.5 + (near(before, own) + near(Some(after), own)) * 0.25
            };
            self.texels.par_iter().zip(values).map(filtered).collect()
        };
        along(&along(values, step), step * self.width)
    }

    /// The `update` of the shown texels with each band of detail shrunk to what the updates of the `halves`
    /// share.
    pub fn shrunk(&self, update: &[Vec3], halves: [&[Vec3]; 2]) -> Vec<Vec3> {
        let mut rests = [update.to_vec(), halves[0].to_vec(), halves[1].to_vec()];
        let mut out = vec![Vec3::ZERO; update.len()];
        for band in 0..BANDS {
            let step = 1 << band;
            let details = rests.each_mut().map(|rest| {
                let low = self.filter(rest, step);
                let detail: Vec<Vec3> = rest.iter().zip(&low).map(|(value, low)| *value - *low).collect();
                *rest = low;
                detail
            });
            let [detail, a, b] = &details;
            let products = |(a, b): (&Vec3, &Vec3)| (a.dot(*b), 0.5 * (a.length_squared() + b.length_squared()));
            let (mut covariance, mut variance): (Vec<f32>, Vec<f32>) = a.iter().zip(b).map(products).unzip();
            for pass in 0..WINDOW {
                (covariance, variance) = (self.filter(&covariance, step << pass), self.filter(&variance, step << pass));
            }
            for (((out, detail), covariance), variance) in out.iter_mut().zip(detail).zip(covariance).zip(variance) {
                let r = (covariance / variance.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
                *out += 2.0 * r / (1.0 + r) * *detail;
            }
        }
        out.iter().zip(&rests[0]).map(|(details, rest)| *details + *rest).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use volrender::RandomStream;

    /// All texels but those on which `hidden` is.
    fn shown(width: usize, height: usize, hidden: impl Fn(usize) -> bool) -> Shown {
        let weights: Vec<f32> = (0..width * height).map(|i| if hidden(i) { 0.0 } else { 1.0 }).collect();
        Shown::new(width, [&weights, &weights], 0.5)
    }

    fn noise(count: usize, seed: u64) -> Vec<Vec3> {
        let mut stream = RandomStream::new(&[seed]);
        (0..count).map(|_| Vec3::new(stream.normal(), stream.normal(), stream.normal())).collect()
    }

    fn energy(values: &[Vec3]) -> f32 {
        values.iter().map(|value| value.length_squared()).sum()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        #[test]
        fn the_filter_is_a_sum_over_nine_neighbours(seed in any::<u64>(), step in 1usize..4) {
            let shown = shown(24, 20, |_| false);
            let values = noise(24 * 20, seed);
            let found = shown.filter(&values, step);
            let taps = [(-1, 0.25), (0, 0.5), (1, 0.25)];
            for (x, y) in (step..24 - step).flat_map(|x| (step..20 - step).map(move |y| (x, y))) {
                let mut sum = Vec3::ZERO;
                for ((i, u), (j, v)) in taps.into_iter().flat_map(|a| taps.map(|b| (a, b))) {
                    let at = |p: usize, i: isize| p.wrapping_add_signed(i * step as isize);
                    sum += u * v * values[at(y, j) * 24 + at(x, i)];
                }
                prop_assert!(found[y * 24 + x].distance(sum) < 1e-5);
            }
        }

        /// Gaps between the texels change nothing.
        #[test]
        fn details_that_agree_stay(seed in any::<u64>(), gap in 2usize..9) {
            let shown = shown(32, 32, |i| i % gap == 0);
            let values = noise(shown.texels.len(), seed);
            let found = shown.shrunk(&values, [&values, &values]);
            prop_assert!(found.iter().zip(&values).all(|(a, b)| a.distance(*b) < 1e-4));
        }

        /// A pattern with noise that differs between the halves comes nearer to the pattern; noise alone
        /// nearly vanishes.
        #[test]
        fn details_that_differ_vanish(seed in any::<u64>()) {
            const SIDE: usize = 64;
            let shown = shown(SIDE, SIDE, |_| false);
            let (a, b) = (noise(SIDE * SIDE, seed), noise(SIDE * SIDE, !seed));
            let mean = |a: &[Vec3], b: &[Vec3]| a.iter().zip(b).map(|(a, b)| 0.5 * (*a + *b)).collect::<Vec<_>>();
            let whole = mean(&a, &b);
            prop_assert!(energy(&shown.shrunk(&whole, [&a, &b])) < 0.15 * energy(&whole));
            // Stripes 3 texels wide on the left half.
            let pattern = |i: usize| if i % SIDE < SIDE / 2 && i % 6 < 3 { 1.5 } else { 0.0 };
            let with = |noise: &[Vec3]| noise.iter().enumerate().map(|(i, n)| *n + pattern(i)).collect::<Vec<_>>();
            let (a, b) = (with(&a), with(&b));
            let error = |values: &[Vec3]| {
                energy(&values.iter().enumerate().map(|(i, value)| *value - pattern(i)).collect::<Vec<_>>())
            };
            let whole = mean(&a, &b);
            prop_assert!(error(&shown.shrunk(&whole, [&a, &b])) < 0.7 * error(&whole));
        }
    }

    #[test]
    fn nothing_shown_and_nothing_updated_are_finite() {
        let none = shown(4, 4, |_| true);
        assert!(none.shrunk(&[], [&[], &[]]).is_empty());
        let still = vec![Vec3::ZERO; 16];
        assert_eq!(shown(4, 4, |_| false).shrunk(&still, [&still, &still]), still);
    }
}
