//! Triangle set-up in fixed point, clipping at the near plane and the guard band, and binning into
//! bands of rows.

use std::ops::Range;

use glam::{DVec3, Vec3};

use super::project::{GUARD, Projected, Projection, STEP, fixed};
use crate::error::Error;

/// Rows of samples of a band.
pub(super) const BAND: usize = 16;
/// Faces of a set-up task.
pub(super) const CHUNK: usize = 2048;

/// A triangle in the image, wound so that its area is positive.
#[derive(Clone, Copy, Debug)]
pub(super) struct Triangle {
    /// Fixed-point corners.
    pub x: [i32; 3],
    pub y: [i32; 3],
    /// Samples in its bounding box: first and last column, first and last row.
    pub columns: [i32; 2],
    pub rows: [i32; 2],
    /// Index of the face.
    pub face: u32,
    /// Reciprocal of the depth: at the first corner, least and most.
    pub inverse: [f32; 3],
    /// Gradient of the reciprocal depth per fixed-point step.
    pub slope: [f64; 2],
}

/// Set-up triangles of consecutive faces.
#[derive(Debug, Default)]
pub(super) struct Chunk {
    /// Indices of the faces.
    pub range: Range<usize>,
    pub triangles: Vec<Triangle>,
    /// Indices of the triangles that overlap each band.
    pub bins: Vec<Vec<u32>>,
}

impl Chunk {
    pub fn begin(&mut self, range: Range<usize>, bands: usize) {
        self.range = range;
        self.triangles.clear();
        self.bins.iter_mut().for_each(Vec::clear);
        self.bins.resize_with(bands, Vec::new);
    }

    pub fn set_up(
        &mut self,
        faces: &[[u32; 3]],
        projected: &[Projected],
        vertices: &[Vec3],
        projection: &Projection,
    ) -> Result<(), Error> {
        for (i, face) in faces.iter().enumerate() {
            let mut corners = [&projected[..0]; 3];
            for (corner, &vertex) in corners.iter_mut().zip(face) {
                let at = vertex as usize;
                let outside = || Error::face_index(self.range.start + i, vertex, projected.len());
                *corner = projected.get(at..=at).ok_or_else(outside)?;
            }
            let [a, b, c] = corners.map(|corner| &corner[0]);
            let index = (self.range.start + i) as u32;
            if a.inverse > 0.0 && b.inverse > 0.0 && c.inverse > 0.0 {
                self.push(projection, index, [a, b, c].map(|v| ([v.x, v.y], v.inverse)));
            } else if !(a.inverse.is_nan() || b.inverse.is_nan() || c.inverse.is_nan()) {
                let v = face.map(|v| vertices[v as usize]);
                clip(projection, [(v[0], a), (v[1], b), (v[2], c)], |part| self.push(projection, index, part));
            }
        }
        Ok(())
    }

    #[inline]
    fn push(&mut self, projection: &Projection, face: u32, corners: [([i32; 2], f32); 3]) {
        let [mut a, b, mut c] = corners;
        let columns = samples(a.0[0], b.0[0], c.0[0], projection.width);
        let rows = samples(a.0[1], b.0[1], c.0[1], projection.height);
        if columns[0] > columns[1] || rows[0] > rows[1] {
            return;
        }
        let [bx, by, cx, cy] = [b.0[0] - a.0[0], b.0[1] - a.0[1], c.0[0] - a.0[0], c.0[1] - a.0[1]];
        let area = i64::from(bx) * i64::from(cy) - i64::from(cx) * i64::from(by);
        // Rows grow downwards: counter-clockwise triangles have a negative area.
        if area == 0 || (projection.cull_back && area > 0) {
            return;
        }
        if area < 0 {
            (a, c) = (c, a);
        }
        let [bx, by, cx, cy] = [b.0[0] - a.0[0], b.0[1] - a.0[1], c.0[0] - a.0[0], c.0[1] - a.0[1]].map(f64::from);
        let (bz, cz) = (f64::from(b.1) - f64::from(a.1), f64::from(c.1) - f64::from(a.1));
        let scale = 1.0 / area.abs() as f64;
        let index = self.triangles.len() as u32;
        self.triangles.push(Triangle {
            x: [a.0[0], b.0[0], c.0[0]],
            y: [a.0[1], b.0[1], c.0[1]],
            columns,
            rows,
            face,
            inverse: [a.1, a.1.min(b.1).min(c.1), a.1.max(b.1).max(c.1)],
            slope: [(bz * cy - cz * by) * scale, (cz * bx - bz * cx) * scale],
        });
        for band in rows[0] as usize / BAND..=rows[1] as usize / BAND {
            self.bins[band].push(index);
        }
    }
}

/// The first and last of `count` samples, at their middles, between three fixed-point coordinates.
fn samples(a: i32, b: i32, c: i32, count: usize) -> [i32; 2] {
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    let half = STEP / 2;
    [(low + half - 1).div_euclid(STEP).max(0), (high - half).div_euclid(STEP).min(count as i32 - 1)]
}

/// A triangle and five planes: at most eight corners.
const MOST_CORNERS: usize = 8;

/// A corner of the clipped polygon.
#[derive(Clone, Copy, Default)]
struct Corner {
    clip: DVec3,
    /// Projection of the original vertex, rounded as in the neighbouring triangles.
    vertex: Option<Projected>,
}

/// Clips a triangle at the near plane and the guard band, and emits the polygon as triangles of
/// fixed-point corners and reciprocal depths.
///
/// The clipped part of an edge depends on its two ends alone: triangles that share an edge still
/// share it.
fn clip(projection: &Projection, corners: [(Vec3, &Projected); 3], mut emit: impl FnMut([([i32; 2], f32); 3])) {
    let (near, guard) = (f64::from(projection.near), f64::from(GUARD));
    // Distances to the planes up to a factor, not negative inside.
    let planes: [&dyn Fn(DVec3) -> f64; 5] =
        [&|p| p.z - near, &|p| guard * p.z - p.x, &|p| guard * p.z + p.x, &|p| guard * p.z - p.y, &|p| {
            guard * p.z + p.y
        }];
    let mut polygon = [Corner::default(); MOST_CORNERS];
    let mut len = 3;
    for (corner, (v, &projected)) in polygon.iter_mut().zip(corners) {
        *corner = Corner { clip: projection.exact(v), vertex: (projected.inverse > 0.0).then_some(projected) };
    }
    for plane in planes {
        // Unclipped vertices are inside whatever the rounding, as for neighbouring triangles.
        let side = |corner: Corner| plane(corner.clip).max(if corner.vertex.is_some() { 0.0 } else { f64::MIN });
        let (old, sides) = (len, polygon.map(side));
        let mut kept = [Corner::default(); MOST_CORNERS];
        len = 0;
        let mut keep = |corner: Corner| {
            if len < MOST_CORNERS {
                kept[len] = corner;
                len += 1;
            }
        };
        for i in 0..old {
            let j = (i + 1) % old;
            if sides[i] >= 0.0 {
                keep(polygon[i]);
            }
            if (sides[i] >= 0.0) != (sides[j] >= 0.0) {
                // From inside to outside in either triangle of the edge.
                let (inner, outer) = if sides[i] >= 0.0 { (i, j) } else { (j, i) };
                let t = sides[inner] / (sides[inner] - sides[outer]);
                let (a, b) = (polygon[inner].clip, polygon[outer].clip);
                keep(Corner { clip: a + (b - a) * t, vertex: None });
            }
        }
        polygon = kept;
    }
    let screen = polygon.map(|corner| match corner.vertex {
        Some(v) => ([v.x, v.y], v.inverse),
        None => {
            // Rounding may put it slightly before the plane.
            let depth = corner.clip.z.max(near);
            let at = [corner.clip.x, corner.clip.y].map(|x| fixed((x / depth) as f32));
            (at, (1.0 / depth) as f32)
        }
    });
    for i in 2..len {
        emit([screen[0], screen[i - 1], screen[i]]);
    }
}
