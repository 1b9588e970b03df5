//! The volume kind: canonical weight volumes.

use glam::{Affine3A, Vec3, Vec3A};
use rayon::prelude::*;

use super::MotionSample;

/// Voxels a parallel task of the softmax.
pub(super) const BLOCK: usize = 2048;

/// Layout and initial values of a [`WeightVolume`]. Lengths are in the unit of the model; defaults
/// fit metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WeightVolumeConfig {
    /// Samples an axis, at least 2. 32 is the paper's.
    pub resolution: usize,
    /// Diffused prior: the body takes everything up to this distance from the surface. It is raised
    /// to 0.7 of a cell's diagonal where that is longer, so that interpolation at the surface sees
    /// hardly any background. The smaller, the less do limbs close to each other disturb each
    /// other.
    pub margin: f32,
    /// Diffused prior: the background takes over along this length beyond the margin.
    pub falloff: f32,
    /// Gaussian prior: standard deviation along a bone, as a fraction of its length.
    pub gaussian_along: f32,
    /// Gaussian prior: standard deviation across a bone.
    pub gaussian_across: f32,
}

impl Default for WeightVolumeConfig {
    fn default() -> Self {
        Self { resolution: 32, margin: 0.03, falloff: 0.03, gaussian_along: 0.18, gaussian_across: 0.09 }
    }
}

/// Motion field of learnable weights on a grid in canonical space.
///
/// K + 1 channels, one a joint and the background last, on `resolution`³ samples that span `min` to
/// `max` with samples on the faces of the box. Layout of every array: (K+1, n, n, n) for channel,
/// z, y, x.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightVolume {
    /// Samples an axis, n.
    pub resolution: usize,
    /// Corner of the first sample.
    pub min: Vec3,
    /// Corner of the last sample.
    pub max: Vec3,
    /// K + 1.
    pub channels: usize,
    /// Logarithm of the prior; −∞ where a channel is switched off for good.
    pub log_prior: Vec<f32>,
    /// Δ, learnable, 0 at the start. Call [`WeightVolume::update`] after changing it.
    pub delta: Vec<f32>,
    /// softmax over the channels of `log_prior + delta`.
    pub weights: Vec<f32>,
    /// Range of samples x, y, z in which each bone's prior is above −∞.
    pub(super) support: Vec<Support>,
}

/// Box, in steps of the grid from its first sample and inclusive, outside which interpolated
/// weights are 0. Empty where low is above high.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Support {
    low: Vec3A,
    high: Vec3A,
}

/// A cell and a position in it.
pub(super) struct Cell {
    /// Flat index of the corner with the smallest coordinates, within a channel.
    pub(super) corner: usize,
    /// Weights of the eight corners, x fastest.
    pub(super) mix: [f32; 8],
    /// Position in the cell, 0 to 1.
    pub(super) t: Vec3,
}

impl WeightVolume {
    /// Builds a volume from a prior, (K+1, n, n, n), whose channels sum to 1 at every sample.
    pub(super) fn from_prior(resolution: usize, min: Vec3, max: Vec3, prior: &[f32]) -> Self {
        let samples = resolution.pow(3);
        let channels = prior.len() / samples;
        let log_prior: Vec<f32> = prior.iter().map(|p| p.ln()).collect();
        let support = (log_prior.chunks_exact(samples).take(channels - 1))
            .map(|channel| Support::of(channel, resolution))
            .collect();
        let mut volume = Self {
            resolution,
            min,
            max,
            channels,
            delta: vec![0.0; log_prior.len()],
            weights: vec![0.0; log_prior.len()],
            log_prior,
            support,
        };
        volume.update();
        volume
    }

    /// Recomputes `weights` from `delta`.
    pub fn update(&mut self) {
        let samples = self.resolution.pow(3);
        let (log_prior, delta) = (&self.log_prior, &self.delta);
        let logit = |i: usize| log_prior[i] + delta[i];
        // Blocks of every channel, regrouped by block, so that a task owns one block of all
        // channels.
        let mut blocks: Vec<Vec<&mut [f32]>> = Vec::new();
        blocks.resize_with(samples.div_ceil(BLOCK), Vec::new);
        for channel in self.weights.chunks_exact_mut(samples) {
            for (block, part) in channel.chunks_mut(BLOCK).enumerate() {
                blocks[block].push(part);
            }
        }
        blocks.par_iter_mut().enumerate().for_each(|(block, parts)| {
            let start = block * BLOCK;
            let length = parts[0].len();
            let mut most = vec![f32::NEG_INFINITY; length];
            for channel in 0..parts.len() {
                for i in 0..length {
                    most[i] = most[i].max(logit(channel * samples + start + i));
                }
            }
            let mut sum = vec![0.0f32; length];
            for (channel, part) in parts.iter_mut().enumerate() {
                for i in 0..length {
                    let index = channel * samples + start + i;
                    part[i] = if log_prior[index] == f32::NEG_INFINITY { 0.0 } else { (logit(index) - most[i]).exp() };
                    sum[i] += part[i];
                }
            }
            for part in parts {
                for i in 0..length {
                    part[i] /= sum[i];
                }
            }
        });
    }

    /// Maps `point` in the world: w_i = w^c_i(y_i) with y_i = `to_canonical`_i · x
    /// ([`crate::Posed::to_canonical`]), x̂ = Σ w_i y_i / Σ w_i over the K bones, f = min(Σ w_i,
    /// 1). Trilinear; 0 outside the box.
    ///
    /// `None` (dead) where Σ w_i is below `threshold` or 0, and for anything not finite.
    ///
    /// # Panics
    /// Unless there are K transforms.
    #[must_use]
    pub fn map(&self, to_canonical: &[Affine3A], point: Vec3, threshold: f32) -> Option<MotionSample> {
        assert_eq!(to_canonical.len(), self.channels - 1, "map: transforms of bones");
        let samples = self.resolution.pow(3);
        let (mut sum, mut mean) = (0.0f32, Vec3A::ZERO);
        let point = Vec3A::from(point);
        for (bone, transform) in to_canonical.iter().enumerate() {
            let y = transform.transform_point3a(point);
            let Some(cell) = self.cell(bone, y) else {
                continue;
            };
            let w = self.sample(&self.weights[bone * samples..][..samples], &cell);
            sum += w;
            mean += w * y;
        }
        // Not `<`, so that NaN is dead too.
        if !(sum >= threshold && sum > 0.0) {
            return None;
        }
        let canonical = Vec3::from(mean / sum);
        canonical.is_finite().then_some(MotionSample { canonical, likelihood: sum.min(1.0) })
    }

    #[inline(always)]
    pub(super) fn sample(&self, channel: &[f32], cell: &Cell) -> f32 {
        let mut w = 0.0;
        for (corner, mix) in self.corners(cell.corner).into_iter().zip(cell.mix) {
            w += mix * channel[corner];
        }
        w
    }

    /// Flat indices of a cell's corners, x fastest.
    #[inline(always)]
    pub(super) fn corners(&self, first: usize) -> [usize; 8] {
        let (row, slice) = (self.resolution, self.resolution * self.resolution);
        [0, 1, row, row + 1, slice, slice + 1, slice + row, slice + row + 1].map(|o| first + o)
    }

    /// The cell that holds `y`, if it is in the box and any of its corners in the support of
    /// `bone`.
    #[inline(always)]
    pub(super) fn cell(&self, bone: usize, y: Vec3A) -> Option<Cell> {
        let n = self.resolution;
        let scale = (n - 1) as f32 / Vec3A::from(self.max - self.min);
        let at = (y - Vec3A::from(self.min)) * scale;
        let support = &self.support[bone];
        // NaN fails both comparisons.
        if !(at.cmpge(support.low) & at.cmple(support.high)).all() {
            return None;
        }
        // Truncation is the floor of what is not negative, without a call.
        let [x, y, z] = at.to_array().map(|c| (c as usize).min(n - 2));
        let t = Vec3::from(at) - Vec3::new(x as f32, y as f32, z as f32);
        let s = 1.0 - t;
        let mix = [
            s.x * s.y * s.z,
            t.x * s.y * s.z,
            s.x * t.y * s.z,
            t.x * t.y * s.z,
            s.x * s.y * t.z,
            t.x * s.y * t.z,
            s.x * t.y * t.z,
            t.x * t.y * t.z,
        ];
        Some(Cell { corner: (z * n + y) * n + x, mix, t })
    }
}

impl Support {
    fn of(log_prior: &[f32], n: usize) -> Self {
        let mut out = Self { low: Vec3A::INFINITY, high: Vec3A::NEG_INFINITY };
        for (i, &p) in log_prior.iter().enumerate() {
            if p > f32::NEG_INFINITY {
                let at = Vec3A::new((i % n) as f32, (i / n % n) as f32, (i / (n * n)) as f32);
                out.low = out.low.min(at - 1.0);
                out.high = out.high.max(at + 1.0);
            }
        }
        Self { low: out.low.max(Vec3A::ZERO), high: out.high.min(Vec3A::splat((n - 1) as f32)) }
    }
}
