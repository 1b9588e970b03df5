//! The colours that a video shows of the prior.

use glam::Vec3;
use rayon::prelude::*;
use surface_query::vertex_normals;

use crate::Error;
use crate::capture::Light;
use crate::model::colors::VertexColors;
use crate::scene::light::{Seen, albedo, measure_light};
use crate::scene::pinhole::pinhole;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::scene::unseen::complete;

impl VertexColors {
    /// The colour that is closest to the visible training pixels that saw a vertex, by ray casting,
    /// under the light of the scene if the configuration asks for one; a vertex that none saw takes
    /// a mean of those that some saw, by their canonical distances, along the stripes if there are
    /// any.
    ///
    /// # Errors
    /// Pictures that cannot be read.
    pub fn measure(scene: &Scene) -> Result<Self, Error> {
        let frames: Result<Vec<Vec<Seen>>, Error> = scene.train.par_iter().map(|frame| seen(scene, frame)).collect();
        let frames = frames?;
        let vertices = &scene.body.canonical.vertices;
        let light = if scene.lit { measure_light(&frames, vertices.len()) } else { Light::default() };
        let sums = albedo(frames.iter().flatten(), vertices.len(), |normal| light.on(normal));
        let seen: Vec<bool> = sums.iter().map(|sum| sum.1 > 0.0).collect();
        let mut colors: Vec<Vec3> = sums.iter().map(|(sum, squares)| *sum / squares.max(f32::MIN_POSITIVE)).collect();
        complete(&scene.body, &mut colors, &seen);
        Ok(Self { colors, seen, light })
    }
}

/// What a frame shows of the vertices at pixels of the subject, by ray casting.
fn seen(scene: &Scene, frame: &PreparedFrame) -> Result<Vec<Seen>, Error> {
    let (camera, posed, faces) = (&frame.view.camera, &frame.view.posed.vertices, &scene.body.model.faces);
    let mesh = visibility::RayMesh::new(posed, faces)?;
    let pixels = frame.pixels()?;
    let usable: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
    let visible = visibility::visible_vertices(&mesh, posed, &pinhole(camera), Some(&usable));
    let normals = if scene.lit { vertex_normals(posed, faces) } else { vec![Vec3::ZERO; posed.len()] };
    let color = |v: usize| {
        let at = visible[v].then(|| camera.project(posed[v])).flatten()?;
        let pixel = at.y as usize * camera.width as usize + at.x as usize;
        let coverage = *pixels.mask.get(pixel)?;
        // Edge pixels are mixed with black in proportion to what the mask leaves free.
        let color = Vec3::from_slice(&pixels.image.pixels[3 * pixel..]) / coverage.max(0.5);
        Some((v as u32, color, normals[v].normalize_or_zero()))
    };
    Ok((0..posed.len()).filter_map(color).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Method, Preset};
    use crate::model::field::SampleBatch;
    use crate::model::trace::{CELL, PosedSurface};
    use crate::model::vertices::VertexCode;
    use crate::train::trainer::Trainer;
    use smpl::MotionFrame;
    use surface_query::MeshDistance;

    /// Face and colour of every sample of a view from another side.
    fn colours_of_samples(trainer: &Trainer<'_>) -> Vec<(u32, Vec3)> {
        let (view, model) = (&*trainer.scene.eval[0].view, trainer.model());
        let mut code = VertexCode::default();
        model.encode_vertices(&mut code);
        let posed = &view.posed;
        let mut surface = PosedSurface::new(&model.body, CELL).unwrap();
        surface.refit(&model.body, posed, &model.extent, &model.config, &model.base);
        let motion = MotionFrame::new(&model.body.model, posed);
        let tracer = model.tracer(&surface, &model.extent, &motion);
        let mut batch = SampleBatch::default();
        batch.samples.clear();
        for pixel in 0..48 * 48 {
            tracer.trace_all(&mut batch.samples, &view.pixel_ray(pixel));
        }
        model.evaluate(&code, &mut batch, None);
        assert!(batch.samples.len() > 500);
        let mesh = MeshDistance::new(&posed.vertices, &model.body.model.faces).unwrap();
        let face = |&x: &Vec3| mesh.closest(x, f32::INFINITY).unwrap().face;
        batch.samples.world.iter().map(face).zip(batch.rgb).collect()
    }

    #[test]
    fn colours_start_from_those_of_the_prior_and_stay_with_them_where_no_frame_saw_it() {
        let body = smpl::BodyModel::embedded();
        let demo = crate::capture::DemoConfig { size: 48, frames: 4, eval_cameras: 1, ..Default::default() };
        let capture = crate::capture::demo(&demo, &body).unwrap();
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        config.field.prior_light = false;
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let shown = VertexColors::measure(&scene).unwrap();
        assert!(shown.colors.iter().all(|c| (c.cmpge(Vec3::ZERO) & c.cmple(Vec3::ONE)).all()));
        let mut trainer = Trainer::new(&scene, config).unwrap();
        let between = |c: Vec3| c.clamp(Vec3::splat(0.02), Vec3::splat(0.98));
        // How far each colour lies outside of those at the corners of its face, and whether none of
        // them was seen.
        let strays = |trainer: &Trainer<'_>| -> Vec<(f32, bool)> {
            let stray = |(face, rgb): (u32, Vec3)| {
                let corners = scene.body.model.faces[face as usize];
                let colors = corners.map(|v| between(shown.colors[v as usize]));
                let (low, high) = (colors[0].min(colors[1]).min(colors[2]), colors[0].max(colors[1]).max(colors[2]));
                let outside = (low - rgb).max(rgb - high).max_element();
                (outside, corners.iter().all(|&v| !shown.seen[v as usize]))
            };
            colours_of_samples(trainer).into_iter().map(stray).collect()
        };
        // What the perceptron's first values add is small.
        assert!(strays(&trainer).iter().all(|stray| stray.0 <= 0.03));
        for _ in 0..20 {
            trainer.step().unwrap();
        }
        let (unseen, seen): (Vec<_>, Vec<_>) = strays(&trainer).into_iter().partition(|stray| stray.1);
        assert!(unseen.len() > 50 && unseen.iter().all(|stray| stray.0 <= 1e-6), "{}", unseen.len());
        assert!(seen.iter().any(|stray| stray.0 > 0.03));
    }
}
