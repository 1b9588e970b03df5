//! The volume kind: learnable weight volumes in canonical space (HumanNeRF, Weng et al. 2022).

use glam::{Affine3A, Mat3, Vec3, Vec3A};
use rayon::prelude::*;

use super::MotionSample;
use crate::model::{BodyModel, Shaped};

/// Least prior of the background: with 0, learning could not raise it inside the body.
const BACKGROUND_FLOOR: f32 = 1e-3;
/// A bone is switched off at samples where its Gaussian is below this. The tails matter at the
/// joints.
const GAUSSIAN_CUT: f32 = 1e-4;

/// Standard deviation of a Gaussian along its bone, as a fraction of the bone's length.
const ALONG: f32 = 0.18;
/// Standard deviation of a Gaussian across its bone, metres. The box is that much larger than the
/// body's on every side.
const ACROSS: f32 = 0.09;

/// Motion field of learnable weights on a grid in canonical space.
///
/// K + 1 channels, one per joint and the background last, on `resolution`³ samples that span `min`
/// to `max` with samples on the faces of the box. Layout of every array: (K+1, n, n, n) for
/// channel, z, y, x.
///
/// The prior has holes: Σ w is about 0.9 in the middle of a thigh and a few percent at knees and
/// elbows, in the canonical pose already. There f, and with it the opacity, starts low, and limbs
/// come apart until Δ has filled the holes. [`super::SurfaceMotion`] has none.
///
/// ```
/// use smpl::{BodyModel, Placement, WeightVolume};
///
/// let body = BodyModel::embedded();
/// let shaped = body.shaped(&[]);
/// let volume = WeightVolume::gaussian(&body, &shaped, 32);
/// assert_eq!(volume.weights.len(), (24 + 1) * 32 * 32 * 32);
/// let posed = body.pose(&shaped, &vec![glam::Vec3::ZERO; 24], Placement::default());
/// let thigh = shaped.joints[1].midpoint(shaped.joints[4]);
/// let sample = volume.map(&posed.to_canonical(), thigh, 1e-3).unwrap();
/// assert!(sample.canonical.distance(thigh) < 1e-4 && sample.likelihood > 0.8);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct WeightVolume {
    /// Samples per axis, n.
    pub resolution: usize,
    /// Corner of the first sample.
    pub min: Vec3,
    /// Corner of the last sample.
    pub max: Vec3,
    /// K + 1, one per joint and the background.
    pub channels: usize,
    /// Logarithm of the prior; −∞ where a channel is switched off permanently.
    pub log_prior: Vec<f32>,
    /// Δ, learnable, 0 at the start. Call [`WeightVolume::update`] after changing it.
    pub delta: Vec<f32>,
    /// softmax over the channels of `log_prior + delta`.
    pub weights: Vec<f32>,
    /// Range of samples x, y, z in which each bone's prior is above −∞.
    support: Vec<Support>,
}

/// Box in grid units, inclusive, outside which the interpolated weights are 0. Empty if low > high.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Support {
    low: Vec3A,
    high: Vec3A,
}

/// Trilinear interpolation in one cell.
struct Cell {
    /// Flat index of the corner with the smallest coordinates, within a channel.
    corner: usize,
    /// Weights of the eight corners, x fastest.
    mix: [f32; 8],
}

impl WeightVolume {
    /// The paper's prior: bone i, from joint i to each of its children (leaves: to twice the mean
    /// of their own vertices), is an oriented Gaussian g_i; the background is 1 − min(Σ g, 1).
    /// `resolution` samples per axis: 32 are the paper's. The model is in metres.
    ///
    /// # Panics
    /// If the resolution is below 2, or `shaped` is not of `model`.
    pub fn gaussian(model: &BodyModel, shaped: &Shaped, resolution: usize) -> Self {
        let n = resolution;
        assert!(n >= 2, "weight volume: resolution {n}, need at least 2");
        let min = shaped.vertices.iter().copied().fold(Vec3::INFINITY, Vec3::min) - ACROSS;
        let max = shaped.vertices.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max) + ACROSS;
        let cell = (max - min) / (n - 1) as f32;
        let (samples, joints) = (n.pow(3), model.num_joints());
        let mut prior = vec![0.0f32; samples * (joints + 1)];
        let (body, background) = prior.split_at_mut(samples * joints);
        for (joint, channel) in body.chunks_exact_mut(samples).enumerate() {
            let start = shaped.joints[joint];
            let children = (0..joints).filter(|&child| model.parents[child] == Some(joint));
            let mut ends: Vec<Vec3> = children.map(|child| shaped.joints[child]).collect();
            if ends.is_empty() {
                ends.push(2.0 * own_centre(model, shaped, joint) - start);
            }
            let bones: Vec<Gaussian> = ends.iter().map(|&end| Gaussian::new(start, end)).collect();
            for (i, value) in channel.iter_mut().enumerate() {
                let x = min + Vec3::new((i % n) as f32, (i / n % n) as f32, (i / (n * n)) as f32) * cell;
                let g: f32 = bones.iter().map(|g| g.value(x)).sum();
                if g > GAUSSIAN_CUT {
                    *value = g.min(1.0);
                    background[i] += g;
                }
            }
        }
        for value in background {
            *value = (1.0 - value.min(1.0)).max(BACKGROUND_FLOOR);
        }
        let log_prior: Vec<f32> = prior.iter().map(|p| p.ln()).collect();
        let bones = log_prior.chunks_exact(samples).take(joints);
        let mut volume = Self {
            resolution: n,
            min,
            max,
            channels: joints + 1,
            delta: vec![0.0; prior.len()],
            weights: vec![0.0; prior.len()],
            support: bones.map(|channel| Support::of(channel, n)).collect(),
            log_prior,
        };
        volume.update();
        volume
    }

    /// Recomputes `weights` from `delta`.
    pub fn update(&mut self) {
        let samples = self.resolution.pow(3);
        let mut largest = vec![f32::NEG_INFINITY; samples];
        for (prior, delta) in self.log_prior.chunks_exact(samples).zip(self.delta.chunks_exact(samples)) {
            for i in 0..samples {
                largest[i] = largest[i].max(prior[i] + delta[i]);
            }
        }
        let logits = self.log_prior.par_chunks_exact(samples).zip(self.delta.par_chunks_exact(samples));
        self.weights.par_chunks_exact_mut(samples).zip(logits).for_each(|(weights, (prior, delta))| {
            for i in 0..samples {
                let is_off = prior[i] == f32::NEG_INFINITY;
                weights[i] = if is_off { 0.0 } else { (prior[i] + delta[i] - largest[i]).exp() };
            }
        });
        let mut sum = vec![0.0f32; samples];
        for weights in self.weights.chunks_exact(samples) {
            sum.iter_mut().zip(weights).for_each(|(sum, w)| *sum += w);
        }
        self.weights.par_chunks_exact_mut(samples).for_each(|weights| {
            weights.iter_mut().zip(&sum).for_each(|(w, sum)| *w /= sum);
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
    pub fn map(&self, to_canonical: &[Affine3A], point: Vec3, threshold: f32) -> Option<MotionSample> {
        let (sum, mean) = self.blend(to_canonical, point);
        // Not `<`, so that NaN is dead too.
        if !(sum >= threshold && sum > 0.0) {
            return None;
        }
        let canonical = Vec3::from(mean / sum);
        canonical.is_finite().then_some(MotionSample { canonical, likelihood: sum.min(1.0) })
    }

    /// Propagates the gradient of [`WeightVolume::map`] to the softmaxed weights: ∂x̂/∂w_i = (y_i −
    /// x̂)/Σw, and ∂f/∂w_i = 1 where Σ w < 1, else 0. Adds to `d_weights`, laid out like `weights`.
    ///
    /// Nothing is added for a sample that is dead at any threshold. Derivatives with respect to the
    /// point and the transforms are not computed.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn map_backward(
        &self,
        to_canonical: &[Affine3A],
        point: Vec3,
        d_canonical: Vec3,
        d_likelihood: f32,
        d_weights: &mut [f32],
    ) {
        assert_eq!(d_weights.len(), self.weights.len(), "map_backward: d_weights");
        let (sum, mean) = self.blend(to_canonical, point);
        if sum.is_nan() || sum <= 0.0 {
            return;
        }
        let samples = self.resolution.pow(3);
        let canonical = mean / sum;
        let d_sum = if sum < 1.0 { d_likelihood } else { 0.0 };
        let (point, d_canonical) = (Vec3A::from(point), Vec3A::from(d_canonical));
        for (bone, transform) in to_canonical.iter().enumerate() {
            let y = transform.transform_point3a(point);
            let Some(cell) = self.cell(bone, y) else { continue };
            let d_w = d_canonical.dot(y - canonical) / sum + d_sum;
            let channel = &mut d_weights[bone * samples..][..samples];
            for (corner, mix) in self.corners(cell.corner).into_iter().zip(cell.mix) {
                channel[corner] += mix * d_w;
            }
        }
    }

    /// Propagates the gradient of [`WeightVolume::update`]: adds w_c (d_c − Σ_k w_k d_k) to
    /// `d_delta`. All three arrays share one layout.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn softmax_backward(&self, d_weights: &[f32], d_delta: &mut [f32]) {
        assert_eq!(d_weights.len(), self.weights.len(), "softmax_backward: d_weights");
        assert_eq!(d_delta.len(), self.weights.len(), "softmax_backward: d_delta");
        let samples = self.resolution.pow(3);
        let mut mean = vec![0.0f32; samples];
        for (w, d) in (self.weights.chunks_exact(samples)).zip(d_weights.chunks_exact(samples)) {
            for i in 0..samples {
                mean[i] += w[i] * d[i];
            }
        }
        let channels = self.weights.chunks_exact(samples).zip(d_weights.chunks_exact(samples));
        for (out, (w, d)) in d_delta.chunks_exact_mut(samples).zip(channels) {
            for i in 0..samples {
                out[i] += w[i] * (d[i] - mean[i]);
            }
        }
    }

    /// Σ w_i and Σ w_i y_i over the K bones.
    #[inline(always)]
    fn blend(&self, to_canonical: &[Affine3A], point: Vec3) -> (f32, Vec3A) {
        assert_eq!(to_canonical.len(), self.channels - 1, "map: transforms of bones");
        let samples = self.resolution.pow(3);
        let (mut sum, mut mean) = (0.0f32, Vec3A::ZERO);
        let point = Vec3A::from(point);
        for (bone, transform) in to_canonical.iter().enumerate() {
            let y = transform.transform_point3a(point);
            let Some(cell) = self.cell(bone, y) else { continue };
            let channel = &self.weights[bone * samples..][..samples];
            let mut w = 0.0;
            for (corner, mix) in self.corners(cell.corner).into_iter().zip(cell.mix) {
                w += mix * channel[corner];
            }
            sum += w;
            mean += w * y;
        }
        (sum, mean)
    }

    /// Flat indices of a cell's corners, x fastest.
    #[inline(always)]
    fn corners(&self, first: usize) -> [usize; 8] {
        let (row, slice) = (self.resolution, self.resolution * self.resolution);
        [0, 1, row, row + 1, slice, slice + 1, slice + row, slice + row + 1].map(|o| first + o)
    }

    /// The cell containing `y`, if it is in the box and in the support of `bone`.
    #[inline(always)]
    fn cell(&self, bone: usize, y: Vec3A) -> Option<Cell> {
        let n = self.resolution;
        let scale = (n - 1) as f32 / Vec3A::from(self.max - self.min);
        let at = (y - Vec3A::from(self.min)) * scale;
        let support = &self.support[bone];
        // NaN fails both comparisons.
        if !(at.cmpge(support.low) & at.cmple(support.high)).all() {
            return None;
        }
        // Truncation equals floor for values that are not negative, and needs no call.
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
        Some(Cell { corner: (z * n + y) * n + x, mix })
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

/// exp(−½ (x − centre)ᵀ Σ⁻¹ (x − centre)) with one deviation along a bone and another across.
struct Gaussian {
    centre: Vec3,
    /// World to standard deviations.
    whiten: Mat3,
}

impl Gaussian {
    fn new(start: Vec3, end: Vec3) -> Self {
        let direction = (end - start).normalize_or(Vec3::Y);
        let (u, v) = direction.any_orthonormal_pair();
        // Short bones (pelvis to hips) would otherwise be sheets.
        let along = (ALONG * start.distance(end)).max(0.5 * ACROSS);
        Self {
            centre: start.midpoint(end),
            whiten: Mat3::from_cols(direction / along, u / ACROSS, v / ACROSS).transpose(),
        }
    }

    fn value(&self, x: Vec3) -> f32 {
        (-0.5 * (self.whiten * (x - self.centre)).length_squared()).exp()
    }
}

/// Mean of the vertices weighted by their skinning weight of `joint`; the joint itself if all are
/// 0.
fn own_centre(model: &BodyModel, shaped: &Shaped, joint: usize) -> Vec3 {
    let (mut sum, mut total) = (Vec3::ZERO, 0.0);
    for (v, &vertex) in shaped.vertices.iter().enumerate() {
        for (column, w) in model.weights.row(v) {
            if column == joint {
                sum += w * vertex;
                total += w;
            }
        }
    }
    if total > 0.0 { sum / total } else { shaped.joints[joint] }
}
