//! What a scene shows of its subject, and how finely.

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use visibility::RayMesh;

use crate::Error;
use crate::config::{Config, DistanceKind};
use crate::samples::{Samples, Stage, Tracer};
use crate::scene::{PreparedFrame, Scene};
use crate::trainer::pixel_ray;

/// Pixels of the subject that are looked at, at most: every n-th, all frames alike. A million keys take 8 MB.
const MAX_HITS: usize = 1 << 20;
/// Rays that are traced in full, at most, and the bins of each.
const MAX_RAYS: usize = 1 << 12;
const BINS: usize = 256;
/// Frames whose rays are traced in full, at most: the occupied cells of each are found anew.
const MAX_FRAMES: usize = 64;
/// Cells an axis beyond which points are not told apart: three such numbers fit one key.
const MAX_CELLS: f32 = (1 << 20) as f32;

/// What a scene shows of its subject; lengths in normalised metres (a body 1.7 m tall).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Width of a pixel at the depth of the body's middle, median over the training frames.
    pub metres_a_pixel: f32,
    /// Longest side of the box that is encoded.
    pub extent: f32,
    /// Pixels labelled subject, over all training frames.
    pub subject_pixels: u64,
    /// Distinct cells, as wide as a pixel, of the canonical surface in which a subject pixel's ray first meets the prior.
    pub cells: u64,
    /// Mean length of a subject pixel's ray within the box of the posed body.
    pub span: f32,
    /// Mean part of that length along which samples are alive.
    pub alive: f32,
}

impl Measured {
    /// Measures the training frames of `scene` for a model with the margins of `config`.
    ///
    /// # Errors
    /// [`Error::Scene`] where no frame has the body before its camera or no subject pixel's ray meets the posed prior or
    /// its margin; [`Error::Visibility`] and [`Error::Surface`] for a prior that cannot be cast at.
    pub fn of(scene: &Scene, config: &Config) -> Result<Self, Error> {
        let mut widths: Vec<f32> = scene.train.iter().filter_map(pixel_width).collect();
        widths.sort_by(f32::total_cmp);
        let none = |what: &str| Error::Scene(format!("{}: capacity: {what}", scene.name));
        let Some(&width) = widths.get(widths.len() / 2) else {
            return Err(none("no training frame has the body before its camera"));
        };
        let subject_pixels: usize = scene.train.iter().map(|f| f.subject.len()).sum();
        let extent = (scene.canonical_box.max - scene.canonical_box.min).max_element();
        let cell = width.max(extent / MAX_CELLS);
        let stride = subject_pixels.div_ceil(MAX_HITS).max(1);
        let keys: Result<Vec<Vec<u64>>, Error> =
            scene.train.par_iter().map(|frame| frame_cells(scene, frame, cell, stride)).collect();
        let mut keys = keys?.concat();
        keys.par_sort_unstable();
        keys.dedup();
        if keys.is_empty() {
            return Err(none("no ray of a subject pixel meets the posed prior"));
        }
        let (span, alive) = spans(scene, config)?;
        if !(span > 0.0 && alive > 0.0) {
            return Err(none("no ray of a subject pixel has a sample that is alive"));
        }
        Ok(Self {
            metres_a_pixel: width,
            extent,
            subject_pixels: subject_pixels as u64,
            cells: keys.len() as u64,
            span,
            alive,
        })
    }
}

/// Width of a pixel at the depth of the body's middle; `None` for a body that is not before the camera.
fn pixel_width(frame: &PreparedFrame) -> Option<f32> {
    let centre = frame.posed.vertices.iter().sum::<Vec3>() / frame.posed.vertices.len().max(1) as f32;
    let depth = frame.camera.world_to_camera.transform_point3(centre).z;
    let width = depth / frame.camera.focal.max_element();
    (width.is_finite() && width > 0.0).then_some(width)
}

/// The cells of the canonical surface that every `stride`-th subject pixel of a frame shows, each once.
fn frame_cells(scene: &Scene, frame: &PreparedFrame, cell: f32, stride: usize) -> Result<Vec<u64>, Error> {
    if frame.subject.is_empty() {
        return Ok(Vec::new());
    }
    let mesh = RayMesh::new(&frame.posed.vertices, &scene.model.faces)?;
    let hit = |&pixel: &u32| {
        let ray = pixel_ray(frame, pixel);
        let hit = mesh.first_hit(ray.origin, ray.direction)?;
        let corners = scene.model.faces[hit.face as usize].map(|v| scene.canonical.vertices[v as usize]);
        let point: Vec3 = corners.iter().zip(hit.barycentric).map(|(&v, b)| b * v).sum();
        let place = ((point - scene.canonical_box.min) / cell).max(Vec3::ZERO).as_uvec3();
        Some(u64::from(place.x) << 42 | u64::from(place.y) << 21 | u64::from(place.z))
    };
    let mut keys: Vec<u64> = frame.subject.iter().step_by(stride).filter_map(hit).collect();
    keys.sort_unstable();
    keys.dedup();
    Ok(keys)
}

/// Mean length of subject pixels' rays within the box of the posed body, and the part of it that is alive.
fn spans(scene: &Scene, config: &Config) -> Result<(f32, f32), Error> {
    let shown: Vec<&PreparedFrame> = scene.train.iter().filter(|f| !f.subject.is_empty()).collect();
    let frames: Vec<&PreparedFrame> = shown.iter().step_by(shown.len().div_ceil(MAX_FRAMES).max(1)).copied().collect();
    let stride = frames.iter().map(|f| f.subject.len()).sum::<usize>().div_ceil(MAX_RAYS).max(1);
    // The surface motion says of every prior what is alive, without the weight volume, which costs seconds.
    let mut config = Config { samples: BINS, ..config.clone() };
    config.surface.distance = DistanceKind::Exact;
    let (mut stage, mut samples) = (Stage::new(scene)?, Samples::default());
    samples.clear();
    let (mut length, mut alive, mut rays) = (0.0f64, 0.0f64, 0u64);
    for frame in frames {
        stage.set(scene, &frame.posed, &config);
        let (posed, to_canonical) = (&frame.posed, &frame.to_canonical[..]);
        let (stage, config) = (&stage, &config);
        let tracer =
            Tracer { scene, config, stage, posed, to_canonical, volume: None, neighbours: false, faces: false };
        for &pixel in frame.subject.iter().step_by(stride) {
            let ray = pixel_ray(frame, pixel);
            let span = stage.occupancy.region().and_then(|region| region.intersect(&ray));
            let Some((near, far)) = span.filter(|(near, far)| far > near) else { continue };
            samples.clear();
            samples.trace(&tracer, &ray, None);
            length += f64::from(far - near);
            alive += f64::from(far - near) * samples.len() as f64 / BINS as f64;
            rays += 1;
        }
    }
    Ok(((length / rays.max(1) as f64) as f32, (alive / length.max(f64::MIN_POSITIVE)) as f32))
}
