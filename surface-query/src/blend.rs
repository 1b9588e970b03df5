use glam::Vec3;

/// Sum of weights below which the cosines are mere rounding.
const MIN_WEIGHT: f32 = 1e-5;

/// Normal-weighted mean of the nearest vertices (surface-based rendering, OccNeRF §3.2), the result
/// of [`crate::SurfaceQuery::blend`]. Cheap and smooth for a fixed set of neighbours, but no exact
/// distance.
///
/// ```
/// use glam::Vec3;
/// use surface_query::{Blended, SurfaceQuery, SurfaceQueryConfig};
///
/// let vertices = [Vec3::ZERO, Vec3::X, Vec3::Y];
/// let surface = SurfaceQuery::new(&vertices, &[[0, 1, 2]], &SurfaceQueryConfig::default())?;
/// let Blended { point, normal, signed_distance } = surface.blend(Vec3::new(0.25, 0.25, -0.5), &[0, 1, 2]);
/// assert_eq!((normal, signed_distance), (Vec3::Z, -0.5)); // behind the triangle
/// assert!(point.distance(Vec3::new(0.283, 0.283, 0.0)) < 1e-3); // near the closest point, (0.25, 0.25, 0)
/// # Ok::<(), surface_query::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Blended {
    /// v̂ = Σ w_i v_i / Σ w_i.
    pub point: Vec3,
    /// n̂ = normalise(Σ w_i n_i), unit.
    pub normal: Vec3,
    /// d = (x − v̂) · n̂, in the units of the vertices, positive on the side the normals point to.
    pub signed_distance: f32,
}

/// Weighted sums, shared by the forward and backward pass.
pub(crate) struct Sums {
    pub weight: f32,
    pub point: Vec3,
    /// Σ w_i n_i, not normalised.
    pub normal: Vec3,
    /// Whether the weights are inverse distances instead of cosines.
    pub inverse_distance: bool,
}

/// w_i = |cos(x − v_i, n_i)|; 1 where x = v_i.
#[inline(always)]
pub(crate) fn cosine_weight(offset: Vec3, normal: Vec3) -> f32 {
    let length = offset.length();
    if length > 0.0 { (offset.dot(normal) / length).abs() } else { 1.0 }
}

#[inline(always)]
pub(crate) fn sums(vertices: &[Vec3], normals: &[Vec3], query: Vec3, finest: &[u32]) -> Sums {
    let s = accumulate(vertices, normals, query, finest, cosine_weight);
    if s.weight >= MIN_WEIGHT {
        return s;
    }
    // No offset is zero here: it would have had weight 1.
    let inverse = |offset: Vec3, _| 1.0 / offset.length();
    Sums { inverse_distance: true, ..accumulate(vertices, normals, query, finest, inverse) }
}

/// Σ w, Σ w v / Σ w and Σ w n. The mean is taken over offsets from the query: no cancellation far
/// from the origin.
#[inline(always)]
fn accumulate(
    vertices: &[Vec3],
    normals: &[Vec3],
    query: Vec3,
    finest: &[u32],
    weight: impl Fn(Vec3, Vec3) -> f32,
) -> Sums {
    let mut sum = Sums { weight: 0.0, point: Vec3::ZERO, normal: Vec3::ZERO, inverse_distance: false };
    for &i in finest {
        let (v, n) = (vertices[i as usize], normals[i as usize]);
        let offset = query - v;
        let w = weight(offset, n);
        sum.weight += w;
        sum.point += offset * w;
        sum.normal += n * w;
    }
    sum.point = query - sum.point / sum.weight;
    sum
}

#[inline(always)]
pub(crate) fn blend(vertices: &[Vec3], normals: &[Vec3], query: Vec3, finest: &[u32]) -> Blended {
    let s = sums(vertices, normals, query, finest);
    let normal = s.normal.normalize_or(normals[finest[0] as usize]);
    Blended { point: s.point, normal, signed_distance: (query - s.point).dot(normal) }
}

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
