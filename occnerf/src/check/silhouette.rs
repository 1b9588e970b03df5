//! Pixels that a posed body covers, by filling its triangles.

use glam::{UVec2, Vec2, Vec3};
use volrender::Camera;

/// Triangles nearer than this share of the furthest vertex's depth are left out: they surround the
/// camera.
const NEAR: f32 = 1e-4;

/// A projected vertex.
#[derive(Clone, Copy)]
struct Corner {
    at: Vec2,
    /// The first pixel in each direction whose centre is not before it, and the first that is behind
    /// it, within the picture.
    first: UVec2,
    after: UVec2,
}

impl Corner {
    fn new(at: Vec2, size: UVec2) -> Self {
        // The centre of pixel i is at i + 0.5. `as` saturates, and takes less than a call to round.
        let first = |x: f32| {
            let below = (x - 0.5) as u32;
            below.saturating_add(u32::from((below as f32) < x - 0.5))
        };
        let after = |x: f32| (x + 0.5) as u32;
        Self {
            at,
            first: UVec2::new(first(at.x), first(at.y)).min(size),
            after: UVec2::new(after(at.x), after(at.y)).min(size),
        }
    }
}

/// Pixels (H × W) of `camera`'s image whose centres the mesh covers. Triangles with a vertex behind
/// the camera are left out.
pub(super) fn silhouette(vertices: &[Vec3], faces: &[[u32; 3]], camera: &Camera) -> Vec<bool> {
    let size = UVec2::new(camera.width, camera.height);
    let mut covered = vec![false; size.x as usize * size.y as usize];
    let inside: Vec<Vec3> = vertices.iter().map(|&v| camera.world_to_camera.transform_point3(v)).collect();
    let near = NEAR * inside.iter().map(|v| v.z).fold(0.0, f32::max);
    let project = |v: Vec3| {
        let pixel = camera.focal * v.truncate() / v.z + camera.centre;
        (v.z > near && pixel.is_finite()).then(|| Corner::new(pixel, size))
    };
    let projected: Vec<Option<Corner>> = inside.into_iter().map(project).collect();
    let at = |index: u32| projected.get(index as usize).copied().flatten();
    for face in faces {
        if let (Some(a), Some(b), Some(c)) = (at(face[0]), at(face[1]), at(face[2])) {
            let (first, after) = (a.first.min(b.first).min(c.first), a.after.max(b.after).max(c.after));
            // Most triangles of a small picture have no centre in them.
            if first.x < after.x && first.y < after.y {
                fill([a.at, b.at, c.at], first, after, size.x as usize, &mut covered);
            }
        }
    }
    covered
}

/// Sets the pixels from `first` to before `after` whose centres lie in a triangle, its edges
/// included.
fn fill([a, b, c]: [Vec2; 3], first: UVec2, after: UVec2, width: usize, covered: &mut [bool]) {
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let (b, c) = if area > 0.0 { (b, c) } else { (c, b) };
    for y in first.y as usize..after.y as usize {
        let inside = |x: &usize| {
            let p = Vec2::new(*x as f32 + 0.5, y as f32 + 0.5);
            (b - a).perp_dot(p - a) >= 0.0 && (c - b).perp_dot(p - b) >= 0.0 && (a - c).perp_dot(p - c) >= 0.0
        };
        // Each side changes its sign once along a row, whatever the rounding.
        let mut row = first.x as usize..after.x as usize;
        if let Some(start) = row.find(inside) {
            let end = row.rev().find(inside).unwrap_or(start);
            covered[y * width + start..=y * width + end].fill(true);
        }
    }
}
