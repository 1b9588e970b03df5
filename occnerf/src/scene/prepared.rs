//! A capture made ready for training: normalised lengths, posed bodies, pixel labels and the canonical surface.

use std::sync::Arc;

use glam::{Affine3A, Vec3};
use rayon::prelude::*;
use smpl::{BodyModel, Posed, Shaped};
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
use visibility::{RayMesh, View};
use volrender::{Aabb, Camera};

use crate::Error;
use crate::capture::{Capture, Frame, PixelSource, Pixels};
use crate::config::Config;
use crate::scene::labels::{Label, Labels, label_pixels};

/// Canonical height that every capture is scaled to, so that constants in metres mean the same for all.
const NORMALISED_HEIGHT: f32 = 1.7;
/// Share of its size by which the canonical box is inflated on each side.
const BOX_INFLATION: f32 = 0.05;

/// A frame with its posed prior, lengths normalised.
pub struct PreparedFrame {
    /// As in the capture.
    pub name: String,
    /// As in the capture; evaluation cameras only.
    pub camera_name: String,
    /// With its translation in normalised metres.
    pub camera: Camera,
    /// Index of the training frame of the same instant, whose learnt pose correction holds for this one too; `None` for
    /// poses that no training frame has.
    pub instant: Option<usize>,
    /// The posed prior in normalised metres, as handed in.
    pub posed: Posed,
    /// Its body at rest, normalised; empty where `instant` is `None`.
    pub shape: Arc<Shaped>,
    /// Canonical ← world transform of each bone.
    pub to_canonical: Vec<Affine3A>,
    /// Picture and mask, as in the capture; `None` where nothing was photographed.
    pub source: Option<PixelSource>,
    /// H × W; only training frames are labelled.
    pub labels: Labels,
}

impl PreparedFrame {
    /// A frame that only says pose and camera: the same moment from another camera.
    #[must_use]
    pub fn seen_by(&self, camera: &Camera) -> Self {
        let (posed, to_canonical, shape) = (self.posed.clone(), self.to_canonical.clone(), self.shape.clone());
        Self { instant: self.instant, shape, to_canonical, ..Self::bare(camera, posed) }
    }

    /// A pose and a camera.
    pub(crate) fn bare(camera: &Camera, posed: Posed) -> Self {
        Self {
            name: String::new(),
            camera_name: String::new(),
            camera: *camera,
            instant: None,
            to_canonical: posed.to_canonical(),
            shape: Arc::new(Shaped { vertices: Vec::new(), joints: Vec::new() }),
            posed,
            source: None,
            labels: Labels::default(),
        }
    }

    /// What was photographed.
    ///
    /// # Errors
    /// [`Error::Data`] for files that cannot be read; [`Error::Scene`] where nothing was photographed.
    pub fn pixels(&self) -> Result<Arc<Pixels>, Error> {
        let source = self.source.as_ref().ok_or_else(|| Error::Scene("a view without a picture".to_owned()))?;
        Ok(source.pixels()?)
    }
}

/// Everything that training and rendering read and never change.
pub struct Scene {
    /// Of the capture.
    pub name: String,
    /// The prior as handed in (lengths not normalised).
    pub model: BodyModel,
    /// Normalised metres in one unit of the capture.
    pub scale: f32,
    /// Shape of the canonical body.
    pub mean_betas: Vec<f32>,
    /// Canonical (T-pose, mean betas) vertices, normalised.
    pub canonical: smpl::Shaped,
    /// The canonical box that encodings are relative to, inflated by 5 %.
    pub canonical_box: Aabb,
    /// Nearest vertices of the canonical mesh.
    pub query: SurfaceQuery,
    /// Exact distances to the canonical mesh.
    pub surface: MeshDistance,
    /// Training frames.
    pub train: Vec<PreparedFrame>,
    /// Evaluation frames, never seen in training.
    pub eval: Vec<PreparedFrame>,
}

impl Scene {
    /// Prepares a capture with its prior.
    pub fn new(capture: &Capture, model: &BodyModel, config: &Config) -> Result<Self, Error> {
        config.validate()?;
        if let Some(lost) = capture.eval.iter().find(|e| e.train_index >= capture.train.len()) {
            let (name, at, frames) = (&lost.frame.name, lost.train_index, capture.train.len());
            return Err(Error::Scene(format!("view {name} is of training frame {at}, expected one of {frames}")));
        }
        let mut canonical = model.shaped(&capture.mean_betas);
        let (low, high) = bounds(&canonical.vertices);
        let height = high.y - low.y;
        if !(height.is_finite() && height > 0.0) {
            return Err(Error::Scene(format!("canonical body is {height} high: expected a finite height above 0")));
        }
        let scale = NORMALISED_HEIGHT / height;
        canonical.vertices.iter_mut().chain(&mut canonical.joints).for_each(|v| *v *= scale);
        let (low, high) = (low * scale, high * scale);
        let inflation = BOX_INFLATION * (high - low);
        let reach = config.motion.margin + config.motion.falloff;
        let query = SurfaceQuery::new(
            &canonical.vertices,
            &model.faces,
            &SurfaceQueryConfig {
                k: config.surface.k,
                coarse_levels: config.surface.coarse_levels,
                cell: 0.02,
                margin: reach + 0.03,
                ratio: 0.25,
            },
        )?;
        let mut scene = Self {
            name: capture.name.clone(),
            mean_betas: capture.mean_betas.clone(),
            model: model.clone(),
            scale,
            canonical_box: Aabb { min: low - inflation, max: high + inflation },
            surface: MeshDistance::new(&canonical.vertices, &model.faces)?,
            canonical,
            query,
            train: Vec::new(),
            eval: Vec::new(),
        };
        let train: Result<Vec<_>, Error> =
            capture.train.par_iter().enumerate().map(|(i, f)| scene.prepare(f, Some(i), Some(config))).collect();
        let eval: Result<Vec<_>, Error> = capture
            .eval
            .par_iter()
            .map(|e| {
                Ok(PreparedFrame {
                    camera_name: e.camera_name.clone(),
                    ..scene.prepare(&e.frame, Some(e.train_index), None)?
                })
            })
            .collect();
        (scene.train, scene.eval) = (train?, eval?);
        if scene.train.iter().all(|f| f.labels.num_subject() == 0) {
            return Err(Error::Scene(format!("{}: no training mask shows the subject", scene.name)));
        }
        Ok(scene)
    }

    /// Poses the prior for `frame`, and labels its pixels if it is for training with `config`.
    fn prepare(&self, frame: &Frame, instant: Option<usize>, config: Option<&Config>) -> Result<PreparedFrame, Error> {
        let (shape, posed) = self.shape_and_pose(&frame.betas, &frame.pose, frame.placement);
        let camera = normalised_camera(&frame.camera, self.scale);
        let mut prepared = PreparedFrame {
            name: frame.name.clone(),
            camera_name: String::new(),
            to_canonical: posed.bones.iter().map(Affine3A::inverse).collect(),
            camera,
            instant,
            posed,
            shape: Arc::new(shape),
            source: Some(frame.source.clone()),
            labels: Labels::default(),
        };
        if let Some(config) = config {
            let silhouette = self.silhouette(&prepared)?;
            let centre = prepared.posed.vertices.iter().sum::<Vec3>() / prepared.posed.vertices.len() as f32;
            let depth = prepared.camera.world_to_camera.transform_point3(centre).z.max(1e-3);
            let pixels = frame.pixels()?;
            prepared.labels = Labels::new(&label_pixels(
                config.occluded,
                &pixels.mask,
                &silhouette,
                pixels.occluder.as_deref(),
                prepared.camera.width as usize,
                prepared.camera.focal.x / depth,
            ));
        }
        Ok(prepared)
    }

    /// The prior in a pose, normalised.
    pub fn pose(&self, betas: &[f32], pose: &[Vec3], placement: smpl::Placement) -> Posed {
        self.shape_and_pose(betas, pose, placement).1
    }

    fn shape_and_pose(&self, betas: &[f32], pose: &[Vec3], placement: smpl::Placement) -> (Shaped, Posed) {
        let mut shape = self.model.shaped(betas);
        let mut posed = self.model.pose(&shape, pose, placement);
        shape.vertices.iter_mut().chain(&mut shape.joints).for_each(|v| *v *= self.scale);
        let lengths = posed.vertices.iter_mut().chain(&mut posed.joints).chain(&mut posed.pose_offsets);
        lengths.for_each(|v| *v *= self.scale);
        posed.bones.iter_mut().for_each(|b| b.translation *= self.scale);
        (shape, posed)
    }

    /// Pixels (H × W) whose ray hits the posed prior.
    fn silhouette(&self, frame: &PreparedFrame) -> Result<Vec<bool>, Error> {
        let mesh = RayMesh::new(&frame.posed.vertices, &self.model.faces)?;
        let region = bounds(&frame.posed.vertices);
        let region = Aabb { min: region.0, max: region.1 };
        let width = frame.camera.width as usize;
        Ok((0..width * frame.camera.height as usize)
            .map(|i| {
                let ray = frame.camera.ray((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
                region.intersect(&ray).is_some() && mesh.first_hit(ray.origin, ray.direction).is_some()
            })
            .collect())
    }

    /// The world's upward direction: the mean direction from the pelvis to the head over the training frames.
    pub fn up(&self) -> Vec3 {
        let upward = |f: &PreparedFrame| {
            let (low, high) = head_and_root(&self.canonical.joints);
            (f.posed.joints[high] - f.posed.joints[low]).normalize_or_zero()
        };
        let sum: Vec3 = self.train.iter().map(upward).sum();
        // Leaning averages out in the plane; the world's axes are upright in every known layout.
        let axis =
            [Vec3::X, Vec3::Y, Vec3::Z].into_iter().max_by(|a, b| sum.dot(*a).abs().total_cmp(&sum.dot(*b).abs()));
        axis.map_or(Vec3::Y, |a| a * sum.dot(a).signum())
    }

    /// How many training frames show each vertex of the prior to the camera at a pixel of the subject, by ray casting.
    pub fn vertex_frequencies(&self) -> Result<Vec<u64>, Error> {
        let seen: Result<Vec<Vec<bool>>, Error> = self
            .train
            .par_iter()
            .map(|frame| {
                let mesh = RayMesh::new(&frame.posed.vertices, &self.model.faces)?;
                let usable: Vec<bool> = frame.labels.iter().map(|label| label == Label::Subject).collect();
                Ok(visibility::visible_vertices(&mesh, &frame.posed.vertices, &view(&frame.camera), Some(&usable)))
            })
            .collect();
        let mut counts = vec![0; self.canonical.vertices.len()];
        for frame in seen? {
            counts.iter_mut().zip(frame).for_each(|(count, seen)| *count += u64::from(seen));
        }
        Ok(counts)
    }
}

/// The pinhole view that the visibility crate asks for.
pub(crate) fn view(camera: &Camera) -> View {
    View {
        intrinsics: camera.intrinsics(),
        extrinsics: camera.world_to_camera,
        width: camera.width,
        height: camera.height,
    }
}

/// A camera with its lengths multiplied by `scale`.
pub(crate) fn normalised_camera(camera: &Camera, scale: f32) -> Camera {
    let mut camera = *camera;
    camera.world_to_camera.translation *= scale;
    camera
}

/// The root joint and the joint that is highest above it in the canonical pose.
fn head_and_root(joints: &[Vec3]) -> (usize, usize) {
    let highest = (0..joints.len()).max_by(|&a, &b| joints[a].y.total_cmp(&joints[b].y));
    (0, highest.unwrap_or(0))
}

pub(crate) fn bounds(points: &[Vec3]) -> (Vec3, Vec3) {
    points.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &p| (low.min(p), high.max(p)))
}
