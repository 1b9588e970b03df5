//! The colours that a video shows of the prior.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::Error;
use crate::model::colors::VertexColors;
use crate::scene::prepared::{Scene, pinhole};

impl VertexColors {
    /// The mean colour of the visible training pixels that saw each vertex, by ray casting; a vertex that none saw takes
    /// the mean of those that some saw, weighted by their canonical distances to the power of −4 (Shepard 1968).
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
