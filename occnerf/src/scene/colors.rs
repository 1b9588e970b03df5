//! Albedo of the prior from the training frames.

use std::sync::Arc;

use glam::Vec3;
use rayon::prelude::*;

use crate::Error;
use crate::model::colors::PriorColors;
use crate::model::subdivide::{Subdivided, most_times, times_until};
use crate::model::view::pixel_width;
use crate::scene::hands::is_arm;
use crate::scene::light::ColorObservation;
use crate::scene::prepared::Scene;
use crate::scene::unseen::complete;

/// Target edge length of the subdivided prior, pixels of the training frames, and most subdivisions.
const EDGE: f32 = 0.5;
const MOST: u32 = 2;
/// Least foreshortening weight of an observation.
const SLANT: f32 = 0.05;
/// Least sum of the reliabilities of an observed point where frames disagree, frames.
const EVIDENCE: f32 = 4.0;
/// Frames in flight, at some megabytes of observations each.
const TOGETHER: usize = 8;

impl PriorColors {
    /// Least-squares albedo over the visible training pixels of each point of the subdivided prior,
    /// or of its clothes if registered, weighted by foreshortening and reliability, under the light
    /// of the scene if the configuration asks for one. Contaminated edge pixels of masks are left out.
    /// Vertices that are not observed reliably are completed by inverse distance weighting, other such
    /// points interpolated from their vertices.
    ///
    /// # Errors
    /// Pictures that cannot be read.
    pub fn measure(scene: &Scene) -> Result<Self, Error> {
        let (prior, faces) = (&scene.body.canonical.vertices, &scene.body.model.faces);
        let &(light, ref reliability, ref hands) = scene.lighting()?;
        let pixel = pixel_width(scene.train.iter().map(|frame| &*frame.view));
        let most = MOST.min(most_times(faces.len()));
        let times = pixel.map_or(0, |pixel| times_until(prior, faces, EDGE * pixel, most));
        let mesh = Subdivided::new(prior.len(), faces, times);
        // Terms of Σ s c and Σ s² for colours c under the light s, and reliabilities.
        let shown = |frame: usize| -> Result<Vec<(usize, Vec3, f32, f32)>, Error> {
            let seen = scene.seen_in(frame, &mesh.anchors)?;
            let view = &scene.train[frame].view;
            let eye = view.camera.centre_of_projection();
            let term = |&((v, color, normal), depth): &(ColorObservation, usize)| {
                let place = mesh.anchors[v as usize].mix(&view.posed.vertices);
                let cosine = normal.dot((eye - place).normalize_or_zero());
                let trust = reliability.at(depth as f32, cosine);
                let (size, shade) = (trust * cosine.max(SLANT), light.on(normal));
                (v as usize, size * shade * color, size * shade * shade, trust)
            };
            let hands = hands.as_ref().map(|color| color.in_frame(&scene.body.model, view));
            let is_hand_beside = |v: u32, color: Vec3| {
                let (Some(hands), anchor) = (&hands, &mesh.anchors[v as usize]) else { return false };
                let at = view.camera.project(anchor.mix(&view.posed.vertices));
                let pixel = at.map(|at| at.y as usize * view.camera.width as usize + at.x as usize);
                pixel.is_some_and(|pixel| hands.may_show(pixel, color))
                    && !is_arm(scene.body.model.weights.row(anchor.corners[0] as usize))
            };
            let is_allowed =
                |&&((v, color, _), depth): &&(ColorObservation, usize)| depth > scene.edge && !is_hand_beside(v, color);
            Ok(seen.iter().filter(is_allowed).map(term).collect())
        };
        let mut sums = vec![(Vec3::ZERO, 0.0, 0.0); mesh.anchors.len()];
        for first in (0..scene.train.len()).step_by(TOGETHER) {
            let frames = first..(first + TOGETHER).min(scene.train.len());
            let found: Result<Vec<_>, Error> = frames.into_par_iter().map(shown).collect();
            for (v, sum, squares, trust) in found?.into_iter().flatten() {
                sums[v] = (sums[v].0 + sum, sums[v].1 + squares, sums[v].2 + trust);
            }
        }
        let least = reliability.disagreement * EVIDENCE;
        let seen: Vec<bool> = sums.iter().map(|sum| sum.1 > 0.0 && sum.2 >= least).collect();
        let mut colors: Vec<Vec3> =
            sums.iter().map(|(sum, squares, _)| *sum / squares.max(f32::MIN_POSITIVE)).collect();
        let (vertices, between) = colors.split_at_mut(prior.len());
        complete(&scene.body, vertices, &seen[..prior.len()]);
        let rest = between.iter_mut().zip(&mesh.anchors[prior.len()..]).zip(&seen[prior.len()..]);
        rest.filter(|(_, seen)| !**seen).for_each(|((color, anchor), _)| *color = anchor.mix(vertices));
        Ok(Self { colors, seen, light, mesh: Arc::new(mesh) })
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::config::{Config, Method, Preset};
    use crate::scene::prepared::PreparedFrame;
    use synth::{DemoConfig, demo};
    use volrender::RandomStream;

    /// Where the segment from `from` to `to` crosses a triangle, as a part of its length.
    fn crossing(from: DVec3, to: DVec3, [a, b, c]: [DVec3; 3]) -> Option<f64> {
        let way = to - from;
        // Volumes of the tetrahedra that the segment's line makes with the edges.
        let volume = |p: DVec3, q: DVec3| (p - from).cross(q - from).dot(way);
        let sides = [volume(a, b), volume(b, c), volume(c, a)];
        let same = sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0);
        let normal = (b - a).cross(c - a);
        same.then(|| (a - from).dot(normal) / way.dot(normal)).filter(|t| t.is_finite())
    }

    #[test]
    fn colours_are_the_means_of_what_frames_show_of_places_between_the_vertices() {
        let body = smpl::BodyModel::embedded();
        let demo_config = DemoConfig { size: 96, frames: 6, eval_cameras: 0, ..DemoConfig::default() };
        let mut config = Config::preset(Preset::Fast, Method::Prior);
        (config.registration.rounds, config.field.prior_light) = (0, false);
        let mut scene = Scene::new(&demo(&demo_config, &body).unwrap(), &body, &config).unwrap();
        assert!(scene.clothes.is_empty());
        compare(&scene, &vec![0.0; body.num_vertices()]);
        // Clothes stand off up to 3 cm, and some of what the body shows is hidden behind them.
        let mut random = RandomStream::new(&[9]);
        scene.clothes = (0..body.num_vertices()).map(|_| 0.03 * random.uniform()).collect();
        compare(&scene, &scene.clothes);
    }

    /// Compares the colours of some places with those that a loop over all pictures and faces finds.
    fn compare(scene: &Scene, clothes: &[f32]) {
        let found = PriorColors::measure(scene).unwrap();
        assert!(found.mesh.times() > 0 && found.colors.len() == found.mesh.anchors.len());
        let mut random = RandomStream::new(&[8]);
        let dressed = |frame: &PreparedFrame| -> (Vec<Vec3>, Vec<Vec3>) {
            let normals = surface_query::vertex_normals(&frame.view.posed.vertices, &scene.body.model.faces);
            let moved = |v: usize| frame.view.posed.vertices[v] + clothes[v] * normals[v].normalize_or_zero();
            ((0..normals.len()).map(moved).collect(), normals)
        };
        let frames: Vec<_> = scene.train.iter().map(|frame| (frame, dressed(frame))).collect();
        let (mut wrong, mut shown, mut hidden) = (0, 0, 0);
        for _ in 0..150 {
            let v = random.below(found.colors.len());
            let anchor = &found.mesh.anchors[v];
            let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
            for (frame, (vertices, normals)) in &frames {
                let (view, pixels) = (&frame.view, frame.pixels().unwrap());
                let place = anchor.mix(vertices);
                let Some(at) = view.camera.project(place) else { continue };
                let pixel = at.y as usize * view.camera.width as usize + at.x as usize;
                let coverage = pixels.mask.get(pixel).copied().unwrap_or(0.0);
                let eye = view.camera.centre_of_projection();
                let corner = |&v: &u32| vertices[v as usize].as_dvec3();
                let before = |face: &[u32; 3]| {
                    let crossing = crossing(eye.as_dvec3(), place.as_dvec3(), face.each_ref().map(corner));
                    crossing.is_some_and(|t| t > 0.0 && t < 1.0 - 1e-4)
                };
                if coverage <= 0.5 || scene.body.model.faces.iter().any(before) {
                    continue;
                }
                let towards = (eye - anchor.mix(&view.posed.vertices)).normalize_or_zero();
                let slant = anchor.mix(normals).normalize_or_zero().dot(towards).max(SLANT);
                let color = Vec3::from_slice(&pixels.image.pixels[3 * pixel..]) / coverage;
                (sum, weights) = (sum + f64::from(slant) * color.as_dvec3(), weights + f64::from(slant));
            }
            if weights > 0.0 {
                shown += 1;
                let error = (sum / weights - found.colors[v].as_dvec3()).length();
                wrong += usize::from(!found.seen[v] || error > 1e-3);
            } else {
                hidden += 1;
                wrong += usize::from(found.seen[v]);
            }
        }
        // Places that a face all but grazes, or whose pixel is the next, are told differently by f32.
        assert!(shown > 50 && hidden > 5 && wrong <= 3, "{wrong} wrong of {shown} and {hidden}");
    }
}
