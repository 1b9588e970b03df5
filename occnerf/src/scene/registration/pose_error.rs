//! Error model of the given poses: variances and time constants of a stationary autoregressive
//! process, re-estimated from the corrections.

use nalgebra::DVector;

use crate::scene::registration::corrections::Correction;

/// Time constants, frames: the autocorrelation at lag k time constants is (1 + k) e^-k for bone
/// rotations, which are smooth, and e^-k for the translation. That of rotations is the longest.
const ROTATION_FRAMES: f64 = 5.0;
const TRANSLATION_FRAMES: f64 = 1.0;
/// Turn of a joint within the time constant of rotations, radians.
const TURN: f64 = 0.25;

/// Standard deviations of the errors of a given pose, per axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PoseErrorModel {
    /// Translation across the line of sight and along it, metres of a body 1.7 high.
    pub lateral: f64,
    pub depth: f64,
    /// World orientation of a bone, radians.
    pub rotation: f64,
    /// Time constant of rotations, frames.
    pub frames: f64,
}

impl PoseErrorModel {
    /// Values for outline residuals alone; tight rotations keep a depth error out of the pose.
    pub const OUTLINES: Self = Self { lateral: 0.03, depth: 0.05, rotation: 0.02, frames: ROTATION_FRAMES };
    /// Initial rotation error once colour residuals are used.
    pub const ROTATION: f64 = 0.05;
    /// Bounds of the estimates.
    const LEAST: Self = Self { lateral: 0.002, depth: 0.002, rotation: 0.01, frames: 1.0 };
    const MOST: Self = Self { lateral: 0.2, depth: 0.2, rotation: 0.15, frames: ROTATION_FRAMES };

    /// Initial model of a video whose poses turn by `rate` radians a frame and joint (root mean square):
    /// errors change as fast as poses do.
    pub fn of_motion(rate: f64) -> Self {
        // Infinite for a person who stands still.
        Self { frames: (TURN / rate).clamp(Self::LEAST.frames, Self::MOST.frames), ..Self::OUTLINES }
    }

    /// Variances of the unknowns of a frame and their autoregressive coefficients at a frame spacing
    /// of `gap` ([`Prior::ar_coefficients`]), (P) each. `unit` is the length of a metre of a body
    /// 1.7 high.
    ///
    /// [`Prior::ar_coefficients`]: crate::scene::registration::system::Prior::ar_coefficients
    pub fn prior(&self, unit: f32, per_frame: usize, gap: usize) -> (Vec<f64>, Vec<[f64; 2]>) {
        let Self { lateral, depth, rotation, .. } = *self;
        let unit = f64::from(unit);
        // Roots of the characteristic polynomial: two equal ones, or one.
        let root = |frames: f64| (-(gap as f64) / frames).exp();
        let smooth = |root: f64| [2.0 * root, -root * root];
        let each = |i: usize| match i {
            0 | 1 => ((unit * lateral).powi(2), [root(TRANSLATION_FRAMES), 0.0]),
            2 => ((unit * depth).powi(2), [root(TRANSLATION_FRAMES), 0.0]),
            _ => (rotation * rotation, smooth(root(self.frames))),
        };
        (0..per_frame).map(each).unzip()
    }

    /// One step of expectation maximisation (Dempster, Laird and Rubin 1977): mean squared correction
    /// plus posterior variance. Rotations take a doubled step, since unobserved axes stay at the
    /// prior.
    pub fn reestimated(&self, corrections: &[Correction], variances: &[DVector<f64>], unit: f32) -> Self {
        let mean = |from: usize, to: Option<usize>| -> f64 {
            let (mut sum, mut count) = (0.0, 0);
            for (correction, variance) in corrections.iter().zip(variances) {
                let found = correction.iter().flat_map(|c| c.to_array()).zip(variance.iter());
                for (found, variance) in found.take(to.unwrap_or(usize::MAX)).skip(from) {
                    sum += f64::from(found).powi(2) + variance;
                    count += 1;
                }
            }
            (sum / f64::from(count.max(1))).sqrt()
        };
        let unit = f64::from(unit);
        let rotation = mean(3, None);
        Self {
            lateral: (mean(0, Some(2)) / unit).clamp(Self::LEAST.lateral, Self::MOST.lateral),
            depth: (mean(2, Some(3)) / unit).clamp(Self::LEAST.depth, Self::MOST.depth),
            frames: self.frames,
            rotation: (rotation * rotation / self.rotation).clamp(Self::LEAST.rotation, Self::MOST.rotation),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::registration::system::{NormalEquations, Prior, Solution, solve};
    use glam::Vec3;
    use volrender::RandomStream;

    /// Estimates from a simulated process with errors `truth`, two axes of each bone being observed.
    fn estimated(truth: PoseErrorModel, seed: u64) -> PoseErrorModel {
        let (per_frame, frames, noise) = (12, 300, 0.01f64);
        let (variances, ar_coefficients) = truth.prior(2.0, per_frame, 1);
        let mut stream = RandomStream::new(&[seed]);
        let mut random = || f64::from(stream.normal());
        let mut now = vec![[0.0f64; 2]; per_frame];
        let mut normals = Vec::new();
        // The process starts at 0 and becomes stationary.
        for frame in 0..frames + 100 {
            let mut normal = NormalEquations::new(per_frame, 0);
            for i in 0..per_frame {
                let [a, b] = ar_coefficients[i];
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
        let mut pose_error = PoseErrorModel { rotation: PoseErrorModel::ROTATION, ..PoseErrorModel::OUTLINES };
        let still = vec![DVector::zeros(per_frame); frames];
        for _ in 0..12 {
            let (variances, ar_coefficients) = pose_error.prior(2.0, per_frame, 1);
            let prior = Prior { per_frame: &variances, ar_coefficients: &ar_coefficients, global: &[] };
            let Solution { per_frame: found, variances, .. } =
                solve(&normals, &prior, &still, &DVector::zeros(0)).unwrap();
            let correction = |x: &DVector<f64>| -> Vec<Vec3> {
                x.as_slice().chunks(3).map(|c| glam::DVec3::from_slice(c).as_vec3()).collect()
            };
            let corrections: Vec<Vec<Vec3>> = found.iter().map(correction).collect();
            pose_error = pose_error.reestimated(&corrections, &variances, 2.0);
        }
        pose_error
    }

    #[test]
    fn estimated_errors_are_the_true_ones_also_of_unobserved_axes() {
        for (seed, truth) in [
            (1, PoseErrorModel { lateral: 0.005, depth: 0.02, rotation: 0.015, frames: 5.0 }),
            (2, PoseErrorModel { lateral: 0.02, depth: 0.1, rotation: 0.05, frames: 5.0 }),
            (3, PoseErrorModel { lateral: 0.01, depth: 0.005, rotation: 0.1, frames: 5.0 }),
        ] {
            let found = estimated(truth, seed);
            for (found, truth) in
                [(found.lateral, truth.lateral), (found.depth, truth.depth), (found.rotation, truth.rotation)]
            {
                assert!((found / truth).ln().abs() < 0.35, "{found} for {truth}");
            }
        }
    }
}
