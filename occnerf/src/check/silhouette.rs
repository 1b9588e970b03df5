//! Pixels that a posed body covers, by filling its triangles.

use glam::{Vec2, Vec3};
use volrender::Camera;

/// Triangles nearer than this share of the furthest vertex's depth are left out: they surround the
/// camera.
const NEAR: f32 = 1e-4;

/// Pixels (H × W) of `camera`'s image whose centres the mesh covers. Triangles with a vertex behind
/// the camera are left out.
pub(super) fn silhouette(vertices: &[Vec3], faces: &[[u32; 3]], camera: &Camera) -> Vec<bool> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut covered = vec![false; width * height];
    let inside: Vec<Vec3> = vertices.iter().map(|&v| camera.world_to_camera.transform_point3(v)).collect();
    let near = NEAR * inside.iter().map(|v| v.z).fold(0.0, f32::max);
    let project = |v: Vec3| {
        let pixel = camera.focal * v.truncate() / v.z + camera.centre;
        (v.z > near && pixel.is_finite()).then_some(pixel)
    };
    let projected: Vec<Option<Vec2>> = inside.into_iter().map(project).collect();
    let at = |index: u32| projected.get(index as usize).copied().flatten();
    for face in faces {
        if let (Some(a), Some(b), Some(c)) = (at(face[0]), at(face[1]), at(face[2])) {
            fill([a, b, c], width, height, &mut covered);
        }
    }
    covered
}

/// Sets the pixels whose centres lie in a triangle, its edges included.
fn fill([a, b, c]: [Vec2; 3], width: usize, height: usize, covered: &mut [bool]) {
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    // The centre of pixel i is at i + 0.5. `as` saturates, and takes less than a call to round.
    let first = |x: f32| {
        let below = (x - 0.5) as usize;
        below + usize::from((below as f32) < x - 0.5)
    };
    let after = |x: f32, most: usize| ((x + 0.5) as usize).min(most);
    let (rows, columns) = (first(low.y)..after(high.y, height), first(low.x)..after(high.x, width));
    // Most triangles of a small picture have no centre in them.
    if rows.is_empty() || columns.is_empty() {
        return;
    }
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let (b, c) = if area > 0.0 { (b, c) } else { (c, b) };
    for y in rows {
        let inside = |x: &usize| {
            let p = Vec2::new(*x as f32 + 0.5, y as f32 + 0.5);
            (b - a).perp_dot(p - a) >= 0.0 && (c - b).perp_dot(p - b) >= 0.0 && (a - c).perp_dot(p - c) >= 0.0
        };
        // Each side changes its sign once along a row, whatever the rounding.
        let mut row = columns.clone();
        if let Some(start) = row.find(inside) {
            let end = row.rev().find(inside).unwrap_or(start);
            covered[y * width + start..=y * width + end].fill(true);
        }
    }
}
