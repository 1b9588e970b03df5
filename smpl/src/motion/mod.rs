//! Motion fields: from a point in the world to the canonical pose.

mod volume;

use glam::{Affine3A, Vec3};

pub use volume::WeightVolume;

use crate::model::BodyModel;
use crate::pose::{Posed, blend};

/// A world point mapped to canonical space, from [`MotionField::map`].
///
/// ```
/// use glam::Affine3A;
/// use smpl::{BodyModel, WeightVolume};
///
/// let body = BodyModel::embedded();
/// let shaped = body.shaped(&[]);
/// let volume = WeightVolume::gaussian(&body, &shaped, 32);
/// let points = [shaped.joints[1].midpoint(shaped.joints[4]), shaped.joints[4]]; // thigh and knee
/// let [thigh, knee] = points.map(|point| volume.map(&[Affine3A::IDENTITY; 24], point, 1e-3).unwrap());
/// assert!(thigh.canonical.distance(points[0]) < 1e-5 && thigh.likelihood > 2.0 * knee.likelihood);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// x̂, in the rest pose before pose blend shapes.
    pub canonical: Vec3,
    /// Foreground likelihood f, in [0, 1].
    pub likelihood: f32,
}

/// A posed body with its inverted bones, the per-frame input of [`MotionField::map`].
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, MotionFrame, Placement};
///
/// let body = BodyModel::embedded();
/// let shaped = body.shaped(&[]);
/// let posed = body.pose(&shaped, &[Vec3::splat(0.3); 24], Placement::default());
/// let frame = MotionFrame::new(&body, &posed);
/// // The elbow's bone, joint 18, carries the wrist, joint 20.
/// let wrist = frame.to_canonical[18].transform_point3(posed.joints[20]);
/// assert!(wrist.distance(shaped.joints[20]) < 1e-5);
/// ```
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
    pub fn new(model: &'a BodyModel, posed: &'a Posed) -> Self {
        Self { model, posed, to_canonical: posed.to_canonical() }
    }
}

/// The point of a posed surface nearest to a query.
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, MotionField, MotionFrame, Placement, SurfaceMotion, SurfacePoint};
///
/// let (body, field) = (BodyModel::embedded(), MotionField::Surface(SurfaceMotion::default()));
/// let posed = body.pose(&body.shaped(&[]), &[Vec3::ZERO; 24], Placement::Pelvis { translation: Vec3::Y });
/// // A query in the middle of an edge of face 10.
/// let [a, b, _] = body.faces[10].map(|v| posed.vertices[v as usize]);
/// let nearest = SurfacePoint { face: 10, barycentric: [0.5, 0.5, 0.0], signed_distance: 0.0 };
/// let sample = field.map(&MotionFrame::new(&body, &posed), a.midpoint(b), || Some(nearest)).unwrap();
/// assert!(sample.canonical.distance(a.midpoint(b) - Vec3::Y) < 1e-5);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// The face.
    pub face: u32,
    /// Barycentric coordinates on it, which sum to 1.
    pub barycentric: [f32; 3],
    /// Distance from the surface to the query, outside positive.
    pub signed_distance: f32,
}

/// Motion field of either kind: maps a world point x to its canonical point x̂ and the foreground
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
/// // The nearest point comes from the caller's own search; the volume kind does not call it.
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
    /// Maps `point`. `nearest` is called by the surface kind only, at most once; it returns `None`
    /// for points too far away. Returns `None` for dead points, see [`SurfaceMotion::map`] and
    /// [`WeightVolume::map`].
    ///
    /// # Panics
    /// If frame, volume and surface point are not of the same body.
    pub fn map(
        &self,
        frame: &MotionFrame<'_>,
        point: Vec3,
        nearest: impl FnOnce() -> Option<SurfacePoint>,
    ) -> Option<MotionSample> {
        match self {
            Self::Surface(surface) => surface.map(frame, point, nearest()?),
            Self::Volume { weights, threshold } => weights.map(&frame.to_canonical, point, *threshold),
        }
    }
}

/// Motion field whose weights are those of the nearest point of the posed surface.
///
/// The likelihood is 1 inside the body and outside up to `margin` from it, then falls with a
/// continuous derivative to 0 at `margin + falloff`. The example of [`MotionField`] maps a
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
    const MIN_DETERMINANT: f32 = 0.05;

    /// Maps `point`, whose nearest surface point is `nearest`: x̂ = (Σ w_i A_i)⁻¹ x − B_P, with
    /// weights w and pose offset B_P interpolated on the face.
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
