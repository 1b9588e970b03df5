//! The encoding γ of each method.

use std::fmt::Debug;
use std::ops::Range;
use std::sync::Arc;

use glam::Vec3;
use hashgrid::{HashGrid, HashGridConfig, Layout};
use volrender::Aabb;

use crate::Error;
use crate::config::{Config, EncodingConfig, Method};
use crate::model::samples::Samples;

/// An encoding of canonical points x̂ (normalised metres) that is defined outside of this crate; see
/// [`Trainer::with_encoder`](crate::Trainer::with_encoder).
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
