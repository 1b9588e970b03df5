//! Distance from a point to triangles: four at a time in `f32` for the search, one in `f64` for the
//! result.

use glam::{DVec3, Vec3, Vec4};

use crate::tree::LANES;

/// Four triangles in SIMD lanes: corner a and the edges from it.
#[derive(Clone, Copy)]
pub(crate) struct Pack {
    a: [Vec4; 3],
    ab: [Vec4; 3],
    ac: [Vec4; 3],
}

#[inline(always)]
fn dot(u: [Vec4; 3], v: [Vec4; 3]) -> Vec4 {
    u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
}

/// |p − s·ab − t·ac|², by way of the residual vector: no cancellation at small distances.
#[inline(always)]
fn residual(p: [Vec4; 3], ab: [Vec4; 3], ac: [Vec4; 3], s: Vec4, t: Vec4) -> Vec4 {
    let r = [0, 1, 2].map(|i| p[i] - s * ab[i] - t * ac[i]);
    dot(r, r)
}

/// x / y clamped to [0, 1]; 0 where y is 0.
#[inline(always)]
fn unit_ratio(x: Vec4, y: Vec4) -> Vec4 {
    // y is never negative; x / MIN_POSITIVE clamps to the end of the sign of x.
    (x / y.max(Vec4::splat(f32::MIN_POSITIVE))).clamp(Vec4::ZERO, Vec4::ONE)
}

impl Pack {
    pub fn new(mut triangles: [[Vec3; 3]; LANES]) -> Self {
        for triangle in &mut triangles {
            if triangle.iter().any(|v| !v.is_finite()) {
                *triangle = [Vec3::NAN; 3];
            }
        }
        let lanes = |f: &dyn Fn(&[Vec3; 3]) -> Vec3| {
            let v = [0, 1, 2, 3].map(|lane: usize| f(&triangles[lane]));
            [0, 1, 2].map(|axis| Vec4::from(v.map(|v| v[axis])))
        };
        Self { a: lanes(&|t| t[0]), ab: lanes(&|t| t[1] - t[0]), ac: lanes(&|t| t[2] - t[0]) }
    }

    /// Squared distance of `q` to each triangle.
    ///
    /// The least of the distances to the three edges and, where it falls inside, to the foot of the
    /// perpendicular. Each is the distance to a real point of the triangle, so a sliver whose foot
    /// is badly conditioned is never reported too close, and its edges bound the error by its
    /// width. A lane with a corner that is not finite gives NaN; comparisons with it are false.
    #[inline(always)]
    pub fn distance_squared(&self, q: [Vec4; 3]) -> Vec4 {
        let (ab, ac) = (self.ab, self.ac);
        let ap = [0, 1, 2].map(|i| q[i] - self.a[i]);
        let (d1, d2) = (dot(ab, ap), dot(ac, ap));
        let (bb, bc, cc) = (dot(ab, ab), dot(ab, ac), dot(ac, ac));

        let t = unit_ratio(d1, bb);
        let on_ab = residual(ap, ab, ac, t, Vec4::ZERO);
        let t = unit_ratio(d2, cc);
        let on_ac = residual(ap, ab, ac, Vec4::ZERO, t);
        // Along b→c: (ap − ab)·(ac − ab) / |ac − ab|².
        let t = unit_ratio(d2 - d1 + bb - bc, bb - bc - bc + cc);
        let on_bc = residual(ap, ab, ac, Vec4::ONE - t, t);

        let determinant = bb * cc - bc * bc;
        let (s, t) = (d1 * cc - d2 * bc, d2 * bb - d1 * bc);
        let inside =
            s.cmpge(Vec4::ZERO) & t.cmpge(Vec4::ZERO) & (s + t).cmple(determinant) & determinant.cmpgt(Vec4::ZERO);
        let inverse = 1.0 / determinant;
        let foot = residual(ap, ab, ac, s * inverse, t * inverse);
        let edges = on_ab.min(on_ac).min(on_bc);
        Vec4::select(inside & foot.cmplt(edges), foot, edges)
    }
}

/// The face, edge or vertex that holds a closest point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Feature {
    Face,
    /// Edge from corner i to corner i+1.
    Edge(usize),
    Vertex(usize),
}

/// The closest point of one triangle.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Foot {
    pub distance_squared: f64,
    pub barycentric: [f64; 3],
    pub feature: Feature,
    /// Vector from the closest point to the query.
    pub offset: DVec3,
}

/// Squared sine of the angle at the first corner below which a triangle counts as a sliver.
const WELL_SHAPED: f64 = 1e-4;

/// Closest point of the triangle to `q`, in `f64`; the same case distinction as
/// [`Pack::distance_squared`].
pub(crate) fn closest_on_triangle(corners: [DVec3; 3], q: DVec3) -> Foot {
    let foot = |barycentric: [f64; 3], feature| {
        // Relative to the nearest corner in weight: no cancellation against the origin's distance.
        let offset = (0..3).fold(DVec3::ZERO, |sum, i| sum + (q - corners[i]) * barycentric[i]);
        Foot { distance_squared: offset.length_squared(), barycentric, feature, offset }
    };
    let mut best: Option<Foot> = None;
    let [a, b, c] = corners;
    let (ab, ac, ap) = (b - a, c - a, q - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    let (bb, bc, cc) = (ab.length_squared(), ab.dot(ac), ac.length_squared());
    let determinant = bb * cc - bc * bc;
    let (v, w) = ((d1 * cc - d2 * bc) / determinant, (d2 * bb - d1 * bc) / determinant);
    if determinant > 0.0 && v > 0.0 && w > 0.0 && v + w < 1.0 {
        let inside = foot([1.0 - v - w, v, w], Feature::Face);
        if determinant > WELL_SHAPED * bb * cc {
            // Well conditioned: no edge is nearer.
            return inside;
        }
        best = Some(inside);
    }
    for i in 0..3 {
        let j = (i + 1) % 3;
        let along = corners[j] - corners[i];
        let length_squared = along.length_squared();
        let t = if length_squared > 0.0 { (q - corners[i]).dot(along) / length_squared } else { 0.0 };
        let mut barycentric = [0.0; 3];
        let t = t.clamp(0.0, 1.0);
        barycentric[i] = 1.0 - t;
        barycentric[j] = t;
        let feature = if t == 0.0 {
            Feature::Vertex(i)
        } else if t == 1.0 {
            Feature::Vertex(j)
        } else {
            Feature::Edge(i)
        };
        let found = foot(barycentric, feature);
        if best.is_none_or(|b| found.distance_squared < b.distance_squared) {
            best = Some(found);
        }
    }
    best.unwrap_or(Foot {
        distance_squared: f64::NAN,
        barycentric: [1.0, 0.0, 0.0],
        feature: Feature::Vertex(0),
        offset: DVec3::NAN,
    })
}
