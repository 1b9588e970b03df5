//! Motion fields: from a point in the world to the canonical pose.

mod surface;
mod volume;

use glam::{Affine3A, Vec3};

pub use surface::SurfaceMotion;
pub use volume::{WeightVolume, WeightVolumeConfig};

use crate::model::BodyModel;
use crate::pose::Posed;

/// A world point mapped to canonical space, from [`MotionField::map`].
///
/// ```
/// use glam::Affine3A;
/// use smpl::{BodyModel, WeightVolume, WeightVolumeConfig};
///
/// let body = BodyModel::embedded();
/// let shaped = body.shaped(&[]);
/// let volume = WeightVolume::gaussian(&body, &shaped, &WeightVolumeConfig::default());
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
