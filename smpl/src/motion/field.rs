//! One interface for both kinds of motion field.

use glam::{Affine3A, Mat3, Vec3};

use super::{MotionSample, SurfaceMotion, WeightVolume};
use crate::model::BodyModel;
use crate::pose::Posed;

/// A body in one pose, as a motion field needs it.
#[derive(Clone, Debug)]
pub struct MotionFrame<'a> {
    /// The body.
    pub model: &'a BodyModel,
    /// Its pose.
    pub posed: &'a Posed,
    /// World to rest, (J).
    pub to_canonical: Vec<Affine3A>,
}

impl<'a> MotionFrame<'a> {
    /// Inverts the bones once for all points.
    #[must_use]
    pub fn new(model: &'a BodyModel, posed: &'a Posed) -> Self {
        Self { model, posed, to_canonical: posed.to_canonical() }
    }
}

/// The point of a posed surface that is nearest to a query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// The face.
    pub face: u32,
    /// Barycentric coordinates on it; 0 for a corner that has no part in it, so that edges and
    /// corners are told from the inside.
    pub barycentric: [f32; 3],
    /// Distance from the surface to the query, outside positive.
    pub signed_distance: f32,
}

/// Either kind of motion field: from a point x of the world to its canonical point x̂ and the
/// likelihood f.
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, MotionField, MotionFrame, Placement, SurfaceMotion, SurfacePoint};
///
/// let body = BodyModel::embedded();
/// let shaped = body.shaped(&[]);
/// let mut pose = vec![Vec3::ZERO; 24];
/// pose[4].x = 0.8;
/// let posed = body.pose(&shaped, &pose, Placement::default());
/// let frame = MotionFrame::new(&body, &posed);
///
/// let field = MotionField::Surface(SurfaceMotion::default());
/// let x = posed.vertices[body.faces[10][0] as usize];
/// // The nearest point comes from the caller's own search; a volume never asks for it.
/// let nearest = || Some(SurfacePoint { face: 10, barycentric: [1.0, 0.0, 0.0], signed_distance: 0.0 });
/// let sample = field.map(&frame, x, nearest).unwrap();
/// assert!(sample.canonical.distance(shaped.vertices[body.faces[10][0] as usize]) < 1e-4);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub enum MotionField {
    /// Skinning weights of the nearest surface point.
    Surface(SurfaceMotion),
    /// Learnable weight volumes.
    Volume {
        /// The weights.
        weights: WeightVolume,
        /// Samples with Σ w below this are dead.
        threshold: f32,
    },
}

impl MotionField {
    /// Maps `point`; `nearest` is called by the surface kind only, at most once, and its `None`
    /// means too far away. `None`: dead, see [`SurfaceMotion::map`] and [`WeightVolume::map`].
    ///
    /// # Panics
    /// If the parts do not belong to one body.
    #[must_use]
    pub fn map(
        &self,
        frame: &MotionFrame<'_>,
        point: Vec3,
        nearest: impl FnOnce() -> Option<SurfacePoint>,
    ) -> Option<MotionSample> {
        match self {
            Self::Surface(surface) => {
                let SurfacePoint { face, barycentric, signed_distance } = nearest()?;
                surface.map(frame.model, frame.posed, point, face, barycentric, signed_distance)
            }
            Self::Volume { weights, threshold } => weights.map(&frame.to_canonical, point, *threshold),
        }
    }

    /// [`MotionField::map`] with ∂x̂/∂x and ∂f/∂x. The surface kind's includes the way of the
    /// nearest point along its face or edge.
    ///
    /// Both kinds have kinks: cells of the volumes, and where the nearest point passes an edge or
    /// one bone takes over. There the derivative is that of one side.
    ///
    /// # Panics
    /// If the parts do not belong to one body.
    fn map_with_jacobian(
        &self,
        frame: &MotionFrame<'_>,
        point: Vec3,
        nearest: impl FnOnce() -> Option<SurfacePoint>,
    ) -> Option<(MotionSample, Mat3, Vec3)> {
        match self {
            Self::Surface(surface) => surface.map_with_jacobian(frame, point, nearest()?),
            Self::Volume { weights, threshold } => weights.map_with_jacobian(&frame.to_canonical, point, *threshold),
        }
    }

    /// Propagates the gradient of [`MotionField::map`]: returns the derivative with respect to
    /// `point`, and for the volume kind adds to `d_weights`, laid out like `WeightVolume::weights`
    /// ([`WeightVolume::softmax_backward`] takes them on to Δ). The surface kind leaves `d_weights`
    /// alone; it may be empty. Dead points give 0 and add nothing.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn map_backward(
        &self,
        frame: &MotionFrame<'_>,
        point: Vec3,
        nearest: impl FnOnce() -> Option<SurfacePoint>,
        d_canonical: Vec3,
        d_likelihood: f32,
        d_weights: &mut [f32],
    ) -> Vec3 {
        let Some((_, jacobian, gradient)) = self.map_with_jacobian(frame, point, nearest) else {
            return Vec3::ZERO;
        };
        if let Self::Volume { weights, .. } = self {
            weights.map_backward(&frame.to_canonical, point, d_canonical, d_likelihood, d_weights);
        }
        jacobian.transpose() * d_canonical + gradient * d_likelihood
    }
}
