//! The nearest vertices of points, for encoders that blend over them.

use anyhow::Result;
use glam::Vec3;
use occnerf::{Body, Config};
use surface_query::{SurfaceQuery, SurfaceQueryConfig};

/// The nearest vertices of the canonical body, every level of the pyramid.
#[derive(Debug)]
pub struct Neighbours {
    pub query: SurfaceQuery,
    pub vertices: Vec<Vec3>,
}

impl Neighbours {
    pub fn new(body: &Body, config: &Config) -> Result<Self> {
        let vertices = body.canonical.vertices.clone();
        let query = SurfaceQueryConfig {
            k: config.surface.k,
            coarse_levels: config.surface.coarse_levels,
            cell: 0.02,
            margin: config.motion.reach() + 0.03,
            ratio: 0.25,
        };
        Ok(Self { query: SurfaceQuery::new(&vertices, &body.model.faces, &query)?, vertices })
    }

    /// Calls `each` with every point of `points`, its first `count` neighbours, and their inverse
    /// distances, which add up to 1.
    pub fn of(&self, points: &[[f32; 3]], count: usize, mut each: impl FnMut(usize, Vec3, &[u32], &[f32])) {
        /// Added to distances before they are inverted, normalised metres: a point may lie on a
        /// vertex.
        const NEAREST: f32 = 1e-3;
        let (mut neighbours, mut shares) = (vec![0; self.query.neighbours_per_query()], vec![0.0; count]);
        for (index, &x) in points.iter().enumerate() {
            let x = Vec3::from_array(x);
            self.query.neighbours(x, &mut neighbours);
            for (share, &v) in shares.iter_mut().zip(&neighbours) {
                *share = (x.distance(self.vertices[v as usize]) + NEAREST).recip();
            }
            let sum: f32 = shares.iter().sum();
            shares.iter_mut().for_each(|share| *share /= sum);
            each(index, x, &neighbours[..count], &shares);
        }
    }
}
