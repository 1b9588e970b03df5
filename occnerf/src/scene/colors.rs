//! The colours that a video shows of the prior.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::Error;
use crate::model::colors::VertexColors;
use crate::scene::prepared::{Scene, pinhole};

impl VertexColors {
    /// The mean colour of the visible training pixels that saw each vertex, by ray casting; a
    /// vertex that none saw takes the mean of those that some saw, weighted by their canonical
    /// distances to the power of −4 (Shepard 1968).
    pub fn measure(scene: &Scene) -> Result<Self, Error> {
        let per_frame: Result<Vec<Vec<(Vec3, u32)>>, Error> = scene
            .train
            .par_iter()
            .map(|frame| {
                let mesh = visibility::RayMesh::new(&frame.view.posed.vertices, &scene.body.model.faces)?;
                let pixels = frame.pixels()?;
                let usable: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
                let view = pinhole(&frame.view.camera);
                let seen = visibility::visible_vertices(&mesh, &frame.view.posed.vertices, &view, Some(&usable));
                let colour = |(vertex, seen): (&Vec3, bool)| {
                    let at = seen.then(|| frame.view.camera.project(*vertex)).flatten()?;
                    let pixel = at.y as usize * frame.view.camera.width as usize + at.x as usize;
                    let coverage = *pixels.mask.get(pixel)?;
                    // Edge pixels are mixed with black in proportion to what the mask leaves free.
                    Some(Vec3::from_slice(&pixels.image.pixels[3 * pixel..]) / coverage.max(0.5))
                };
                let colors = frame.view.posed.vertices.iter().zip(seen).map(colour);
                Ok(colors.map(|c| c.map_or((Vec3::ZERO, 0), |c| (c, 1))).collect())
            })
            .collect();
        let mut sums = vec![(Vec3::ZERO, 0u32); scene.body.canonical.vertices.len()];
        for frame in per_frame? {
            for (sum, (color, count)) in sums.iter_mut().zip(frame) {
                *sum = (sum.0 + color, sum.1 + count);
            }
        }
        let vertices = &scene.body.canonical.vertices;
        let known: Vec<usize> = (0..sums.len()).filter(|&v| sums[v].1 > 0).collect();
        let colors = (0..sums.len())
            .into_par_iter()
            .map(|v| {
                let (sum, count) = sums[v];
                if count > 0 {
                    return sum / count as f32;
                }
                let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
                for &k in &known {
                    // Vertices of a seam may coincide.
                    let squared = f64::from(vertices[k].distance_squared(vertices[v])).max(1e-12);
                    let weight = 1.0 / (squared * squared);
                    sum += weight * (sums[k].0 / sums[k].1 as f32).as_dvec3();
                    weights += weight;
                }
                if weights > 0.0 { (sum / weights).as_vec3() } else { Vec3::splat(0.5) }
            })
            .collect();
        Ok(Self { colors, seen: sums.iter().map(|sum| sum.1 > 0).collect() })
    }
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

    /// Face, barycentrics and colour of every sample of the first training frame.
    fn colours_of_samples(trainer: &Trainer<'_>) -> Vec<((u32, [f32; 3]), Vec3)> {
        let (view, model) = (&*trainer.scene.train[0].view, trainer.model());
        let mut code = VertexCode::default();
        model.encode_vertices(&mut code);
        let posed = model.corrected(view);
        let mut surface = PosedSurface::new(&model.body, CELL).unwrap();
        surface.refit(&model.body, &posed, &model.extent, &model.config);
        let motion = MotionFrame::new(&model.body.model, &posed);
        let tracer = model.tracer(&surface, &model.extent, &motion);
        let mut batch = SampleBatch::default();
        batch.samples.clear();
        for pixel in 0..48 * 48 {
            tracer.trace_all(&mut batch.samples, &view.pixel_ray(pixel));
        }
        model.evaluate(&code, &mut batch, None);
        assert!(batch.samples.len() > 500);
        batch.samples.faces.into_iter().zip(batch.rgb).collect()
    }

    #[test]
    fn colours_start_from_those_of_the_prior_and_stay_with_them_where_no_frame_saw_it() {
        let body = smpl::BodyModel::embedded();
        let demo = crate::capture::DemoConfig { size: 48, frames: 4, eval_cameras: 1, ..Default::default() };
        let capture = crate::capture::demo(&demo, &body).unwrap();
        let config = Config::preset(Preset::Fast, Method::Occnerf);
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let shown = VertexColors::measure(&scene).unwrap();
        assert!(shown.colors.iter().all(|c| (c.cmpge(Vec3::ZERO) & c.cmple(Vec3::ONE)).all()));
        let mut trainer = Trainer::new(&scene, config).unwrap();
        let between = |c: Vec3| c.clamp(Vec3::splat(0.02), Vec3::splat(0.98));
        // How far each colour lies outside of those at the corners of its face, and whether none of
        // them was seen.
        let strays = |trainer: &Trainer<'_>| -> Vec<(f32, bool)> {
            let stray = |((face, _), rgb): ((u32, [f32; 3]), Vec3)| {
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
