use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::Aabb;

/// Largest number of cells per axis; a body with outstretched arms at 1 cm needs about 200.
const MAX_CELLS: f32 = 256.0;
/// Layers of cells per parallel task.
const LAYERS: usize = 8;

/// Occupancy grid around a triangle mesh, to skip samples in empty space (Müller et al. 2022,
/// section 5.1, built from a mesh instead of a field).
///
/// The occupied cells cover all points within a margin outside the mesh, and inside it down to a
/// depth, if the dihedral turn at its edges is at most 120°.
///
/// ```
/// use glam::Vec3;
/// use volrender::{Occupancy, OccupancyConfig};
///
/// let (vertices, faces) = ([Vec3::X, Vec3::Y, Vec3::Z], [[0, 1, 2]]);
/// let mut occupancy = Occupancy::default();
/// occupancy.rebuild(&vertices, &faces, &[0.05], OccupancyConfig { margin: 0.05, depth: 0.0, cell: 0.02 });
/// assert!(occupancy.is_occupied(Vec3::splat(1.0 / 3.0)) && !occupancy.is_occupied(Vec3::ZERO));
/// assert_eq!(occupancy.region().max, Vec3::splat(1.05));
/// ```
#[derive(Clone, Debug, Default)]
pub struct Occupancy {
    min: Vec3,
    per_cell: f32,
    size: IVec3,
    /// One bit per cell, x fastest, each row padded to `words`; fits a second-level cache.
    bits: Vec<u64>,
    words: usize,
    regions: Vec<FaceRegion>,
    outside: Vec<bool>,
    queue: Vec<usize>,
    region: Option<Aabb>,
}

/// Thickness of the occupied shell around a mesh and size of the cells, in the unit of its
/// vertices.
///
/// ```
/// use glam::Vec3;
/// use volrender::{Occupancy, OccupancyConfig};
///
/// let config = OccupancyConfig { margin: 0.2, depth: 0.1, cell: 0.02 };
/// let mut occupancy = Occupancy::default();
/// occupancy.rebuild(&[Vec3::X, Vec3::Y, Vec3::Z], &[[0, 1, 2]], &[0.2], config);
/// // Heights above the middle of the triangle.
/// let at = |height: f32| occupancy.is_occupied(Vec3::splat(1.0 / 3.0) + height * Vec3::ONE.normalize());
/// assert_eq!([-0.15, -0.05, 0.15, 0.25].map(at), [false, true, true, false]);
/// ```
#[derive(Clone, Copy, Debug)]
pub struct OccupancyConfig {
    /// Upper bound of the margins of the faces, to the outside.
    pub margin: f32,
    /// Depth of the occupied shell inside; above `margin` the whole inside is occupied.
    pub depth: f32,
    /// Side of a cell; enlarged if an axis would have more than 256 cells.
    pub cell: f32,
}

impl Occupancy {
    /// Rebuilds the grid in place for the mesh of `vertices` (V) and `faces` (F), which may be open
    /// if the occupied cells close its holes. A point outside is occupied if it is within the entry
    /// of `margins` (F), capped at `config.margin`, of its closest face (of all of them at an edge
    /// or a vertex).
    ///
    /// A mesh without vertices, with one that is not finite, or with lengths that overflow has no
    /// occupied cells. Lengths of `config` that are negative or NaN count as 0.
    ///
    /// # Panics
    /// If `margins` has not one entry per face, or a face has an index out of range.
    pub fn rebuild(&mut self, vertices: &[Vec3], faces: &[[u32; 3]], margins: &[f32], config: OccupancyConfig) {
        assert_eq!(margins.len(), faces.len(), "{} margins for {} faces", margins.len(), faces.len());
        let low = vertices.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = vertices.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        self.bits.clear();
        self.region = None;
        self.size = IVec3::ZERO;
        let (margin, depth) = (config.margin.max(0.0), config.depth.max(0.0));
        let extent = (high - low).max_element() + 2.0 * margin;
        let cell = config.cell.max(extent / MAX_CELLS).max(f32::MIN_POSITIVE);
        let border = Vec3::splat(margin + 1.5 * cell);
        let per_cell = 1.0 / cell;
        let size = (high - low + 2.0 * border) * per_cell;
        // Not finite if a length is not, or without vertices.
        if !(size.is_finite() && vertices.iter().all(|v| v.is_finite())) {
            return;
        }
        self.region = Some(Aabb { min: low - Vec3::splat(margin), max: high + Vec3::splat(margin) });
        self.min = low - border;
        self.per_cell = per_cell;
        self.size = size.ceil().as_ivec3().max(IVec3::ONE);
        self.words = (self.size.x as usize).div_ceil(64);
        let layer = self.words * self.size.y as usize;
        self.bits.resize(layer * self.size.z as usize, 0);
        // Deeper than any margin: flood-fill the whole inside.
        let fills = depth > margin;
        let depth = if fills { 0.0 } else { depth };
        let Self { min, size, words, regions, bits, .. } = self;
        (faces.par_iter().zip(margins))
            .map(|(face, &own)| {
                let corners = face.map(|v| (vertices[v as usize] - *min) * per_cell);
                FaceRegion::new(corners, own.max(0.0).min(margin) * per_cell, depth * per_cell, fills, *size)
            })
            .collect_into_vec(regions);
        bits.par_chunks_mut(LAYERS * layer).enumerate().for_each(|(chunk, bits)| {
            let z = (chunk * LAYERS) as i32;
            let layers = z..z + (bits.len() / layer) as i32;
            regions.iter().for_each(|region| region.mark(layers.clone(), size.y as usize, *words, bits));
        });
        if fills {
            self.fill_enclosed();
        }
    }

    /// Marks the cells that are not connected to the border: a flood fill of the outside.
    fn fill_enclosed(&mut self) {
        let size = self.size;
        let mut outside = std::mem::take(&mut self.outside);
        outside.clear();
        outside.resize((size.x * size.y * size.z) as usize, false);
        self.queue.clear();
        // The border is wider than a cell, so the outermost layer is empty and connected.
        self.queue.push(0);
        outside[0] = true;
        while let Some(index) = self.queue.pop() {
            let at = index as i32;
            let (sx, sxy) = (size.x, size.x * size.y);
            let cell = IVec3::new(at % sx, at / sx % size.y, at / sxy);
            for (axis, stride) in [(0, 1), (1, sx), (2, sxy)] {
                for step in [-1, 1] {
                    let mut next = cell;
                    next[axis] += step;
                    if next[axis] < 0 || next[axis] >= size[axis] {
                        continue;
                    }
                    let index = (at + step * stride) as usize;
                    if !outside[index] && !self.is_set(next) {
                        outside[index] = true;
                        self.queue.push(index);
                    }
                }
            }
        }
        let rows = outside.chunks_exact(size.x as usize);
        for (bits, outside) in self.bits.chunks_exact_mut(self.words).zip(rows) {
            for (word, outside) in bits.iter_mut().zip(outside.chunks(64)) {
                *word = outside.iter().enumerate().fold(0, |word, (bit, &outside)| word | u64::from(!outside) << bit);
            }
        }
        self.outside = outside;
    }

    /// Bounding box of the mesh and its margin; [`Aabb::EMPTY`] without occupied cells.
    pub fn region(&self) -> Aabb {
        self.region.unwrap_or(Aabb::EMPTY)
    }

    /// Whether `point` lies in an occupied cell.
    #[inline]
    pub fn is_occupied(&self, point: Vec3) -> bool {
        // Truncation is the floor of non-negative values; NaN fails the comparison, and huge
        // values saturate.
        let p = (point - self.min) * self.per_cell;
        if !p.cmpge(Vec3::ZERO).all() {
            return false;
        }
        let cell = p.as_ivec3();
        cell.cmplt(self.size).all() && self.is_set(cell)
    }

    #[inline]
    fn is_set(&self, cell: IVec3) -> bool {
        let row = (cell.z * self.size.y + cell.y) as usize * self.words;
        self.bits[row + cell.x as usize / 64] >> (cell.x % 64) & 1 == 1
    }
}

/// Conservative voxelisation of the points within the margins of a triangle, in units of cells: the
/// intersection of
///
/// - the triangle's box extended by the directions within 60° of its normal, which include those
///   from a closest point on the triangle;
/// - the slab between two planes parallel to the triangle: a point is no farther from its plane
///   than from the triangle;
/// - the points within the larger margin of the triangle's box.
#[derive(Clone, Copy, Debug)]
struct FaceRegion {
    /// First and last cell of the extended box, clipped to the grid.
    first: IVec3,
    last: IVec3,
    /// Slab: bounds of normal · (centre of a cell).
    normal: Vec3,
    low: f32,
    high: f32,
    /// Finite reciprocal of normal.x.
    per_x: f32,
    /// The triangle's box and the square of the larger margin; infinite for the flood fill, whose
    /// barrier needs whole extended boxes.
    box_low: Vec3,
    box_high: Vec3,
    farthest: f32,
}

impl FaceRegion {
    /// Tolerance for rounding in cells.
    const ROUNDING: f32 = 0.01;

    fn new(corners: [Vec3; 3], margin: f32, depth: f32, fills: bool, size: IVec3) -> Self {
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        let ahead = (margin * support(normal)).max(depth * support(-normal));
        let behind = (margin * support(-normal)).max(depth * support(normal));
        let box_low = corners[0].min(corners[1]).min(corners[2]);
        let box_high = corners[0].max(corners[1]).max(corners[2]);
        // Half the extent of a cell along the normal.
        let half = 0.5 * normal.abs().element_sum() + Self::ROUNDING;
        let at = normal.dot(corners[0]);
        let x = if normal.x.abs() < 1e-6 { 1e-6 } else { normal.x };
        Self {
            first: (box_low - behind).floor().as_ivec3().max(IVec3::ZERO),
            last: (box_high + ahead).floor().as_ivec3().min(size - IVec3::ONE),
            normal,
            low: if fills { f32::NEG_INFINITY } else { at - depth - half },
            high: if fills { f32::INFINITY } else { at + margin + half },
            per_x: 1.0 / x,
            box_low,
            box_high,
            farthest: if fills { f32::INFINITY } else { (margin.max(depth) + Self::ROUNDING).powi(2) },
        }
    }

    /// Marks the cells of `layers`; `bits` holds their rows.
    fn mark(&self, layers: std::ops::Range<i32>, rows: usize, words: usize, bits: &mut [u64]) {
        // Distance along an axis between a cell and the triangle's box.
        let gap = |axis: usize, cell: i32| {
            (self.box_low[axis] - (cell + 1) as f32).max(cell as f32 - self.box_high[axis]).max(0.0)
        };
        for z in self.first.z.max(layers.start)..=self.last.z.min(layers.end - 1) {
            let left_z = self.farthest - gap(2, z).powi(2);
            for y in self.first.y..=self.last.y {
                let left = left_z - gap(1, y).powi(2);
                if left < 0.0 {
                    continue;
                }
                let (from, to) = self.row(y, z, left.sqrt());
                if from <= to {
                    let row = ((z - layers.start) as usize * rows + y as usize) * words;
                    set_bits(&mut bits[row..row + words], from as usize, to as usize);
                }
            }
        }
    }

    /// First and last cell of row (y, z) within `left` along x; empty if the first is larger.
    #[inline]
    fn row(&self, y: i32, z: i32, left: f32) -> (i32, i32) {
        let rest = self.normal.y * (y as f32 + 0.5) + self.normal.z * (z as f32 + 0.5);
        let (a, b) = ((self.low - rest) * self.per_x - 0.5, (self.high - rest) * self.per_x - 0.5);
        // Conversions saturate and truncate, which `first` ≥ 0 makes floors: a call of `floor` costs
        // more than the rest of a row.
        let (low, high) = (a.min(b), a.max(b));
        let up = (low as i32).saturating_add((low > low as i32 as f32).into());
        let from = ((self.box_low.x - left) as i32).max(up);
        let end = (self.box_high.x + left).min(high);
        let to = if end < 0.0 { -1 } else { end as i32 };
        (self.first.x.max(from), self.last.x.min(to))
    }
}

/// Sets bits `from..=to`.
fn set_bits(words: &mut [u64], from: usize, to: usize) {
    let (first, last) = (from / 64, to / 64);
    let (low, high) = (u64::MAX << (from % 64), u64::MAX >> (63 - to % 64));
    if first == last {
        words[first] |= low & high;
    } else {
        words[first] |= low;
        words[first + 1..last].fill(u64::MAX);
        words[last] |= high;
    }
}

/// Extent along each axis of the unit vectors within 60° of `normal`, at least 0. The direction
/// from the closest point on a face is its normal; at an edge or vertex it lies between the normals
/// of the faces, within 60° of one of them unless the surface turns by more than 120°.
fn support(normal: Vec3) -> Vec3 {
    const COS: f32 = 0.5;
    const SIN: f32 = 0.866_025_4;
    // cos(a − 60°) if the angle a between axis and normal is larger than 60°.
    let turned = COS * normal + SIN * (Vec3::ONE - normal * normal).max(Vec3::ZERO).map(f32::sqrt);
    Vec3::select(normal.cmpge(Vec3::splat(COS)), Vec3::ONE, turned.max(Vec3::ZERO))
}
