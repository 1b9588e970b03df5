//! [v_i, d_i] of each nearest vertex is encoded, d_i the height of x̂ over the tangent plane of
//! v_i, and the features are blended by inverse distances (the order of Peng et al. 2022,
//! SelfNeRF).

use anyhow::Result;
use hashgrid::{HashGrid, HashGridConfig};
use occnerf::{Body, Config, EncodingConfig, PointEncoder};
use volrender::Aabb;

use super::neighbours::Neighbours;

/// A hash grid over the coordinates of vertices.
#[derive(Debug)]
pub struct SelfNerf {
    neighbours: Neighbours,
    grid: HashGrid<4>,
    /// Neighbours that are blended.
    k: usize,
    region: Aabb,
    /// Interval that d is clamped to, normalised metres.
    range: (f32, f32),
}

impl SelfNerf {
    pub fn new(neighbours: Neighbours, body: &Body, config: &Config) -> Result<Self> {
        let EncodingConfig { levels, features, log2_table_size, n_min, n_max, distance_min, distance_max } =
            config.encoding;
        let grid = HashGrid::new(&HashGridConfig { levels, features, log2_table_size, n_min, n_max })?;
        let (region, range) = (body.canonical_box, (distance_min, distance_max));
        Ok(Self { neighbours, grid, k: config.surface.k, region, range })
    }

    /// Coordinates in the unit box, and shares, of the k neighbours of each point.
    fn neighbours(&self, points: &[[f32; 3]]) -> (Vec<[f32; 4]>, Vec<f32>) {
        let (Neighbours { query, vertices, .. }, (low, high)) = (&self.neighbours, self.range);
        let (mut at, mut all) = (Vec::with_capacity(self.k * points.len()), Vec::with_capacity(self.k * points.len()));
        self.neighbours.of(points, self.k, |_, x, neighbours, shares| {
            at.extend(neighbours.iter().map(|&v| {
                let vertex = vertices[v as usize];
                let height = (x - vertex).dot(query.normals()[v as usize]);
                let p = (vertex - self.region.min) / (self.region.max - self.region.min);
                [p.x, p.y, p.z, (height.clamp(low, high) - low) / (high - low)]
            }));
            all.extend_from_slice(shares);
        });
        (at, all)
    }
}

impl PointEncoder for SelfNerf {
    fn num_features(&self) -> usize {
        self.grid.num_features()
    }

    fn initial(&self, seed: u64) -> Vec<f32> {
        self.grid.init_table(seed)
    }

    fn encode(&self, table: &[f32], points: &[[f32; 3]], features: &mut [f32]) {
        let (at, shares) = self.neighbours(points);
        let width = self.num_features();
        let (mut encoded, mut rows) = (vec![0.0; at.len() * width], vec![0.0; at.len() * width]);
        self.grid.encode(table, &at, &mut encoded);
        self.grid.layout(at.len()).to_rows(&encoded, 0..at.len(), &mut rows, width);
        features.fill(0.0);
        let each = rows.chunks_exact(self.k * width).zip(shares.chunks_exact(self.k));
        for (sum, (rows, shares)) in features.chunks_exact_mut(width).zip(each) {
            for (row, &share) in rows.chunks_exact(width).zip(shares) {
                sum.iter_mut().zip(row).for_each(|(sum, x)| *sum = share.mul_add(*x, *sum));
            }
        }
    }

    fn encode_backward(&self, points: &[[f32; 3]], d_features: &[f32], d_table: &mut [f32]) {
        let (at, shares) = self.neighbours(points);
        let width = self.num_features();
        let (mut d_encoded, mut d_rows) = (vec![0.0; at.len() * width], vec![0.0; at.len() * width]);
        for (i, (d_row, &share)) in d_rows.chunks_exact_mut(width).zip(&shares).enumerate() {
            let d = &d_features[i / self.k * width..][..width];
            d_row.iter_mut().zip(d).for_each(|(out, x)| *out = share * x);
        }
        self.grid.layout(at.len()).from_rows(&d_rows, width, 0..at.len(), &mut d_encoded);
        self.grid.encode_backward(&at, &d_encoded, d_table);
    }
}
