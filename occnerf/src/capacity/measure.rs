//! What a scene shows of its subject, and how finely.

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use visibility::RayMesh;
use volrender::Aabb;

use crate::Error;
use crate::config::Config;
use crate::model::view::pixel_width;
use crate::scene::prepared::{PreparedFrame, Scene};

/// Pixels of the subject that are looked at, at most: every n-th, all frames alike. A million keys
/// take 8 MB.
const MAX_PIXELS: usize = 1 << 20;
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
    /// Distinct cells, as wide as a pixel, of the canonical surface in which a subject pixel's ray
    /// first meets the prior.
    pub cells: u64,
    /// Mean length of a subject pixel's ray within the box of the posed body, along which samples
    /// are spread.
    pub span: f32,
}

impl Measured {
    /// Measures the training frames of `scene` for a model with the margins of `config`.
    ///
    /// # Errors
    /// [`Error::Scene`] where no frame has the body before its camera or no subject pixel's ray
    /// meets the posed prior; [`Error::Visibility`] for a prior that cannot be cast at.
    pub fn of(scene: &Scene, config: &Config) -> Result<Self, Error> {
        let none = |what: &str| Error::Scene(format!("{}: capacity: {what}", scene.name));
        let Some(width) = pixel_width(scene.train.iter().map(|frame| &*frame.view)) else {
            return Err(none("no training frame has the body before its camera"));
        };
        let subject_pixels: usize = scene.train.iter().map(|f| f.labels.num_subject()).sum();
        let extent = (scene.body.canonical_box.max - scene.body.canonical_box.min).max_element();
        let cell = width.max(extent / MAX_CELLS);
        let stride = subject_pixels.div_ceil(MAX_PIXELS).max(1);
        let reach = config.motion.reach();
        let seen: Result<Vec<Seen>, Error> =
            scene.train.par_iter().map(|frame| Seen::of(scene, frame, cell, stride, reach)).collect();
        let (mut keys, mut span, mut rays) = (Vec::new(), 0.0, 0);
        for seen in seen? {
            keys.extend(seen.cells);
            span += seen.span;
            rays += seen.rays;
        }
        keys.par_sort_unstable();
        keys.dedup();
        if keys.is_empty() {
            return Err(none("no ray of a subject pixel meets the posed prior"));
        }
        Ok(Self {
            metres_a_pixel: width,
            extent,
            subject_pixels: subject_pixels as u64,
            cells: keys.len() as u64,
            span: (span / f64::from(rays.max(1))) as f32,
        })
    }
}

/// What every n-th subject pixel of a frame shows.
#[derive(Default)]
struct Seen {
    /// Cells of the canonical surface, each once.
    cells: Vec<u64>,
    /// Sum of the rays' lengths within the box of the posed body, and how many there are.
    span: f64,
    rays: u32,
}

impl Seen {
    fn of(scene: &Scene, frame: &PreparedFrame, cell: f32, stride: usize, reach: f32) -> Result<Self, Error> {
        let mut seen = Self::default();
        if frame.labels.num_subject() == 0 {
            return Ok(seen);
        }
        let mesh = RayMesh::new(&frame.view.posed.vertices, &scene.body.model.faces)?;
        let Aabb { min: low, max: high } = Aabb::from_points(&frame.view.posed.vertices);
        let region = Aabb { min: low - reach, max: high + reach };
        for n in (0..frame.labels.num_subject()).step_by(stride) {
            let ray = frame.view.pixel_ray(frame.labels.subject(n));
            if let Some((near, far)) = region.intersect(&ray).filter(|(near, far)| far > near) {
                seen.span += f64::from(far - near);
                seen.rays += 1;
            }
            let Some(hit) = mesh.first_hit(ray.origin, ray.direction) else { continue };
            let corners = scene.body.model.faces[hit.face as usize].map(|v| scene.body.canonical.vertices[v as usize]);
            let point: Vec3 = corners.iter().zip(hit.barycentric).map(|(&v, b)| b * v).sum();
            let place = ((point - scene.body.canonical_box.min) / cell).max(Vec3::ZERO).as_uvec3();
            seen.cells.push(u64::from(place.x) << 42 | u64::from(place.y) << 21 | u64::from(place.z));
        }
        seen.cells.sort_unstable();
        seen.cells.dedup();
        Ok(seen)
    }
}
