//! A trained person, or one in training.

use std::sync::Arc;

use glam::{Mat3A, Vec3};
use smpl::{MotionField, SurfaceMotion, WeightVolume};
use visibility::VisibilityCounts;
use volrender::{Occupancy, OccupancyConfig};

use crate::Error;
use crate::capture::Light;
use crate::config::{Config, FALLOFF, MotionConfig, MotionKind};
use crate::model::body::Body;
use crate::model::colors::PriorColors;
use crate::model::encoder::{Encoder, VertexCode};
use crate::model::extent::Extent;
use crate::model::field::{Field, Learnt, PARTS, Parameters, Part, SampleBatch};
use crate::model::view::PosedView;

/// Σ w below which the weight volume has no correspondence.
const VOLUME_THRESHOLD: f32 = 1e-3;
/// Side of a cell near the canonical prior, normalised metres.
const NEAR_CELL: f32 = 0.01;

/// The field of one person on its body, with the training frames' poses and cameras.
#[derive(Clone)]
pub struct Model {
    pub(crate) config: Config,
    pub(crate) body: Arc<Body>,
    /// The training frames' poses and cameras.
    pub(crate) frames: Vec<Arc<PosedView>>,
    pub(crate) field: Field,
    pub(crate) parameters: Parameters,
    pub(crate) counts: VisibilityCounts,
    pub(crate) motion: MotionField,
    /// Cells near the canonical prior; empty for the surface motion.
    pub(crate) near_canonical: Occupancy,
    /// Outer end of the field at its last measurement.
    pub(crate) extent: Extent,
    /// Initial colours; may be empty.
    pub(crate) base: PriorColors,
    pub(crate) steps_done: u64,
}

impl Model {
    /// A model at step 0; `base` are the initial colours, or empty.
    pub(crate) fn new(
        config: Config,
        body: Arc<Body>,
        frames: Vec<Arc<PosedView>>,
        base: PriorColors,
    ) -> Result<Self, Error> {
        config.validate()?;
        let (levels, lists) = (body.query.pyramid().levels.len(), body.query.neighbours_per_query());
        let (wanted, k) = (config.surface.coarse_levels + 1, config.surface.k);
        if levels != wanted || lists != levels * k {
            let k_of_body = lists / levels.max(1);
            let found = format!("was prepared for {k_of_body} neighbours in each of {levels} levels");
            return Err(Error::Scene(format!("{found}, the configuration asks for {k} in each of {wanted}")));
        }
        let field = Field::new(Encoder::new(&config)?, &config, body.canonical_box);
        let motion = match config.motion.kind {
            MotionKind::Surface => MotionField::Surface(surface_motion(&config.motion)),
            MotionKind::Volume => {
                let weights = WeightVolume::gaussian(&body.model, &body.canonical, config.motion.resolution);
                MotionField::Volume { weights, threshold: VOLUME_THRESHOLD }
            }
        };
        let (near_canonical, log_weights) = match &motion {
            MotionField::Surface(_) => (Occupancy::default(), 0),
            MotionField::Volume { weights, .. } => (near_canonical(&body, &config), weights.delta.len()),
        };
        let vertices = body.canonical.vertices.len();
        Ok(Self {
            parameters: Parameters::new(&config, &field, vertices, log_weights),
            counts: VisibilityCounts::new(vertices),
            extent: Extent::whole(&body, &config),
            config,
            body,
            frames,
            field,
            motion,
            near_canonical,
            base,
            steps_done: 0,
        })
    }

    /// The configuration that it is trained with.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The shaped body.
    pub fn body(&self) -> &Arc<Body> {
        &self.body
    }

    /// The training frames' poses, as registration has corrected them, and cameras.
    pub fn frames(&self) -> &[Arc<PosedView>] {
        &self.frames
    }

    /// The light that its colours are seen under; even without [`FieldConfig::prior_light`].
    ///
    /// [`FieldConfig::prior_light`]: crate::FieldConfig::prior_light
    pub fn light(&self) -> Light {
        self.base.light
    }

    /// Steps taken so far.
    pub fn steps_done(&self) -> u64 {
        self.steps_done
    }

    /// Learnable numbers, padding not counted.
    pub fn num_parameters(&self) -> usize {
        PARTS[1..].iter().map(|&(part, _)| self.parameters.get(part).len()).sum::<usize>()
            + self.field.mlp.num_true_parameters()
    }

    /// Number of training rays that ended near each vertex; zeros without neighbour queries.
    pub fn visibility_counts(&self) -> &[u64] {
        self.counts.counts()
    }

    /// Resets to step 0, but for `steps_done`.
    pub(crate) fn forget(&mut self) {
        let motion = self.parameters.get(Part::Motion).len();
        let vertices = self.body.canonical.vertices.len();
        self.parameters = Parameters::new(&self.config, &self.field, vertices, motion);
        self.extent = Extent::whole(&self.body, &self.config);
        self.counts = VisibilityCounts::new(vertices);
    }

    /// Encodes the vertices of the surface term, if there is one, with the current parameters.
    pub(crate) fn encode_vertices(&self, code: &mut VertexCode) {
        if self.field.surface_term {
            let (table, offsets) = (self.parameters.get(Part::Table), self.parameters.get(Part::Vertices));
            code.encode(&self.body, &self.config.surface, &self.field.encoder, table, offsets);
        }
    }

    /// Takes the volume's log-weights from the parameters.
    pub(crate) fn refresh_volume(&mut self) {
        if let MotionField::Volume { weights, .. } = &mut self.motion {
            weights.delta.copy_from_slice(self.parameters.get(Part::Motion));
            weights.update();
        }
    }

    /// The weight volume, if that is the kind of motion.
    pub(crate) fn volume(&self) -> Option<&WeightVolume> {
        match &self.motion {
            MotionField::Volume { weights, .. } => Some(weights),
            MotionField::Surface(_) => None,
        }
    }

    /// Parameters for the field, with the rows of [`Model::encode_vertices`].
    pub(crate) fn learnt<'b>(&'b self, code: &'b VertexCode) -> Learnt<'b> {
        Learnt {
            perceptron: self.parameters.get(Part::Field),
            table: self.parameters.get(Part::Table),
            vertices: &code.rows,
            counts: &self.counts,
        }
    }

    /// Gives every sample of a batch its density and colour; see [`Field::forward`].
    pub(crate) fn evaluate(&self, code: &VertexCode, batch: &mut SampleBatch) {
        self.field.forward(&self.learnt(code), batch);
    }

    /// Measures the outer end of the field; the whole margin where the motion is a volume.
    pub(crate) fn measure_extent(&self, code: &VertexCode) -> Extent {
        match self.motion {
            MotionField::Volume { .. } => Extent::whole(&self.body, &self.config),
            MotionField::Surface(_) => Extent::measure(&self.body, &self.config, |batch| {
                self.evaluate(code, batch);
            }),
        }
    }
}

/// Cells near the canonical prior.
fn near_canonical(body: &Body, config: &Config) -> Occupancy {
    let (mut occupancy, whole) = (Occupancy::default(), Extent::whole(body, config));
    let size = OccupancyConfig { margin: whole.farthest, depth: config.motion.depth, cell: NEAR_CELL };
    occupancy.rebuild(&body.canonical.vertices, &body.model.faces, &whole.faces, size);
    occupancy
}

/// The surface motion, whose likelihood falls to 0 beyond the margin.
pub(crate) fn surface_motion(config: &MotionConfig) -> SurfaceMotion {
    SurfaceMotion { margin: config.margin, falloff: FALLOFF }
}

/// Tilt of a camera that is taken for level, radians: leaning persons are less upright.
const LEVEL: f32 = 0.17;

/// Upward direction of the world: its axis nearest to the mean direction from the feet to the head
/// in `views`; where the world's axes are those of every camera, as in a video without cameras,
/// that direction itself unless the camera is nearly level.
pub fn upright<'a>(body: &Body, views: impl Iterator<Item = &'a PosedView>) -> Vec3 {
    let joints = &body.canonical.joints;
    let highest = |sign: f32| {
        (0..joints.len()).max_by(|&a, &b| (sign * joints[a].y).total_cmp(&(sign * joints[b].y))).unwrap_or(0)
    };
    let (head, foot) = (highest(1.0), highest(-1.0));
    let feet: Vec<usize> =
        (0..joints.len()).filter(|&j| joints[j].y < 0.9 * joints[foot].y + 0.1 * joints[head].y).collect();
    let (mut sum, mut is_camera) = (Vec3::ZERO, true);
    for PosedView { camera, posed, .. } in views {
        let feet = feet.iter().map(|&j| posed.joints[j]).sum::<Vec3>() / feet.len().max(1) as f32;
        sum += (posed.joints[head] - feet).normalize_or_zero();
        is_camera &= camera.world_to_camera.matrix3.abs_diff_eq(Mat3A::IDENTITY, 1e-5);
    }
    // Leaning averages out; worlds of calibrated cameras have an upright axis.
    let axes = [Vec3::X, Vec3::Y, Vec3::Z].into_iter();
    let axis = axes.max_by(|a, b| sum.dot(*a).abs().total_cmp(&sum.dot(*b).abs())).unwrap_or(Vec3::Y);
    let axis = axis * sum.dot(axis).signum();
    if is_camera && sum.angle_between(axis) > LEVEL { sum.normalize_or(axis) } else { axis }
}

#[cfg(test)]
mod tests {
    use glam::{Affine3A, Mat3, Quat, Vec2};
    use smpl::{BodyModel, Placement};
    use volrender::Camera;

    use super::*;
    use crate::config::{Method, Preset};

    #[test]
    fn up_is_the_worlds_axis_or_in_the_cameras_world_the_bodys() {
        let model = BodyModel::embedded();
        let body = Body::new(&model, &[], &Config::preset(Preset::Fast, Method::Prior)).unwrap();
        // Of a camera whose y points down and that looks down on the person.
        let lean = Mat3::from_rotation_x(std::f32::consts::PI - 0.35);
        let view = |camera: Mat3| {
            let rotation = Quat::from_mat3(&(camera.transpose() * lean)).to_scaled_axis();
            let placement = Placement::Origin { rotation, translation: Vec3::new(0.0, 0.0, 3.0) };
            let posed = model.pose(&model.shaped(&[]), &vec![Vec3::ZERO; model.num_joints()], placement);
            let world_to_camera = Affine3A::from_mat3(camera);
            let (focal, centre) = (Vec2::splat(100.0), Vec2::splat(32.0));
            PosedView::new(&Camera { focal, centre, world_to_camera, width: 64, height: 64 }, posed)
        };
        let own = upright(&body, [view(Mat3::IDENTITY)].iter());
        assert!(own.angle_between(lean * Vec3::Y) < 0.05 && own.y < -0.9, "{own}");
        let turned = Mat3::from_rotation_y(0.3);
        assert_eq!(upright(&body, [view(Mat3::IDENTITY), view(turned)].iter()), Vec3::NEG_Y);
        assert!(upright(&body, [].iter()).is_normalized());
    }
}
