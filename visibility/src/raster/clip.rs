//! Clipping at the near plane and the guard band.

use glam::{DVec3, Vec3};

use super::project::{GUARD, Projected, Projection, fixed};

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
pub(super) fn clip(
    projection: &Projection,
    corners: [(Vec3, &Projected); 3],
    mut emit: impl FnMut([([i32; 2], f32); 3]),
) {
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
