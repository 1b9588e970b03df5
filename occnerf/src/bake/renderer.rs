//! Canonical field and renderer of a trained model for baking.

use glam::{Vec3, Vec4};
use rayon::prelude::*;
use smpl::MotionField;
use visibility::Samples;

use super::avatar::Avatar;
use super::draw::BakedPerson;
use super::field::{CanonicalField, Place};
use crate::Error;
use crate::capture::{Image, Light};
use crate::model::body::Body;
use crate::model::distance::surface_point;
use crate::model::extent::Extent;
use crate::model::field::SampleBatch;
use crate::model::trained::{Model, surface_motion};
use crate::model::vertices::VertexCode;
use crate::model::view::PosedView;
use crate::render::picture::{Renderer, Rendering};

/// [`CanonicalField::grazing`]; 2 to 6 cm draw outlines that fit those of pictures (IoU .956 to .960
/// on the demo, whatever the number of samples), 3 to 4 best.
const GRAZING: f32 = 0.035;

/// A trained field with encoded vertices.
pub(super) struct TrainedField<'a> {
    model: &'a Model,
    code: VertexCode,
    extent: Extent,
}

impl<'a> TrainedField<'a> {
    pub fn new(model: &'a Model) -> Self {
        let mut code = VertexCode::default();
        model.encode_vertices(&mut code);
        let extent = model.measure_extent(&code);
        Self { model, code, extent }
    }
}

impl CanonicalField for TrainedField<'_> {
    fn evaluate(&self, places: &[Place], out: &mut Vec<(f32, Vec3)>) {
        let Model { body, config, base, motion, .. } = self.model;
        let blended = config.surface.distance.needs_neighbours();
        let neighbours = config.needs_neighbours();
        let based = !base.colors.is_empty() && matches!(motion, MotionField::Surface(_));
        let mut batch = SampleBatch::default();
        batch.samples.clear();
        for place in places {
            let samples = &mut batch.samples;
            samples.push_canonical(body, place.at, place.closest, place.distance, neighbours);
            if blended {
                let own = &samples.neighbours[samples.neighbours.len() - body.query.neighbours_per_query()..];
                if let Some(point) = surface_point(body, &config.surface, place.at, own, f32::INFINITY)
                    && let (Some(closest), Some(distance)) = (samples.closest.last_mut(), samples.distance.last_mut())
                {
                    (*closest, *distance) = (point.closest, point.distance);
                }
            }
            if based {
                samples.base.push(base.logit(place.face, place.barycentric, 1.0));
            }
        }
        self.model.evaluate(&self.code, &mut batch, None);
        let likelihood = surface_motion(&config.motion);
        let value = |((place, sigma), rgb): ((&Place, &f32), &Vec3)| {
            let lives = place.distance <= self.extent.faces[place.face as usize];
            (if lives { likelihood.likelihood(place.distance) * sigma } else { 0.0 }, *rgb)
        };
        out.clear();
        out.extend(places.iter().zip(&batch.sigma).zip(&batch.rgb).map(value));
    }

    fn grazing(&self) -> f32 {
        GRAZING
    }

    fn reach(&self) -> f32 {
        self.extent.farthest
    }
}

/// Renders views with an avatar.
pub struct BakedRenderer<'a> {
    person: BakedPerson<'a>,
    samples: Samples,
    pixels: Vec<Vec4>,
}

impl<'a> BakedRenderer<'a> {
    /// Renderer for the avatar of `body` under `light`.
    ///
    /// # Errors
    /// [`Error::Scene`] for the avatar of another skeleton.
    pub fn new(body: &Body, light: Light, avatar: &'a Avatar, samples: Samples) -> Result<Self, Error> {
        let (found, expected) = (avatar.num_joints(), body.model.num_joints());
        if found != expected {
            return Err(Error::Scene(format!("the avatar has {found} joints, the body {expected}")));
        }
        let person = BakedPerson::new(avatar, body.scale).lit_by(light);
        Ok(Self { person, samples, pixels: Vec::new() })
    }
}

impl Renderer for BakedRenderer<'_> {
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error> {
        let (width, height) = (view.camera.width, view.camera.height);
        self.pixels.resize(width as usize * height as usize, Vec4::ZERO);
        self.person.draw(&view.posed.bones, &view.camera, self.samples, &mut self.pixels)?;
        let over = |p: &Vec4| (p.truncate() + (1.0 - p.w) * background).to_array();
        let pixels: Vec<f32> = self.pixels.par_iter().flat_map_iter(over).collect();
        let opacity = self.pixels.iter().map(|p| p.w).collect();
        Ok(Rendering { image: Image { width, height, pixels }, opacity })
    }
}
