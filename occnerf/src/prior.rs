//! The baseline without a field: the posed prior mesh in the mean colours that the video showed of it.

use glam::Vec3;
use rayon::prelude::*;

use crate::Error;
use crate::scene::{Scene, view};

/// A colour for each vertex of the prior.
#[derive(Clone, Debug, PartialEq)]
pub struct VertexColors {
    /// sRGB in [0, 1], V.
    pub colors: Vec<Vec3>,
}

impl VertexColors {
    /// The mean colour of the visible training pixels that saw each vertex, by ray casting; a vertex that none saw
    /// takes the colour of the nearest one that some saw.
    pub fn measure(scene: &Scene) -> Result<Self, Error> {
        let per_frame: Result<Vec<Vec<(Vec3, u32)>>, Error> = scene
            .train
            .par_iter()
            .map(|frame| {
                let mesh = visibility::RayMesh::new(&frame.posed.vertices, &scene.model.faces)?;
                let usable: Vec<bool> = frame.mask.iter().map(|&m| m > 0.5).collect();
                let view = view(&frame.camera);
                let seen = visibility::visible_vertices(&mesh, &frame.posed.vertices, &view, Some(&usable));
                let colour = |(vertex, seen): (&Vec3, bool)| {
                    let at = seen.then(|| frame.camera.project(*vertex)).flatten()?;
                    let pixel = at.y as usize * frame.camera.width as usize + at.x as usize;
                    let coverage = *frame.mask.get(pixel)?;
                    // Edge pixels are mixed with black in proportion to what the mask leaves free.
                    Some(Vec3::from_slice(&frame.pixels[3 * pixel..]) / coverage.max(0.5))
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
                let distance = |&&k: &&usize| vertices[k].distance_squared(vertices[v]);
                let nearest = known.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
                nearest.map_or(Vec3::splat(0.5), |&k| sums[k].0 / sums[k].1 as f32)
            })
            .collect();
        Ok(Self { colors })
    }
}
