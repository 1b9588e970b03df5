//! Where a bake meets a trained person: the field in the canonical space, and pictures of frames.

use glam::{Vec3, Vec4};
use rayon::prelude::*;
use smpl::SurfaceMotion;
use visibility::Samples;

use super::avatar::Avatar;
use super::draw::BakedPerson;
use super::field::{CanonicalField, Place};
use crate::Error;
use crate::capture::Image;
use crate::config::DistanceKind;
use crate::field::Group;
use crate::parameters::Part;
use crate::render::{Renderer, Rendering};
use crate::scene::PreparedFrame;
use crate::shell::Shell;
use crate::trainer::Trainer;
use crate::vertices::VertexCode;

/// A trained field, its vertices encoded.
pub(super) struct TrainedField<'a> {
    trainer: &'a Trainer<'a>,
    code: VertexCode,
    shell: Shell,
}

impl<'a> TrainedField<'a> {
    pub fn new(trainer: &'a Trainer<'a>) -> Self {
        let mut code = VertexCode::default();
        trainer.encode_vertices(&mut code);
        let shell = trainer.measure_shell(&code.rows);
        Self { trainer, code, shell }
    }
}

impl CanonicalField for TrainedField<'_> {
    fn evaluate(&self, places: &[Place], out: &mut Vec<(f32, Vec3)>) {
        let trainer = self.trainer;
        let (scene, config) = (trainer.scene, &trainer.config);
        let mut group = Group::default();
        group.samples.clear();
        let mut neighbours = vec![0; scene.query.neighbours_per_query()];
        for place in places {
            let (mut closest, mut distance) = (place.closest, place.distance);
            if config.surface.distance != DistanceKind::Exact {
                scene.query.neighbours(place.at, &mut neighbours);
                let finest = &neighbours[..config.surface.k];
                let blended = scene.query.blend(place.at, finest);
                (closest, distance) = (blended.point, blended.signed_distance);
                if config.surface.distance == DistanceKind::Mean {
                    distance = scene.query.mean_distance(place.at, finest).0;
                }
            }
            group.samples.push_canonical(scene, place.at, closest, distance, trainer.needs_neighbours());
            if !trainer.base.is_empty() {
                let corners = scene.model.faces[place.face as usize].iter().zip(place.barycentric);
                group.samples.base.push(corners.map(|(&v, b)| b * trainer.base[v as usize]).sum());
            }
        }
        let (field, table) = (trainer.parameters.get(Part::Field), trainer.parameters.get(Part::Table));
        trainer.field.forward(field, table, &self.code.rows, &trainer.counts, &mut group, None);
        let motion = SurfaceMotion { margin: config.motion.margin, falloff: config.motion.falloff };
        let value = |((place, sigma), rgb): ((&Place, &f32), &Vec3)| {
            let lives = place.distance <= self.shell.faces[place.face as usize];
            (if lives { motion.likelihood(place.distance) * sigma } else { 0.0 }, *rgb)
        };
        out.clear();
        out.extend(places.iter().zip(&group.sigma).zip(&group.rgb).map(value));
    }

    fn reach(&self) -> f32 {
        self.shell.farthest
    }
}

/// Draws the frames of a scene with the avatar that was baked of it.
pub struct BakedRenderer<'a> {
    trainer: &'a Trainer<'a>,
    person: BakedPerson<'a>,
    samples: Samples,
    pixels: Vec<Vec4>,
}

impl<'a> BakedRenderer<'a> {
    /// In the poses that `trainer` has found.
    #[must_use]
    pub fn new(trainer: &'a Trainer<'a>, avatar: &'a Avatar, samples: Samples) -> Self {
        let person = BakedPerson::new(avatar, trainer.scene.scale);
        Self { trainer, person, samples, pixels: Vec::new() }
    }
}

impl Renderer for BakedRenderer<'_> {
    fn render(&mut self, frame: &PreparedFrame, background: Vec3) -> Result<Rendering, Error> {
        let posed = self.trainer.corrected(frame);
        let (width, height) = (frame.camera.width, frame.camera.height);
        self.pixels.resize((width * height) as usize, Vec4::ZERO);
        self.person.draw(&posed.bones, &frame.camera, self.samples, &mut self.pixels)?;
        let over = |p: &Vec4| (p.truncate() + (1.0 - p.w) * background).to_array();
        let pixels: Vec<f32> = self.pixels.par_iter().flat_map_iter(over).collect();
        let opacity = self.pixels.iter().map(|p| p.w).collect();
        Ok(Rendering { image: Image { width, height, pixels }, opacity })
    }
}
