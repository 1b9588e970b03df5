use glam::Vec3;

use crate::blend::sums;

/// Gradient of the blend with respect to the query, the neighbours held fixed.
pub(crate) fn blend_backward(
    vertices: &[Vec3],
    normals: &[Vec3],
    query: Vec3,
    finest: &[u32],
    d_point: Vec3,
    d_signed_distance: f32,
) -> Vec3 {
    let s = sums(vertices, normals, query, finest);
    let length = s.normal.length();
    let unit = s.normal.try_normalize();
    let normal = unit.unwrap_or(normals[finest[0] as usize]);

    // d = (x − v̂) · n̂
    let mut d_query = normal * d_signed_distance;
    let d_v = d_point - normal * d_signed_distance;
    let d_n = (query - s.point) * d_signed_distance;
    // n̂ = n / |n|; a fallback normal is a constant.
    let d_sum = match unit {
        Some(_) => (d_n - normal * normal.dot(d_n)) / length,
        None => Vec3::ZERO,
    };
    for &i in finest {
        let (v, n) = (vertices[i as usize], normals[i as usize]);
        let offset = query - v;
        let r = offset.length();
        if r == 0.0 {
            // |cos| has no derivative at the vertex.
            continue;
        }
        let d_w = d_v.dot(v - s.point) / s.weight + d_sum.dot(n);
        let direction = offset / r;
        d_query += if s.inverse_distance {
            direction * (-d_w / (r * r))
        } else {
            let cos = direction.dot(n);
            (n - direction * cos) * (d_w * signum_or_zero(cos) / r)
        };
    }
    d_query
}

fn signum_or_zero(x: f32) -> f32 {
    if x == 0.0 { 0.0 } else { x.signum() }
}
