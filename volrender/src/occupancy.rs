use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::Aabb;

/// Cells an axis at most; a body with outstretched arms at 1 cm needs about 200.
const MAX_CELLS: f32 = 256.0;
/// Layers of cells that are marked together.
const LAYERS: usize = 8;

/// A coarse grid of the cells in which a body can be, so that samples in empty space cost nothing
/// (Müller et al. 2022, section 5.1, made from a mesh rather than from a field).
///
/// It marks a superset of the points within a margin of a triangle mesh that turns by no more than
/// 120° at its edges, or enclosed by it and not too deep.
#[derive(Clone, Debug, Default)]
pub struct Occupancy {
    min: Vec3,
    per_cell: f32,
    size: IVec3,
    /// A bit a cell, z by z, y by y: `words` for the cells of a row. All of them together fit a
    /// second-level cache.
    live: Vec<u64>,
    words: usize,
    reaches: Vec<Reach>,
    outside: Vec<bool>,
    queue: Vec<usize>,
    region: Option<Aabb>,
}

/// Distance from a mesh within which cells are marked, and their size, in the unit of its vertices.
#[derive(Clone, Copy, Debug)]
pub struct OccupancyConfig {
    /// Upper bound of the margins of the faces, outside.
    pub margin: f32,
    /// Depth down to which the inside is marked; all of it where this is above `margin`.
    pub depth: f32,
    /// Side of a cell; longer where an axis would have more than about 256.
    pub cell: f32,
}

impl Occupancy {
    /// Rebuilds in place for `vertices` (V) and `faces` (F), which may be open: the cells at a
    /// triangle seal the inside off from the outside. Wanted are points outside within the
    /// `margins` (F) of the triangles they are closest to (where they are closest to an edge or a
    /// corner, of all triangles there), none above `config.margin`, and inside down to
    /// `config.depth`.
    ///
    /// A mesh without vertices, or with one that is not finite, is nowhere, and so is one so large
    /// that lengths overflow. Lengths of `config` that are negative or NaN count as 0.
    ///
    /// # Panics
    /// Where `margins` has not one entry a face, or a face names a vertex that is not there.
    pub fn rebuild(&mut self, vertices: &[Vec3], faces: &[[u32; 3]], margins: &[f32], config: OccupancyConfig) {
        assert_eq!(margins.len(), faces.len(), "{} margins for {} faces", margins.len(), faces.len());
        let low = vertices.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = vertices.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        self.live.clear();
        self.region = None;
        self.size = IVec3::ZERO;
        let (margin, depth) = (config.margin.max(0.0), config.depth.max(0.0));
        let extent = (high - low).max_element() + 2.0 * margin;
        let cell = config.cell.max(extent / MAX_CELLS).max(f32::MIN_POSITIVE);
        let border = Vec3::splat(margin + 1.5 * cell);
        let per_cell = 1.0 / cell;
        let size = (high - low + 2.0 * border) * per_cell;
        // Infinite where any length is, and where there are no vertices.
        if !(size.is_finite() && vertices.iter().all(|v| v.is_finite())) {
            return;
        }
        self.region = Some(Aabb { min: low - Vec3::splat(margin), max: high + Vec3::splat(margin) });
        self.min = low - border;
        self.per_cell = per_cell;
        self.size = size.ceil().as_ivec3().max(IVec3::ONE);
        self.words = (self.size.x as usize).div_ceil(64);
        let layer = self.words * self.size.y as usize;
        self.live.resize(layer * self.size.z as usize, 0);
        // Deeper than any margin: the whole inside, sealed off.
        let fills = depth > margin;
        let depth = if fills { 0.0 } else { depth };
        let Self { min, size, words, reaches, live, .. } = self;
        (faces.par_iter().zip(margins))
            .map(|(face, &own)| {
                let corners = face.map(|v| (vertices[v as usize] - *min) * per_cell);
                Reach::new(corners, own.max(0.0).min(margin) * per_cell, depth * per_cell, fills, *size)
            })
            .collect_into_vec(reaches);
        live.par_chunks_mut(LAYERS * layer).enumerate().for_each(|(chunk, live)| {
            let z = (chunk * LAYERS) as i32;
            let layers = z..z + (live.len() / layer) as i32;
            reaches.iter().for_each(|reach| reach.mark(layers.clone(), size.y as usize, *words, live));
        });
        if fills {
            self.fill_enclosed();
        }
    }

    /// Cells that the outside cannot reach without crossing a marked one are inside.
    fn fill_enclosed(&mut self) {
        let size = self.size;
        let mut outside = std::mem::take(&mut self.outside);
        outside.clear();
        outside.resize((size.x * size.y * size.z) as usize, false);
        self.queue.clear();
        // The border is wider than a cell, so the outermost layer is empty and the first cell
        // reaches all of it.
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
                    if !outside[index] && !self.is_marked(next) {
                        outside[index] = true;
                        self.queue.push(index);
                    }
                }
            }
        }
        let rows = outside.chunks_exact(size.x as usize);
        for (live, outside) in self.live.chunks_exact_mut(self.words).zip(rows) {
            for (word, outside) in live.iter_mut().zip(outside.chunks(64)) {
                *word = outside.iter().enumerate().fold(0, |word, (bit, &outside)| word | u64::from(!outside) << bit);
            }
        }
        self.outside = outside;
    }

    /// The box of everything within the margin of the mesh, where rays can meet anything; `None`
    /// for a mesh that is nowhere.
    #[must_use]
    pub fn region(&self) -> Option<Aabb> {
        self.region
    }

    /// Whether `point` can be within the margin or inside; false only where it certainly is not.
    #[inline]
    #[must_use]
    pub fn is_live(&self, point: Vec3) -> bool {
        // Truncation is the floor of what is not negative; NaN fails the comparison, and huge
        // values saturate.
        let place = (point - self.min) * self.per_cell;
        if !place.cmpge(Vec3::ZERO).all() {
            return false;
        }
        let cell = place.as_ivec3();
        cell.cmplt(self.size).all() && self.is_marked(cell)
    }

    #[inline]
    fn is_marked(&self, cell: IVec3) -> bool {
        let row = (cell.z * self.size.y + cell.y) as usize * self.words;
        self.live[row + cell.x as usize / 64] >> (cell.x % 64) & 1 == 1
    }
}

/// The cells that are within a triangle's margins, in units of cells: those that three bodies have
/// in common.
///
/// - A box: what is closest to the triangle lies in the direction of its normal, or within 60° of
///   it.
/// - What lies between two planes parallel to the triangle: what is closest to it, or to one of its
///   edges or corners, is no farther from its plane than from itself.
/// - What is no farther than the larger margin from the triangle's box.
#[derive(Clone, Copy, Debug)]
struct Reach {
    /// First and last cell of the first body, cut off where the grid ends.
    first: IVec3,
    last: IVec3,
    /// Bounds of normal · (centre of a cell).
    normal: Vec3,
    low: f32,
    high: f32,
    /// One over the first coordinate of the normal, finite.
    per_x: f32,
    /// Corners of the triangle's box, and the square of the larger margin; infinite where the
    /// inside is to be sealed off, which whole boxes do.
    box_low: Vec3,
    box_high: Vec3,
    farthest: f32,
}

impl Reach {
    /// Margin for rounding, cells.
    const ROUNDING: f32 = 0.01;

    fn new(corners: [Vec3; 3], margin: f32, depth: f32, fills: bool, size: IVec3) -> Self {
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        let ahead = (margin * support(normal)).max(depth * support(-normal));
        let behind = (margin * support(-normal)).max(depth * support(normal));
        let box_low = corners[0].min(corners[1]).min(corners[2]);
        let box_high = corners[0].max(corners[1]).max(corners[2]);
        // A cell is between the planes where any of it is: half its extent along the normal.
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

    /// Marks the cells of some layers, whose rows are `live`.
    fn mark(&self, layers: std::ops::Range<i32>, rows: usize, words: usize, live: &mut [u64]) {
        // Between a row of cells and the triangle's box.
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
                    set_bits(&mut live[row..row + words], from as usize, to as usize);
                }
            }
        }
    }

    /// First and last cell of row (y, z) that are no farther than `left` along x; none where the
    /// first lies after the last.
    #[inline]
    fn row(&self, y: i32, z: i32, left: f32) -> (i32, i32) {
        let rest = self.normal.y * (y as f32 + 0.5) + self.normal.z * (z as f32 + 0.5);
        let (a, b) = ((self.low - rest) * self.per_x - 0.5, (self.high - rest) * self.per_x - 0.5);
        // Conversions saturate.
        let from = (self.box_low.x - left).floor().max(a.min(b).ceil()) as i32;
        let to = (self.box_high.x + left).floor().min(a.max(b).floor()) as i32;
        (self.first.x.max(from), self.last.x.min(to))
    }
}

/// Sets bits `from` to `to`, the last one too.
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

/// Extent along each axis of the unit vectors within 60° of `normal`, at least 0. A point lies in
/// the direction of the normal from a closest point inside a face, and between the normals around
/// from one on an edge or a corner: within 60° of one of them unless the surface turns by more than
/// 120° there.
fn support(normal: Vec3) -> Vec3 {
    const COS: f32 = 0.5;
    const SIN: f32 = 0.866_025_4;
    // cos(a − 60°) for the angle a between the axis and the normal, where that is larger than 60°.
    let turned = COS * normal + SIN * (Vec3::ONE - normal * normal).max(Vec3::ZERO).map(f32::sqrt);
    Vec3::select(normal.cmpge(Vec3::splat(COS)), Vec3::ONE, turned.max(Vec3::ZERO))
}
