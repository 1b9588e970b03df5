//! A coarse grid of the cells in which a posed body can be, so that empty space costs nothing.

use glam::{IVec3, Vec3};
use volrender::Aabb;

/// Cells an axis at most; a body with outstretched arms at 1 cm needs about 200.
const MAX_CELLS: f32 = 256.0;

/// Marks a superset of the points within a margin of a triangle mesh that turns by no more than 120° at its edges, or
/// enclosed by it and not too deep.
#[derive(Clone, Debug, Default)]
pub(crate) struct Occupancy {
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
    /// are closest to an edge or a corner, of all triangles there), none above `margin`, and inside down to `depth`.
    pub fn rebuild(
        &mut self,
        vertices: &[Vec3],
        faces: &[[u32; 3]],
        margins: &[f32],
        margin: f32,
        depth: f32,
        cell: f32,
    ) {
        let low = vertices.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = vertices.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        self.live.clear();
        self.region = None;
        if !(low.is_finite() && high.is_finite()) {
            self.size = IVec3::ZERO;
            return;
        }
        let extent = (high - low).max_element() + 2.0 * margin;
        let cell = cell.max(extent / MAX_CELLS);
        let border = Vec3::splat(margin + 1.5 * cell);
        self.region = Some(Aabb { min: low - Vec3::splat(margin), max: high + Vec3::splat(margin) });
        self.min = low - border;
        self.per_cell = 1.0 / cell;
        self.size = ((high - low + 2.0 * border) * self.per_cell).ceil().as_ivec3().max(IVec3::ONE);
        self.live.resize((self.size.x * self.size.y * self.size.z) as usize, false);
        // Deeper than any margin: the whole inside, sealed off.
        let fills = depth > margin;
        let depth = if fills { 0.0 } else { depth };
        for (face, &margin) in faces.iter().zip(margins) {
            let corners = face.map(|v| vertices[v as usize]);
            let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
            let ahead = (margin * support(normal)).max(depth * support(-normal));
            let behind = (margin * support(-normal)).max(depth * support(normal));
            let first = self.cell(corners[0].min(corners[1]).min(corners[2]) - behind);
            let last = self.cell(corners[0].max(corners[1]).max(corners[2]) + ahead);
            let (first, last) = (first.max(IVec3::ZERO), last.min(self.size - IVec3::ONE));
            for z in first.z..=last.z {
                for y in first.y..=last.y {
                    let row = self.index(IVec3::new(first.x, y, z));
                    self.live[row..=row + (last.x - first.x) as usize].fill(true);
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

    /// The box of everything within the margin of the mesh; `None` for a mesh without finite vertices.
    pub fn region(&self) -> Option<Aabb> {
        self.region
    }

    /// Whether `point` can be within the margin or inside; false only where it certainly is not.
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

    fn index(&self, cell: IVec3) -> usize {
        ((cell.z * self.size.y + cell.y) * self.size.x + cell.x) as usize
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use testkit::oracle;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn every_point_inside_or_within_the_margin_is_live(
            mesh in testkit::strategy::bumpy_sphere(), margin in 0.02f32..0.3, cell in 0.03f32..0.3,
            queries in prop::collection::vec(testkit::strategy::vec3(1.6), 60)
        ) {
            let mut occupancy = Occupancy::default();
            occupancy.rebuild(&mesh.vertices, &mesh.faces, &vec![margin; mesh.faces.len()], margin, 10.0, cell);
            for q in queries {
                let (_, _, distance) = oracle::closest_point(&mesh.vertices, &mesh.faces, q);
                if distance < f64::from(margin) || oracle::inside(&mesh.vertices, &mesh.faces, q) {
                    prop_assert!(occupancy.is_live(q), "{q} at {distance}");
                } else if distance > f64::from(margin) * 2.0 + 4.0 * f64::from(cell) + 1.0 {
                    prop_assert!(!occupancy.is_live(q), "{q} at {distance}");
                }
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn every_point_within_its_faces_margin_or_the_depth_is_live(
            mesh in testkit::strategy::bumpy_sphere(), near in 0.0f32..0.3, far in 0.0f32..0.3,
            depth in 0.0f32..0.3, cell in 0.02f32..0.1,
            places in prop::collection::vec((any::<prop::sample::Index>(), -0.3f32..0.3, testkit::strategy::vec3(0.1)), 200)
        ) {
            // One margin above, another below: they differ at few edges.
            let above = |face: &[u32; 3]| face.iter().map(|&v| mesh.vertices[v as usize].z).sum::<f32>() > 0.0;
            let margins: Vec<f32> = mesh.faces.iter().map(|f| if above(f) { near } else { far }).collect();
            let mut occupancy = Occupancy::default();
            occupancy.rebuild(&mesh.vertices, &mesh.faces, &margins, 0.3, depth, cell);
            let distance = surface_query::MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
            for (face, along, shift) in places {
                let [a, b, c] = mesh.faces[face.index(mesh.faces.len())].map(|v| mesh.vertices[v as usize]);
                let q = (a + b + c) / 3.0 + along * (b - a).cross(c - a).normalize_or_zero() + shift;
                let Some(closest) = distance.closest(q, f32::INFINITY) else { continue };
                let d = closest.signed_distance;
                let margin = if q.z.abs() < 0.5 { near.min(far) } else { margins[closest.face as usize] };
                if d <= margin && -d <= depth {
                    prop_assert!(occupancy.is_live(q), "{q} at {d}: margin {margin}, depth {depth}");
                }
            }
        }
    }

    #[test]
    fn far_points_and_empty_meshes_are_dead() {
        let mut occupancy = Occupancy::default();
        assert!(!occupancy.is_live(Vec3::ZERO));
        occupancy.rebuild(&[], &[], &[], 0.1, 1.0, 0.1);
        assert!(!occupancy.is_live(Vec3::ZERO) && occupancy.region().is_none());
        let mesh = testkit::mesh::icosphere(1);
        occupancy.rebuild(&mesh.vertices, &mesh.faces, &vec![0.1; mesh.faces.len()], 0.1, 2.0, 0.1);
        assert!(occupancy.is_live(Vec3::ZERO) && !occupancy.is_live(Vec3::splat(1.4)));
        assert!(!occupancy.is_live(Vec3::splat(f32::NAN)) && !occupancy.is_live(Vec3::splat(1e30)));
    }
}
