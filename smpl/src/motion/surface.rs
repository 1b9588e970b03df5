//! The surface kind: skinning weights of the nearest surface point.

use glam::Vec3;

use super::{MotionFrame, MotionSample, SurfacePoint};
use crate::pose::blend;

/// Motion field whose weights are those of the nearest point of the posed surface.
///
/// The likelihood is 1 inside the body and outside up to `margin` from it, then falls with a
/// continuous derivative to 0 at `margin + falloff`. The example of [`super::MotionField`] maps a
/// point.
///
/// ```
/// use smpl::SurfaceMotion;
///
/// let motion = SurfaceMotion { margin: 16.0, falloff: 32.0 }; // a model in millimetres
/// let likelihoods = [-100.0, 16.0, 32.0, 48.0].map(|distance| motion.likelihood(distance));
/// assert_eq!(likelihoods, [1.0, 1.0, 0.5, 0.0]);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceMotion {
    /// Distance from the surface up to which f is 1, in the unit of the model.
    pub margin: f32,
    /// Width of the fall of f to 0 beyond the margin, in the unit of the model; 0 gives a step.
    pub falloff: f32,
}

impl Default for SurfaceMotion {
    /// 5 cm, then 5 cm more, for models in metres.
    fn default() -> Self {
        Self { margin: 0.05, falloff: 0.05 }
    }
}

impl SurfaceMotion {
    /// Blended bones with a determinant below this are replaced by the heaviest bone alone. Two
    /// rigid bones in equal parts reach it at a relative turn of 154°.
    pub const MIN_DETERMINANT: f32 = 0.05;

    /// Maps `point`, whose nearest surface point is `nearest`: x̂ = (Σ w_i A_i)⁻¹ x − B_P, with weights
    /// w and pose offset B_P interpolated on the face.
    ///
    /// `None` (dead) where the likelihood is 0, and for anything not finite.
    ///
    /// Limits: x̂ is discontinuous where the nearest point is (on the medial axis, so also between
    /// touching limbs), and where a fold is so sharp that one bone takes over.
    ///
    /// # Panics
    /// If `nearest` is not on a face of the frame's body.
    pub fn map(&self, frame: &MotionFrame<'_>, point: Vec3, nearest: SurfacePoint) -> Option<MotionSample> {
        let MotionFrame { model, posed, .. } = *frame;
        let SurfacePoint { face, barycentric, signed_distance } = nearest;
        let likelihood = self.likelihood(signed_distance);
        if likelihood.is_nan() || likelihood <= 0.0 {
            return None;
        }
        let corners = model.faces[face as usize].map(|v| v as usize);
        let weights = || {
            (corners.iter().zip(barycentric))
                .flat_map(|(&v, b)| model.weights.row(v).map(move |(joint, w)| (joint, b * w)))
        };
        let mut to_world = blend(&posed.bones, weights());
        if to_world.matrix3.determinant() < Self::MIN_DETERMINANT {
            to_world = posed.bones[heaviest(weights())];
        }
        let offset: Vec3 = (corners.iter().zip(barycentric)).map(|(&v, b)| b * posed.pose_offsets[v]).sum();
        let canonical = to_world.inverse().transform_point3(point) - offset;
        canonical.is_finite().then_some(MotionSample { canonical, likelihood })
    }

    /// The foreground likelihood f at a signed distance (outside positive); NaN for NaN.
    pub fn likelihood(&self, signed_distance: f32) -> f32 {
        let beyond = signed_distance - self.margin;
        if beyond <= 0.0 {
            return 1.0;
        }
        if beyond >= self.falloff {
            return 0.0;
        }
        let s = beyond / self.falloff;
        1.0 - s * s * (3.0 - 2.0 * s)
    }
}

/// The joint with the largest total weight; of equals, the lower.
fn heaviest(weights: impl Iterator<Item = (usize, f32)>) -> usize {
    let mut totals: Vec<(usize, f32)> = Vec::new();
    for (joint, w) in weights {
        match totals.iter_mut().find(|(j, _)| *j == joint) {
            Some((_, total)) => *total += w,
            None => totals.push((joint, w)),
        }
    }
    let mut best = (0, f32::NEG_INFINITY);
    for (joint, total) in totals {
        if total > best.1 || (total == best.1 && joint < best.0) {
            best = (joint, total);
        }
    }
    best.0
}
