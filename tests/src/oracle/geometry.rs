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
