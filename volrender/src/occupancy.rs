use glam::{IVec3, Vec3};

use crate::Aabb;

/// Cells an axis at most; a body with outstretched arms at 1 cm needs about 200.
const MAX_CELLS: f32 = 256.0;

/// A coarse grid of the cells in which a body can be, so that samples in empty space cost nothing (Müller et al. 2022,
/// section 5.1, made from a mesh rather than from a field).
///
/// It marks a superset of the points within a margin of a triangle mesh that turns by no more than 120° at its edges, or
/// enclosed by it and not too deep.
#[derive(Clone, Debug, Default)]
pub struct Occupancy {
    min: Vec3,
    per_cell: f32,
    size: IVec3,
    live: Vec<bool>,
    queue: Vec<usize>,
    region: Option<Aabb>,
}

impl Occupancy {
    /// Rebuilds in place for `vertices` (V) and `faces` (F), which may be open: the cells at a triangle seal the inside off
    /// from the outside. Wanted are points outside within the `margins` (F) of the triangles they are closest to (where they
    /// are closest to an edge or a corner, of all triangles there), none above `margin`, and inside down to `depth`. Cells
    /// have sides of `cell`, or so long that no axis has more than about 256. All lengths are in the unit of the vertices.
    ///
    /// A mesh without vertices, or with one that is not finite, is nowhere, and so is one so large that lengths overflow.
    ///
    /// # Panics
    /// Where `margins` has not one entry a face, or a face names a vertex that is not there.
    pub fn rebuild(
        &mut self,
        vertices: &[Vec3],
        faces: &[[u32; 3]],
        margins: &[f32],
        margin: f32,
        depth: f32,
        cell: f32,
    ) {
        assert_eq!(margins.len(), faces.len(), "{} margins for {} faces", margins.len(), faces.len());
        let low = vertices.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = vertices.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        self.live.clear();
        self.region = None;
        self.size = IVec3::ZERO;
        let (margin, depth) = (margin.max(0.0), depth.max(0.0));
        let extent = (high - low).max_element() + 2.0 * margin;
        let cell = cell.max(extent / MAX_CELLS).max(f32::MIN_POSITIVE);
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
        self.live.resize((self.size.x * self.size.y * self.size.z) as usize, false);
        // Deeper than any margin: the whole inside, sealed off.
        let fills = depth > margin;
        let depth = if fills { 0.0 } else { depth };
        for (face, &own) in faces.iter().zip(margins) {
            let margin = own.max(0.0).min(margin);
            let corners = face.map(|v| vertices[v as usize]);
            let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
            let ahead = (margin * support(normal)).max(depth * support(-normal));
            let behind = (margin * support(-normal)).max(depth * support(normal));
            let first = self.cell(corners[0].min(corners[1]).min(corners[2]) - behind);
            let last = self.cell(corners[0].max(corners[1]).max(corners[2]) + ahead);
            let (first, last) = (first.max(IVec3::ZERO), last.min(self.size - IVec3::ONE));
            // Whole boxes seal the inside off.
            let planes = if fills { [f32::INFINITY; 2] } else { [depth, margin].map(|d| d * per_cell) };
            let slab = Slab::new(normal, (corners[0] - self.min) * per_cell, planes);
            for z in first.z..=last.z {
                for y in first.y..=last.y {
                    let (from, to) = slab.cells(y, z, first.x, last.x);
                    if from <= to {
                        let row = self.index(IVec3::new(from, y, z));
                        self.live[row..=row + (to - from) as usize].fill(true);
                    }
                }
            }
        }
        if fills {
            self.fill_enclosed();
        }
    }

    /// Cells that the outside cannot reach without crossing a marked one are inside.
    fn fill_enclosed(&mut self) {
        let mut outside = vec![false; self.live.len()];
        self.queue.clear();
        // The border is wider than a cell, so the outermost layer is empty and the first cell reaches all of it.
        self.queue.push(0);
        outside[0] = true;
        while let Some(index) = self.queue.pop() {
            let at = index as i32;
            let (sx, sxy) = (self.size.x, self.size.x * self.size.y);
            let cell = IVec3::new(at % sx, at / sx % self.size.y, at / sxy);
            for (axis, stride) in [(0, 1), (1, sx), (2, sxy)] {
                for step in [-1, 1] {
                    let next = cell[axis] + step;
                    if next < 0 || next >= self.size[axis] {
                        continue;
                    }
                    let next = (at + step * stride) as usize;
                    if !outside[next] && !self.live[next] {
                        outside[next] = true;
                        self.queue.push(next);
                    }
                }
            }
        }
        self.live.iter_mut().zip(&outside).for_each(|(live, outside)| *live = !outside);
    }

    /// The box of everything within the margin of the mesh, where rays can meet anything; `None` for a mesh that is nowhere.
    #[must_use]
    pub fn region(&self) -> Option<Aabb> {
        self.region
    }

    /// Whether `point` can be within the margin or inside; false only where it certainly is not.
    #[inline]
    #[must_use]
    pub fn is_live(&self, point: Vec3) -> bool {
        // Truncation is the floor of what is not negative; NaN fails the comparison, and huge values saturate.
        let place = (point - self.min) * self.per_cell;
        if !place.cmpge(Vec3::ZERO).all() {
            return false;
        }
        let cell = place.as_ivec3();
        cell.cmplt(self.size).all() && self.live[self.index(cell)]
    }

    fn cell(&self, point: Vec3) -> IVec3 {
        ((point - self.min) * self.per_cell).floor().as_ivec3()
    }

    #[inline]
    fn index(&self, cell: IVec3) -> usize {
        ((cell.z * self.size.y + cell.y) * self.size.x + cell.x) as usize
    }
}

/// What lies between two planes parallel to a triangle, in cells. What is closest to a triangle, or to one of its edges or corners,
/// is no farther from its plane than from itself.
struct Slab {
    normal: Vec3,
    /// One over the first coordinate of the normal, finite.
    per_x: f32,
    /// Bounds of normal · (centre of a cell).
    low: f32,
    high: f32,
}

impl Slab {
    /// Between the planes `behind` and `ahead` of the one of a triangle with this corner.
    fn new(normal: Vec3, corner: Vec3, [behind, ahead]: [f32; 2]) -> Self {
        // A cell is in the slab where any of it is: half its extent along the normal, and more than rounding takes.
        let half = 0.5 * normal.abs().element_sum() + 0.01;
        let at = normal.dot(corner);
        let x = if normal.x.abs() < 1e-6 { 1e-6 } else { normal.x };
        Self { normal, per_x: 1.0 / x, low: at - behind - half, high: at + ahead + half }
    }

    /// First and last cell of row (y, z) between `first` and `last` that are in the slab; none where the first lies after the
    /// last.
    #[inline]
    fn cells(&self, y: i32, z: i32, first: i32, last: i32) -> (i32, i32) {
        let rest = self.normal.y * (y as f32 + 0.5) + self.normal.z * (z as f32 + 0.5);
        let (a, b) = ((self.low - rest) * self.per_x - 0.5, (self.high - rest) * self.per_x - 0.5);
        // Conversions saturate.
        (first.max(a.min(b).ceil() as i32), last.min(a.max(b).floor() as i32))
    }
}

/// How far the unit vectors within 60° of `normal` reach along each axis, at least 0. A point lies in the direction of the
/// normal from a closest point inside a face, and between the normals around from one on an edge or a corner: within 60° of
/// one of them unless the surface turns by more than 120° there.
fn support(normal: Vec3) -> Vec3 {
    const COS: f32 = 0.5;
    const SIN: f32 = 0.866_025_4;
    // cos(a − 60°) for the angle a between the axis and the normal, where that is larger than 60°.
    let turned = COS * normal + SIN * (Vec3::ONE - normal * normal).max(Vec3::ZERO).map(f32::sqrt);
    Vec3::select(normal.cmpge(Vec3::splat(COS)), Vec3::ONE, turned.max(Vec3::ZERO))
}
