//! How wrong a tracker is expected to be, and what the frames say of it.

use nalgebra::DVector;

use crate::scene::registration::unknowns::Change;

/// Frames over which errors are forgotten: over k frames of these the correlation falls to
/// (1 + k) e^-k for turns, which change smoothly, and to e^-k for the place.
const TURN_LASTS: f64 = 5.0;
const PLACE_LASTS: f64 = 1.0;

/// Standard deviations of a tracker's errors along one axis, whatever the frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tracker {
    /// The place of the whole across the line of sight and along it, metres of a body 1.7 high.
    pub aside: f64,
    pub away: f64,
    /// Where a bone points in the world, radians.
    pub turn: f64,
}

impl Tracker {
    /// While outlines alone are looked at: a wrong depth is not to be taken for bones that lean.
    pub const OUTLINES: Self = Self { aside: 0.03, away: 0.05, turn: 0.02 };
    /// Turns once colours are looked at, before anything is known of them.
    pub const TURN: f64 = 0.05;
    /// What is expected at least and at most.
    const LEAST: Self = Self { aside: 0.002, away: 0.002, turn: 0.01 };
    const MOST: Self = Self { aside: 0.2, away: 0.2, turn: 0.15 };

    /// Variances of the unknowns of a frame, and what is kept of them `gap` and twice as many frames
    /// later ([`Expected::kept`]), (P) each. `unit` is the length of a metre of a body 1.7 high.
    pub fn expected(&self, unit: f32, own: usize, gap: usize) -> (Vec<f64>, Vec<[f64; 2]>) {
        let Self { aside, away, turn } = *self;
        let unit = f64::from(unit);
        // Two equal roots, or one.
        let root = |frames: f64| (-(gap as f64) / frames).exp();
        let smooth = |root: f64| [2.0 * root, -root * root];
        let each = |i: usize| match i {
            0 | 1 => ((unit * aside).powi(2), [root(PLACE_LASTS), 0.0]),
            2 => ((unit * away).powi(2), [root(PLACE_LASTS), 0.0]),
            _ => (turn * turn, smooth(root(TURN_LASTS))),
        };
        (0..own).map(each).unzip()
    }

    /// The errors that make what was found likelier (Dempster, Laird and Rubin 1977): the mean of
    /// what was found, squared, and of how uncertain that is. Turns take two steps in one, as what
    /// no frame shows of them stays what is expected.
    pub fn learnt(&self, changes: &[Change], variances: &[DVector<f64>], unit: f32) -> Self {
        let mean = |from: usize, to: Option<usize>| -> f64 {
            let (mut sum, mut count) = (0.0, 0);
            for (change, variance) in changes.iter().zip(variances) {
                let found = change.iter().flat_map(|c| c.to_array()).zip(variance.iter());
                for (found, variance) in found.take(to.unwrap_or(usize::MAX)).skip(from) {
                    sum += f64::from(found).powi(2) + variance;
                    count += 1;
                }
            }
            (sum / f64::from(count.max(1))).sqrt()
        };
        let unit = f64::from(unit);
        let turn = mean(3, None);
        Self {
            aside: (mean(0, Some(2)) / unit).clamp(Self::LEAST.aside, Self::MOST.aside),
            away: (mean(2, Some(3)) / unit).clamp(Self::LEAST.away, Self::MOST.away),
            turn: (turn * turn / self.turn).clamp(Self::LEAST.turn, Self::MOST.turn),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::registration::system::{Expected, Normal, Solution, solve};
    use glam::Vec3;
    use volrender::RandomStream;

    /// A walk of bones as wrong as `truth`, of which the first two axes of each are measured.
    fn learnt(truth: Tracker, seed: u64) -> Tracker {
        let (own, frames, noise) = (12, 300, 0.01f64);
        let (variances, kept) = truth.expected(2.0, own, 1);
        let mut stream = RandomStream::new(&[seed]);
        let mut random = || f64::from(stream.normal());
        let mut now = vec![[0.0f64; 2]; own];
        let mut normals = Vec::new();
        // At first they are not yet as wrong as later.
        for frame in 0..frames + 100 {
            let mut normal = Normal::new(own, 0);
            for i in 0..own {
                let [a, b] = kept[i];
                let next = a / (1.0 - b);
                let new = variances[i] * (1.0 - a * next - b * (a * next + b));
                now[i] = [a * now[i][0] + b * now[i][1] + new.sqrt() * random(), now[i][0]];
                if i % 3 < 2 || i == 2 {
                    normal.add(noise.powi(-2), -(now[i][0] + noise * random()), &[i as u32], &[1.0]);
                }
            }
            if frame >= 100 {
                normals.push(normal);
            }
        }
        let mut tracker = Tracker { turn: Tracker::TURN, ..Tracker::OUTLINES };
        let still = vec![DVector::zeros(own); frames];
        for _ in 0..12 {
            let (variances, kept) = tracker.expected(2.0, own, 1);
            let expected = Expected { own: &variances, kept: &kept, shared: &[] };
            let Solution { own: found, variances, .. } =
                solve(&normals, &expected, &still, &DVector::zeros(0)).unwrap();
            let change = |x: &DVector<f64>| -> Vec<Vec3> {
                x.as_slice().chunks(3).map(|c| glam::DVec3::from_slice(c).as_vec3()).collect()
            };
            let changes: Vec<Vec<Vec3>> = found.iter().map(change).collect();
            tracker = tracker.learnt(&changes, &variances, 2.0);
        }
        tracker
    }

    #[test]
    fn as_much_error_is_expected_as_there_is_also_where_not_all_of_it_shows() {
        for (seed, truth) in [
            (1, Tracker { aside: 0.005, away: 0.02, turn: 0.015 }),
            (2, Tracker { aside: 0.02, away: 0.1, turn: 0.05 }),
            (3, Tracker { aside: 0.01, away: 0.005, turn: 0.1 }),
        ] {
            let found = learnt(truth, seed);
            for (found, truth) in [(found.aside, truth.aside), (found.away, truth.away), (found.turn, truth.turn)] {
                assert!((found / truth).ln().abs() < 0.35, "{found} for {truth}");
            }
        }
    }
}
