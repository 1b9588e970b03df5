use glam::{DVec3, Vec3};

fn corners(vertices: &[Vec3], face: &[u32; 3]) -> [DVec3; 3] {
    face.map(|i| vertices[i as usize].as_dvec3())
}

/// Closest point of segment `a`–`b` to `q`; a point segment gives `a`.
fn closest_on_segment(a: DVec3, b: DVec3, q: DVec3) -> DVec3 {
    let along = b - a;
    let length_squared = along.length_squared();
    if length_squared == 0.0 {
        return a;
    }
    a + along * ((q - a).dot(along) / length_squared).clamp(0.0, 1.0)
}

/// Closest point of a triangle: the foot of the perpendicular if it falls inside, else the best of
/// the edges.
fn closest_on_triangle([a, b, c]: [DVec3; 3], q: DVec3) -> DVec3 {
    let normal = (b - a).cross(c - a);
    if let Some(n) = normal.try_normalize() {
        let foot = q - n * (q - a).dot(n);
        let inward = |from: DVec3, to: DVec3| (to - from).cross(foot - from).dot(n) >= 0.0;
        if inward(a, b) && inward(b, c) && inward(c, a) {
            return foot;
        }
    }
    let mut best = closest_on_segment(a, b, q);
    for other in [closest_on_segment(b, c, q), closest_on_segment(c, a, q)] {
        if other.distance_squared(q) < best.distance_squared(q) {
            best = other;
        }
    }
    best
}

/// Face, point and unsigned distance of the point of the mesh closest to `q`; ties by lower face.
///
/// # Panics
/// On a mesh without faces.
#[must_use]
pub fn closest_point(vertices: &[Vec3], faces: &[[u32; 3]], q: Vec3) -> (u32, DVec3, f64) {
    let q = q.as_dvec3();
    let mut best: Option<(u32, DVec3, f64)> = None;
    for (i, face) in faces.iter().enumerate() {
        let point = closest_on_triangle(corners(vertices, face), q);
        let distance = point.distance(q);
        if best.is_none_or(|(_, _, nearest)| distance < nearest) {
            best = Some((i as u32, point, distance));
        }
    }
    best.unwrap_or_else(|| panic!("closest_point: a mesh without faces"))
}

/// First face met by the ray `o + t d`, t ≥ 0, from either side, and its `t` (in units of `d`);
/// ties by lower face. Rays in a triangle's plane miss it.
#[must_use]
pub fn first_hit(vertices: &[Vec3], faces: &[[u32; 3]], o: Vec3, d: Vec3) -> Option<(u32, f64)> {
    let (o, d) = (o.as_dvec3(), d.as_dvec3());
    let mut first: Option<(u32, f64)> = None;
    for (i, face) in faces.iter().enumerate() {
        let [a, b, c] = corners(vertices, face);
        let normal = (b - a).cross(c - a);
        let slope = normal.dot(d);
        if slope == 0.0 {
            continue;
        }
        let t = normal.dot(a - o) / slope;
        let p = o + d * t;
        let side = |from: DVec3, to: DVec3| (to - from).cross(p - from).dot(normal) >= 0.0;
        let hit = t >= 0.0 && side(a, b) && side(b, c) && side(c, a);
        if hit && first.is_none_or(|(_, nearest)| t < nearest) {
            first = Some((i as u32, t));
        }
    }
    first
}

/// Generalised winding number of the mesh about `q`: the sum of its faces' signed solid angles over
/// 4π (van Oosterom and Strackee 1983). 1 inside a closed mesh wound outward, 0 outside, 0.5 on a
/// smooth surface.
#[must_use]
pub fn winding_number(vertices: &[Vec3], faces: &[[u32; 3]], q: Vec3) -> f64 {
    let q = q.as_dvec3();
    let solid_angle = |face: &[u32; 3]| {
        let [a, b, c] = corners(vertices, face).map(|v| v - q);
        let (la, lb, lc) = (a.length(), b.length(), c.length());
        let numerator = a.dot(b.cross(c));
        let denominator = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
        2.0 * numerator.atan2(denominator)
    };
    faces.iter().map(solid_angle).sum::<f64>() / (4.0 * std::f64::consts::PI)
}

/// Whether `q` is inside a closed mesh: winding number above ½.
#[must_use]
pub fn inside(vertices: &[Vec3], faces: &[[u32; 3]], q: Vec3) -> bool {
    winding_number(vertices, faces, q) > 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::{cuboid, open_grid, torus};
    use approx::assert_abs_diff_eq;

    #[test]
    fn closest_points_of_a_box_are_found_on_face_edge_and_corner() {
        let mesh = cuboid(Vec3::ONE);
        for (q, expected) in [
            (Vec3::new(0.2, 3.0, -0.3), DVec3::new(0.2, 1.0, -0.3)),
            (Vec3::new(2.0, 2.0, 0.5), DVec3::new(1.0, 1.0, 0.5)),
            (Vec3::new(-4.0, 2.0, -9.0), DVec3::new(-1.0, 1.0, -1.0)),
            (Vec3::new(0.9, 0.0, 0.1), DVec3::new(1.0, 0.0, 0.1)),
        ] {
            let (_, point, distance) = closest_point(&mesh.vertices, &mesh.faces, q);
            assert!(point.distance(expected) < 1e-6, "{q}: {point}");
            assert_abs_diff_eq!(distance, expected.distance(q.as_dvec3()), epsilon = 1e-6);
        }
    }

    #[test]
    fn triangles_without_area_are_segments_or_points() {
        let vertices = [Vec3::ZERO, Vec3::X, Vec3::X * 2.0];
        let (_, point, _) = closest_point(&vertices, &[[0, 1, 2]], Vec3::new(1.5, 1.0, 0.0));
        assert!(point.distance(DVec3::new(1.5, 0.0, 0.0)) < 1e-12);
        let (_, point, _) = closest_point(&vertices, &[[1, 1, 1]], Vec3::Y);
        assert_eq!(point, DVec3::X);
    }

    #[test]
    fn rays_hit_the_near_side_first() {
        let mesh = cuboid(Vec3::ONE);
        let hit = |o, d| first_hit(&mesh.vertices, &mesh.faces, o, d).map(|h| h.1);
        assert_eq!(hit(Vec3::new(0.1, 0.2, 5.0), -Vec3::Z * 2.0), Some(2.0));
        assert_eq!(hit(Vec3::new(0.1, 0.2, 0.0), -Vec3::Z), Some(1.0));
        assert_eq!(hit(Vec3::new(0.1, 0.2, 5.0), Vec3::Z), None);
        assert_eq!(hit(Vec3::new(3.0, 0.2, 5.0), -Vec3::Z), None);
    }

    #[test]
    fn winding_is_one_inside_zero_outside_and_zero_in_the_hole_of_a_torus() {
        let mesh = torus(2.0, 0.5, 24, 12);
        let winding = |q| winding_number(&mesh.vertices, &mesh.faces, q);
        assert_abs_diff_eq!(winding(Vec3::X * 2.0), 1.0, epsilon = 1e-9);
        assert!(winding(Vec3::ZERO).abs() < 1e-9);
        assert!(winding(Vec3::X * 4.0).abs() < 1e-9);
        assert!(inside(&mesh.vertices, &mesh.faces, Vec3::Z * 1.9));
    }

    #[test]
    fn an_open_sheet_covers_half_the_sky_from_close_by() {
        let sheet = open_grid(1);
        let w = winding_number(&sheet.vertices, &sheet.faces, -Vec3::Z * 1e-4);
        assert_abs_diff_eq!(w, 0.5, epsilon = 1e-3);
    }
}
