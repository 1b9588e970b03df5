//! Watertight intersection of a ray with four triangles (Woop, Benthin and Wald 2013): a ray
//! through an edge shared by two triangles hits at least one of them.

use glam::{Vec3, Vec3A, Vec4};
use obvhs::aabb::Aabb;

/// Triangles of a leaf: the lanes of a `Vec4`.
pub(crate) const LANES: usize = 4;
/// Factors that widen the interval of a ray in a box.
const NEARER: f32 = 1.0 - 1e-6;
const FARTHER: f32 = 1.0 + 1e-6;

/// Four triangles in SIMD lanes: corners a, b, c by axis.
#[derive(Clone, Copy)]
pub(crate) struct Triangles {
    corners: [[Vec4; 3]; 3],
}

/// A ray with the shear that makes it the z axis, `axes[2]` being its longest axis.
pub(crate) struct Ray {
    origin: Vec3A,
    inverse: Vec3A,
    axes: [usize; 3],
    shear: [Vec4; 3],
}

impl Ray {
    /// `direction` has its largest component, by magnitude, in [1, 2).
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        let z = direction.abs().max_position();
        let (x, y) = ((z + 1) % 3, (z + 2) % 3);
        // Finite in place of 1/0: no 0 · ∞ for an origin on the side of a box.
        let inverse = direction.to_array().map(|d| 1.0 / if d.abs() < 1e-30 { 1e-30f32.copysign(d) } else { d });
        Self {
            origin: origin.into(),
            inverse: inverse.into(),
            axes: [x, y, z],
            shear: [
                Vec4::splat(direction[x] / direction[z]),
                Vec4::splat(direction[y] / direction[z]),
                Vec4::splat(1.0 / direction[z]),
            ],
        }
    }

    /// Depth at which the ray enters a box, at least 0; infinity for a miss or beyond `end`.
    /// Conservative: both ends of the interval are widened by more than the rounding error.
    #[inline(always)]
    pub fn enters(&self, bounds: &Aabb, end: f32) -> f32 {
        let (a, b) = ((bounds.min - self.origin) * self.inverse, (bounds.max - self.origin) * self.inverse);
        let enter = a.min(b).max_element().max(0.0) * NEARER;
        let leave = a.max(b).min_element().min(end) * FARTHER;
        if enter <= leave { enter } else { f32::INFINITY }
    }
}

/// Hits of four triangles: depth (infinite for a miss) and weights of the corners.
pub(crate) struct Hits {
    pub t: Vec4,
    pub barycentric: [Vec4; 3],
}

impl Triangles {
    pub fn new(triangles: [[Vec3; 3]; LANES]) -> Self {
        Self {
            corners: [0, 1, 2].map(|corner| {
                [0, 1, 2].map(|axis| Vec4::from([0, 1, 2, 3].map(|lane: usize| triangles[lane][corner][axis])))
            }),
        }
    }

    /// Intersects both sides at depths of at least 0.
    #[inline(always)]
    pub fn intersect(&self, ray: &Ray) -> Hits {
        let [kx, ky, kz] = ray.axes;
        let [sx, sy, sz] = ray.shear;
        // Corners relative to the origin, sheared: the ray becomes the z axis.
        let [a, b, c] = [0, 1, 2].map(|i| {
            let corner = &self.corners[i];
            let z = corner[kz] - ray.origin[kz];
            let x = corner[kx] - ray.origin[kx] - sx * z;
            let y = corner[ky] - ray.origin[ky] - sy * z;
            [x, y, sz * z]
        });
        let mut u = c[0] * b[1] - c[1] * b[0];
        let mut v = a[0] * c[1] - a[1] * c[0];
        let mut w = b[0] * a[1] - b[1] * a[0];
        let zero = Vec4::ZERO;
        if (u.cmpeq(zero) | v.cmpeq(zero) | w.cmpeq(zero)).any() {
            // Products of two f32 are exact in f64: the sign of an edge function is right, and the
            // same for both triangles of the edge.
            u = exact(u, c, b);
            v = exact(v, a, c);
            w = exact(w, b, a);
        }
        let positive = u.cmpge(zero) & v.cmpge(zero) & w.cmpge(zero);
        let negative = u.cmple(zero) & v.cmple(zero) & w.cmple(zero);
        let determinant = u + v + w;
        let inverse = 1.0 / determinant;
        let barycentric = [u, v, w].map(|x| x * inverse);
        let t = barycentric[0] * a[2] + barycentric[1] * b[2] + barycentric[2] * c[2];
        let hit = (positive | negative) & determinant.cmpne(zero) & t.cmpge(zero);
        Hits { t: Vec4::select(hit, t, Vec4::INFINITY), barycentric }
    }
}

#[cold]
fn exact(rounded: Vec4, p: [Vec4; 3], q: [Vec4; 3]) -> Vec4 {
    let lane = |i: usize| {
        if rounded[i] != 0.0 {
            return rounded[i];
        }
        let [px, py, qx, qy] = [p[0][i], p[1][i], q[0][i], q[1][i]].map(f64::from);
        (px * qy - py * qx) as f32
    };
    Vec4::new(lane(0), lane(1), lane(2), lane(3))
}
