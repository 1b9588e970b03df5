//! The shaped body: its canonical surface with nearest-point structures, where [v̂, d] of a
//! canonical point comes from, and the prior in any pose.

use glam::Vec3;
use smpl::{BodyModel, Posed, Shaped};
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
use volrender::{Aabb, Camera};

use crate::Error;
use crate::config::{Config, DistanceKind, SurfaceConfig};
use crate::model::view::PosedView;

/// Canonical height that every body is scaled to, so that constants in metres mean the same for
/// all.
const NORMALISED_HEIGHT: f32 = 1.7;
/// Share of its size by which the canonical box is inflated on each side.
const BOX_INFLATION: f32 = 0.05;

/// A body model in the shape of one person, lengths normalised.
///
/// ```
/// use occnerf::{Body, Config, Method, Preset};
///
/// let model = smpl::BodyModel::embedded();
/// let body = Body::new(&model, &[], &Config::preset(Preset::Fast, Method::Occnerf))?;
/// let rest = body.rest();
/// assert_eq!((rest.vertices.len(), rest.joints.len()), (model.num_vertices(), 24));
/// # Ok::<(), occnerf::Error>(())
/// ```
pub struct Body {
    /// The prior as handed in (lengths not normalised).
    pub model: BodyModel,
    /// Normalised metres in one unit of the capture.
    pub scale: f32,
    /// Shape of the canonical body.
    pub mean_betas: Vec<f32>,
    /// Canonical (T-pose, mean betas) vertices, normalised.
    pub canonical: Shaped,
    /// The canonical box that encodings are relative to, inflated by 5 %.
    pub canonical_box: Aabb,
    /// Nearest vertices of the canonical mesh.
    pub query: SurfaceQuery,
    /// Exact distances to the canonical mesh.
    pub surface: MeshDistance,
}

/// Parameters of the body in one frame, in the units of the capture.
#[derive(Clone, Copy, Debug)]
pub struct PosedFrame<'a> {
    /// Shape coefficients.
    pub betas: &'a [f32],
    /// Axis-angle rotation of each joint, (J).
    pub pose: &'a [Vec3],
    /// How the posed body stands in the world.
    pub placement: smpl::Placement,
}

impl Body {
    /// Shapes `model` by `mean_betas` and builds the searches that `config` asks for.
    ///
    /// # Errors
    /// [`Error::Scene`] for a body without height; those of the searches.
    pub fn new(model: &BodyModel, mean_betas: &[f32], config: &Config) -> Result<Self, Error> {
        let mut canonical = model.shaped(mean_betas);
        let Aabb { min: low, max: high } = Aabb::from_points(&canonical.vertices);
        let height = high.y - low.y;
        if !(height.is_finite() && height > 0.0) {
            let what = format!("canonical body is {height} high: expected a finite height above 0");
            return Err(Error::Scene(what));
        }
        let scale = NORMALISED_HEIGHT / height;
        canonical.vertices.iter_mut().chain(&mut canonical.joints).for_each(|v| *v *= scale);
        let (low, high) = (low * scale, high * scale);
        let inflation = BOX_INFLATION * (high - low);
        let query = SurfaceQueryConfig {
            k: config.surface.k,
            coarse_levels: config.surface.coarse_levels,
            // Trees alone where no sample asks for its neighbours.
            cell: if config.needs_neighbours() { 0.02 } else { 0.0 },
            margin: config.motion.reach() + 0.03,
            ratio: 0.25,
        };
        Ok(Self {
            query: SurfaceQuery::new(&canonical.vertices, &model.faces, &query)?,
            surface: MeshDistance::new(&canonical.vertices, &model.faces)?,
            mean_betas: mean_betas.to_owned(),
            model: model.clone(),
            scale,
            canonical_box: Aabb { min: low - inflation, max: high + inflation },
            canonical,
        })
    }

    /// The posed prior of a frame, normalised.
    pub fn pose(&self, frame: PosedFrame<'_>) -> Posed {
        let mut posed = self.model.pose(&self.model.shaped(frame.betas), frame.pose, frame.placement);
        let Posed { vertices, joints, pose_offsets, .. } = &mut posed;
        vertices.iter_mut().chain(joints).chain(pose_offsets).for_each(|v| *v *= self.scale);
        posed.bones.iter_mut().for_each(|b| b.translation *= self.scale);
        posed
    }

    /// The training frame `instant` as `camera` (of the capture) sees it.
    pub(crate) fn view(&self, camera: &Camera, instant: usize, frame: PosedFrame<'_>) -> PosedView {
        let camera = normalised_camera(camera, self.scale);
        PosedView { camera, instant: Some(instant), posed: self.pose(frame) }
    }

    /// The canonical rest pose: no joint turned, the pelvis where the body model has it.
    pub fn rest(&self) -> Posed {
        let joints = vec![Vec3::ZERO; self.model.num_joints()];
        let placement = smpl::Placement::Pelvis { translation: Vec3::ZERO };
        self.pose(PosedFrame { betas: &self.mean_betas, pose: &joints, placement })
    }
}

/// A camera with its lengths multiplied by `scale`.
pub(crate) fn normalised_camera(camera: &Camera, scale: f32) -> Camera {
    let mut camera = *camera;
    camera.world_to_camera.translation *= scale;
    camera
}

/// A canonical point's place on the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SurfacePoint {
    /// v̂.
    pub closest: Vec3,
    /// d, outside positive.
    pub distance: f32,
}

/// The place of `x`, whose `neighbours` (finest level first) are read by the blended kind;
/// `None` where the exact surface is farther than `farthest`.
pub(crate) fn surface_point(
    body: &Body,
    config: &SurfaceConfig,
    x: Vec3,
    neighbours: &[u32],
    farthest: f32,
) -> Option<SurfacePoint> {
    match config.distance {
        DistanceKind::Blended => {
            let blended = body.query.blend(x, &neighbours[..config.k]);
            Some(SurfacePoint { closest: blended.point, distance: blended.signed_distance })
        }
        DistanceKind::Exact => {
            let found = body.surface.closest_within(x, farthest)?;
            Some(SurfacePoint { closest: found.point, distance: found.signed_distance })
        }
    }
}

/// Backward of [`surface_point`]: the gradient with respect to `x`. `at_surface` is the derivative
/// of the exact distance where `x` lies on the surface and has no direction from it.
pub(crate) fn surface_point_backward(
    body: &Body,
    config: &SurfaceConfig,
    (x, neighbours): (Vec3, &[u32]),
    at: SurfacePoint,
    d_at: SurfacePoint,
    at_surface: Vec3,
) -> Vec3 {
    match config.distance {
        DistanceKind::Blended => body.query.blend_backward(x, &neighbours[..config.k], d_at.closest, d_at.distance),
        DistanceKind::Exact => {
            let normal = ((x - at.closest) * at.distance.signum()).normalize_or(at_surface);
            d_at.distance * normal + d_at.closest - normal.dot(d_at.closest) * normal
        }
    }
}
