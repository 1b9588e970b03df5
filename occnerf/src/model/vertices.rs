//! The learnable vertices of the surface term: encoded once a step, gathered by every sample.

use glam::Vec3;
use rayon::prelude::*;

use crate::config::SurfaceConfig;
use crate::model::body::Body;
use crate::model::distance::{SurfacePoint, surface_point, surface_point_backward};
use crate::model::encoder::{At, Coordinates, Encoder};

const CHUNK: usize = 512;
/// Farthest that a vertex's distance to its initial mesh is looked up; the encoding clamps earlier.
const FARTHEST: f32 = 0.5;

/// γ([v_i, d_i]) of every vertex.
#[derive(Clone, Debug, Default)]
pub(crate) struct VertexCode {
    /// Where each vertex is encoded.
    pub at: Coordinates,
    /// Features, V × F, and their gradient.
    pub rows: Vec<f32>,
    pub d_rows: Vec<f32>,
    /// Position, signed distance, and its gradient by the position, of each vertex.
    state: Vec<(Vec3, f32, Vec3)>,
    /// The vertices chunk by chunk.
    chunks: Vec<Chunk>,
}

/// Vertices that are encoded together.
#[derive(Clone, Debug, Default)]
struct Chunk {
    /// Features, or their gradient, as they are encoded.
    features: Vec<f32>,
    /// Gradient of where the vertices are encoded.
    d_at: Coordinates,
}

impl VertexCode {
    /// Encodes v_i = initial vertex + offset with its signed distance to the initial mesh. Without
    /// `offsets` vertices stay where they are.
    pub fn encode(&mut self, body: &Body, config: &SurfaceConfig, encoder: &Encoder, table: &[f32], offsets: &[f32]) {
        let vertices = &body.canonical.vertices;
        // Those that stay are looked up once.
        if !offsets.is_empty() || self.state.len() != vertices.len() {
            (0..vertices.len())
                .into_par_iter()
                .with_min_len(CHUNK)
                .map_init(Vec::new, |neighbours, i| {
                    let offset = offsets.get(3 * i..).filter(|o| !o.is_empty()).map_or(Vec3::ZERO, Vec3::from_slice);
                    let position = vertices[i] + offset;
                    let (distance, gradient) = distance_with_gradient(body, config, i, position, neighbours);
                    (position, distance, gradient)
                })
                .collect_into_vec(&mut self.state);
            self.at.clear();
            for &(v, d, _) in &self.state {
                encoder.push_vertex(v, d, &body.canonical_box, &mut self.at);
            }
        }
        let width = encoder.num_features();
        self.rows.resize(vertices.len() * width, 0.0);
        self.chunks.resize_with(vertices.len().div_ceil(CHUNK), Chunk::default);
        let chunks = self.rows.par_chunks_mut(CHUNK * width).zip(&mut self.chunks);
        chunks.enumerate().for_each(|(chunk, (rows, Chunk { features, .. }))| {
            let n = rows.len() / width;
            features.resize(rows.len(), 0.0);
            encoder.encode(table, self.at.vertices(chunk * CHUNK..chunk * CHUNK + n), features);
            encoder.layout(n).to_rows(features, 0..n, rows, width);
        });
    }

    /// Where vertices are encoded, and after [`VertexCode::backward`] the gradients of their
    /// features, chunk by chunk.
    pub fn parts(&self) -> impl Iterator<Item = (At<'_>, &[f32])> + Clone + Sync {
        self.chunks.iter().enumerate().map(|(chunk, Chunk { features, .. })| {
            let end = ((chunk + 1) * CHUNK).min(self.at.surface.len());
            (self.at.vertices(chunk * CHUNK..end), &features[..])
        })
    }

    /// Gradient of the offsets (V × 3, or none) from that of the features; overwrites.
    pub fn backward(&mut self, body: &Body, encoder: &Encoder, table: &[f32], d_offsets: &mut [f32]) {
        let Self { at, d_rows, state, chunks, .. } = self;
        let width = encoder.num_features();
        let d_rows = d_rows.par_chunks(CHUNK * width);
        if d_offsets.is_empty() {
            d_rows.zip(chunks).for_each(|(d_rows, Chunk { features, .. })| {
                let n = d_rows.len() / width;
                encoder.layout(n).from_rows(d_rows, width, 0..n, features);
            });
            return;
        }
        let chunks = d_offsets.par_chunks_mut(3 * CHUNK).zip(d_rows).zip(chunks).enumerate();
        chunks.for_each(|(chunk, ((d_offsets, d_rows), Chunk { features, d_at }))| {
            let n = d_offsets.len() / 3;
            let range = chunk * CHUNK..chunk * CHUNK + n;
            encoder.layout(n).from_rows(d_rows, width, 0..n, features);
            encoder.encode_backward_points(table, at.vertices(range.clone()), features, d_at);
            for (v, (state, d_offset)) in state[range].iter().zip(d_offsets.chunks_exact_mut(3)).enumerate() {
                let (d_v, d_d) = encoder.d_metres(d_at, v, &body.canonical_box);
                let through_distance = if encoder.distance_is_inside(state.1) { d_d * state.2 } else { Vec3::ZERO };
                (d_v + through_distance).write_to_slice(d_offset);
            }
        });
    }
}

/// Signed distance of a point to the initial mesh and its gradient, by the query that samples use;
/// `neighbours` is scratch.
fn distance_with_gradient(
    body: &Body,
    config: &SurfaceConfig,
    vertex: usize,
    position: Vec3,
    neighbours: &mut Vec<u32>,
) -> (f32, Vec3) {
    if config.distance.needs_neighbours() {
        neighbours.resize(body.query.neighbours_per_query(), 0);
        body.query.neighbours(position, neighbours);
    }
    let Some(at) = surface_point(body, config, position, neighbours, FARTHEST) else {
        return (FARTHEST, Vec3::ZERO);
    };
    let (d_at, normal) = (SurfacePoint { closest: Vec3::ZERO, distance: 1.0 }, body.query.normals()[vertex]);
    (at.distance, surface_point_backward(body, config, (position, neighbours), at, d_at, normal))
}
