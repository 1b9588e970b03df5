//! The encoding γ of each method, and the learnable vertices of the surface term: encoded once a
//! step, gathered by every sample.

use std::fmt::Debug;
use std::ops::Range;
use std::sync::Arc;

use glam::Vec3;
use hashgrid::{HashGrid, HashGridConfig, Layout};
use rayon::prelude::*;
use volrender::Aabb;

use crate::Error;
use crate::config::{Config, EncodingConfig, Method, SurfaceConfig};
use crate::model::body::{Body, SurfacePoint, surface_point, surface_point_backward};
use crate::model::samples::Samples;

/// An encoding of canonical points x̂ (normalised metres) that is defined outside of this crate;
/// see [`Trainer::with_encoder`](crate::Trainer::with_encoder).
///
/// Its parameters are one flat slice, trained at the rate of the hash table. Features are N × F,
/// a row a point. The same input has to give the same bits on any thread.
pub trait PointEncoder: Debug + Send + Sync {
    /// Features F of a point.
    fn num_features(&self) -> usize;
    /// Parameters before the first step; none by default.
    fn initial(&self, _seed: u64) -> Vec<f32> {
        Vec::new()
    }
    /// Writes the features of `points`.
    fn encode(&self, parameters: &[f32], points: &[[f32; 3]], features: &mut [f32]);
    /// Adds the gradient of the parameters.
    fn encode_backward(&self, _points: &[[f32; 3]], _d_features: &[f32], _d_parameters: &mut [f32]) {}
    /// Adds the gradient of the points, which `motion.kind = volume` learns from. By default
    /// features pass none on.
    fn encode_backward_points(&self, _points: &[[f32; 3]], _d_features: &[f32], _d_points: &mut [[f32; 3]]) {}
}

/// The encoding γ.
#[derive(Clone, Debug)]
pub(crate) enum Encoder {
    /// Hash grid on x̂.
    Point(HashGrid<3>),
    /// Hash grid on [v̂, d], and the interval that d is clamped to, normalised metres.
    Surface(HashGrid<4>, (f32, f32)),
    /// The caller's, of x̂.
    Custom(Arc<dyn PointEncoder>),
}

impl Encoder {
    pub fn new(config: &Config) -> Result<Self, Error> {
        let EncodingConfig { levels, features, log2_table_size, n_min, n_max, distance_min, distance_max } =
            config.encoding;
        let grid = HashGridConfig { levels, features, log2_table_size, n_min, n_max };
        Ok(match config.method {
            Method::Prior | Method::Surface | Method::HashPoint => Self::Point(HashGrid::new(&grid)?),
            Method::Occnerf => Self::Surface(HashGrid::new(&grid)?, (distance_min, distance_max)),
        })
    }

    pub fn num_features(&self) -> usize {
        match self {
            Self::Point(grid) => grid.num_features(),
            Self::Surface(grid, _) => grid.num_features(),
            Self::Custom(encoder) => encoder.num_features(),
        }
    }

    pub fn initial_table(&self, seed: u64) -> Vec<f32> {
        match self {
            Self::Point(grid) => grid.init_table(seed),
            Self::Surface(grid, _) => grid.init_table(seed),
            Self::Custom(encoder) => encoder.initial(seed),
        }
    }

    /// The coordinates that samples are encoded at, in the unit box for a grid.
    pub fn coordinates(&self, samples: &Samples, region: &Aabb, out: &mut Coordinates) {
        out.clear();
        match self {
            Self::Point(_) => out.point.extend(samples.canonical.iter().map(|&x| in_box(x, region).to_array())),
            Self::Surface(_, range) => out.surface.extend(
                samples.closest.iter().zip(&samples.distance).map(|(&v, &d)| surface_coordinates(v, d, region, *range)),
            ),
            Self::Custom(_) => out.point.extend(samples.canonical.iter().map(Vec3::to_array)),
        }
    }

    /// Adds a vertex with its signed distance; for the encoding of [v̂, d] alone.
    pub fn push_vertex(&self, v: Vec3, d: f32, region: &Aabb, out: &mut Coordinates) {
        if let Self::Surface(_, range) = self {
            out.surface.push(surface_coordinates(v, d, region, *range));
        }
    }

    /// Whether d takes part: beyond the clamp its gradient is zero.
    pub fn distance_is_inside(&self, d: f32) -> bool {
        matches!(self, Self::Surface(_, (low, high)) if d > *low && d < *high)
    }

    /// Memory layout of the features of `points` points.
    pub fn layout(&self, points: usize) -> Layout {
        match self {
            Self::Point(grid) => grid.layout(points),
            Self::Surface(grid, _) => grid.layout(points),
            Self::Custom(encoder) => Layout { levels: 1, points, features: encoder.num_features() },
        }
    }

    /// Features ([`Encoder::layout`]) of the coordinates.
    pub fn encode(&self, table: &[f32], at: At<'_>, features: &mut [f32]) {
        match self {
            Self::Point(grid) => grid.encode(table, at.point, features),
            Self::Surface(grid, _) => grid.encode(table, at.surface, features),
            Self::Custom(encoder) => encoder.encode(table, at.point, features),
        }
    }

    /// Adds the gradient of the table from all parts, in their order.
    pub fn encode_backward<'a>(
        &self,
        parts: impl Iterator<Item = (At<'a>, &'a [f32])> + Clone + Sync,
        d_table: &mut [f32],
    ) {
        match self {
            Self::Point(grid) => grid.encode_backward_parts(parts.map(|(at, d)| (at.point, d)), d_table),
            Self::Surface(grid, _) => grid.encode_backward_parts(parts.map(|(at, d)| (at.surface, d)), d_table),
            Self::Custom(encoder) => parts.for_each(|(at, d)| encoder.encode_backward(at.point, d, d_table)),
        }
    }

    /// Gradients of the coordinates; overwrites `d_at`.
    pub fn encode_backward_points(&self, table: &[f32], at: At<'_>, d_features: &[f32], d_at: &mut Coordinates) {
        d_at.clear();
        d_at.point.resize(at.point.len(), [0.0; 3]);
        d_at.surface.resize(at.surface.len(), [0.0; 4]);
        match self {
            Self::Point(grid) => grid.encode_backward_points(table, at.point, d_features, &mut d_at.point),
            Self::Surface(grid, _) => grid.encode_backward_points(table, at.surface, d_features, &mut d_at.surface),
            Self::Custom(encoder) => encoder.encode_backward_points(at.point, d_features, &mut d_at.point),
        }
    }

    /// Gradient `index` of coordinates as that of x̂, or of v̂ and d, in normalised metres.
    pub fn d_metres(&self, d_at: &Coordinates, index: usize, region: &Aabb) -> (Vec3, f32) {
        let per_metre = (region.max - region.min).recip();
        match self {
            Self::Custom(_) => (Vec3::from_array(d_at.point[index]), 0.0),
            Self::Point(_) => (Vec3::from_array(d_at.point[index]) * per_metre, 0.0),
            Self::Surface(_, (low, high)) => {
                let [x, y, z, w] = d_at.surface[index];
                (Vec3::new(x, y, z) * per_metre, w * (1.0 / (high - low)))
            }
        }
    }
}

/// Where samples are encoded; one of the two is filled.
#[derive(Clone, Debug, Default)]
pub(crate) struct Coordinates {
    pub point: Vec<[f32; 3]>,
    pub surface: Vec<[f32; 4]>,
}

/// Some of [`Coordinates`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct At<'a> {
    pub point: &'a [[f32; 3]],
    pub surface: &'a [[f32; 4]],
}

impl Coordinates {
    pub fn all(&self) -> At<'_> {
        At { point: &self.point, surface: &self.surface }
    }

    /// Those of vertices `range`, which are encoded on the surface.
    pub fn vertices(&self, range: Range<usize>) -> At<'_> {
        At { point: &[], surface: &self.surface[range] }
    }

    pub fn clear(&mut self) {
        self.point.clear();
        self.surface.clear();
    }
}

fn in_box(x: Vec3, region: &Aabb) -> Vec3 {
    (x - region.min) / (region.max - region.min)
}

/// [v̂, d] in the unit box.
fn surface_coordinates(v: Vec3, d: f32, region: &Aabb, (low, high): (f32, f32)) -> [f32; 4] {
    let p = in_box(v, region);
    [p.x, p.y, p.z, (d.clamp(low, high) - low) / (high - low)]
}

/// Makes a buffer of `len` values, which the caller writes. It grows by an eighth, where a
/// vector doubles: features are the largest array of a segment of samples.
pub(crate) fn fit(buffer: &mut Vec<f32>, len: usize) {
    if buffer.capacity() < len {
        *buffer = Vec::new();
        buffer.reserve_exact(len + len / 8);
    }
    buffer.resize(len, 0.0);
}

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
