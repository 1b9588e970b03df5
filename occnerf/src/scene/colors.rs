//! The baseline without a field: the posed prior mesh in the mean colours that the video showed of it.

use glam::{DVec3, Vec3, Vec4};
use rayon::prelude::*;

use crate::Error;
use crate::scene::prepared::{Scene, view};

/// A colour for each vertex of the prior.
#[derive(Clone, Debug, PartialEq)]
pub struct VertexColors {
    /// sRGB in [0, 1], V.
    pub colors: Vec<Vec3>,
    /// Whether some training frame saw the vertex, V: its colour is inferred where none did.
    pub seen: Vec<bool>,
}

impl VertexColors {
    /// The mean colour of the visible training pixels that saw each vertex, by ray casting; a vertex that none saw takes
    /// the mean of those that some saw, weighted by their canonical distances to the power of −4 (Shepard 1968).
    pub fn measure(scene: &Scene) -> Result<Self, Error> {
        let per_frame: Result<Vec<Vec<(Vec3, u32)>>, Error> = scene
            .train
            .par_iter()
            .map(|frame| {
                let mesh = visibility::RayMesh::new(&frame.posed.vertices, &scene.model.faces)?;
                let pixels = frame.pixels()?;
                let usable: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
                let view = view(&frame.camera);
                let seen = visibility::visible_vertices(&mesh, &frame.posed.vertices, &view, Some(&usable));
                let colour = |(vertex, seen): (&Vec3, bool)| {
                    let at = seen.then(|| frame.camera.project(*vertex)).flatten()?;
                    let pixel = at.y as usize * frame.camera.width as usize + at.x as usize;
                    let coverage = *pixels.mask.get(pixel)?;
                    // Edge pixels are mixed with black in proportion to what the mask leaves free.
                    Some(Vec3::from_slice(&pixels.image.pixels[3 * pixel..]) / coverage.max(0.5))
                };
                let colors = frame.posed.vertices.iter().zip(seen).map(colour);
                Ok(colors.map(|c| c.map_or((Vec3::ZERO, 0), |c| (c, 1))).collect())
            })
            .collect();
        let mut sums = vec![(Vec3::ZERO, 0u32); scene.canonical.vertices.len()];
        for frame in per_frame? {
            for (sum, (color, count)) in sums.iter_mut().zip(frame) {
                *sum = (sum.0 + color, sum.1 + count);
            }
        }
        let vertices = &scene.canonical.vertices;
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

    /// What a sigmoid makes the colours of, black and white taken for nearly so, and as w how much of what a perceptron
    /// says is to be added: nothing where no frame saw the vertex, for there nothing has taught it.
    pub(crate) fn before_sigmoid(&self) -> Vec<Vec4> {
        /// 5 levels of 255.
        const LEAST: f32 = 0.02;
        let inverse = |x: f32| (x / (1.0 - x)).ln();
        let each = self.colors.iter().zip(&self.seen);
        let between = |c: &Vec3| c.clamp(Vec3::splat(LEAST), Vec3::splat(1.0 - LEAST));
        each.map(|(c, &seen)| between(c).map(inverse).extend(f32::from(u8::from(seen)))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Method, Preset};
    use crate::model::vertices::VertexCode;
    use crate::train::trainer::Trainer;

    /// Face, barycentrics and colour of every sample of the first training frame.
    fn colours_of_samples(trainer: &mut Trainer<'_>) -> Vec<((u32, [f32; 3]), Vec3)> {
        let scene = trainer.scene;
        let mut code = VertexCode::default();
        trainer.encode_vertices(&mut code);
        let frame = &scene.train[0];
        let posed = trainer.corrected(frame);
        let mut stage = std::mem::replace(
            &mut trainer.stage,
            crate::model::samples::Stage::new(scene, crate::model::samples::CELL).unwrap(),
        );
        stage.set(scene, &posed, &trainer.shell, &trainer.config);
        let mut group = crate::model::field::Group::default();
        group.samples.clear();
        let tracer = trainer.tracer(&stage, &trainer.shell, frame, &posed);
        for pixel in 0..48 * 48 {
            group.samples.trace(&tracer, &crate::train::trainer::pixel_ray(frame, pixel));
        }
        let parameter = |part| trainer.parameters.get(part);
        let (field, table) =
            (parameter(crate::model::parameters::Part::Field), parameter(crate::model::parameters::Part::Table));
        trainer.field.forward(field, table, &code.rows, &trainer.counts, &mut group, None);
        assert!(group.samples.len() > 500);
        group.samples.faces.into_iter().zip(group.rgb).collect()
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
        // How far each colour lies outside of those at the corners of its face, and whether none of them was seen.
        let strays = |trainer: &mut Trainer<'_>| -> Vec<(f32, bool)> {
            let stray = |((face, _), rgb): ((u32, [f32; 3]), Vec3)| {
                let corners = scene.model.faces[face as usize];
                let colors = corners.map(|v| between(shown.colors[v as usize]));
                let (low, high) = (colors[0].min(colors[1]).min(colors[2]), colors[0].max(colors[1]).max(colors[2]));
                let outside = (low - rgb).max(rgb - high).max_element();
                (outside, corners.iter().all(|&v| !shown.seen[v as usize]))
            };
            colours_of_samples(trainer).into_iter().map(stray).collect()
        };
        // What the perceptron's first values add is small.
        assert!(strays(&mut trainer).iter().all(|stray| stray.0 <= 0.03));
        for _ in 0..20 {
            trainer.step().unwrap();
        }
        let (unseen, seen): (Vec<_>, Vec<_>) = strays(&mut trainer).into_iter().partition(|stray| stray.1);
        assert!(unseen.len() > 50 && unseen.iter().all(|stray| stray.0 <= 1e-6), "{}", unseen.len());
        assert!(seen.iter().any(|stray| stray.0 > 0.03));
    }
}
