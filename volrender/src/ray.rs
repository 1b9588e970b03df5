use glam::Vec3;

/// A ray x(t) = origin + t · direction.
///
/// ```
/// use glam::Vec3;
///
/// let ray = volrender::Ray { origin: Vec3::X, direction: Vec3::Z };
/// assert_eq!(ray.at(2.0), Vec3::new(1.0, 0.0, 2.0));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// The point at t = 0.
    pub origin: Vec3,
    /// Unit length.
    pub direction: Vec3,
}

impl Ray {
    /// The point at distance `t`.
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }
}

/// An axis-aligned bounding box; empty if `min` exceeds `max` on an axis.
///
/// ```
/// use glam::Vec3;
/// use volrender::{Aabb, Ray};
///
/// let bounds = Aabb::from_points(&[Vec3::ZERO, Vec3::ONE]);
/// let ray = Ray { origin: Vec3::new(0.5, 0.5, -2.0), direction: Vec3::Z };
/// assert_eq!(bounds.intersect(&ray), Some((2.0, 3.0)));
/// assert_eq!(Aabb::EMPTY.intersect(&ray), None);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    /// Lowest corner.
    pub min: Vec3,
    /// Highest corner.
    pub max: Vec3,
}

impl Aabb {
    /// The box without any point.
    pub const EMPTY: Self = Self { min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };

    /// The bounding box of `points`, ignoring those that are not finite; [`Aabb::EMPTY`] without
    /// any.
    pub fn from_points(points: &[Vec3]) -> Self {
        points
            .iter()
            .filter(|p| p.is_finite())
            .fold(Self::EMPTY, |bounds, &p| Self { min: bounds.min.min(p), max: bounds.max.max(p) })
    }

    /// Whether the box contains no point.
    pub fn is_empty(&self) -> bool {
        !self.min.cmple(self.max).all()
    }

    /// The range of t ≥ 0 for which the ray is in the box, as (near, far) with near < far.
    ///
    /// `None` if the ray misses or touches in a single point, if the direction is zero, the box
    /// empty, or anything NaN or infinite. Directions parallel to a face are handled exactly.
    pub fn intersect(&self, ray: &Ray) -> Option<(f32, f32)> {
        if self.is_empty() || !ray.origin.is_finite() || !ray.direction.is_finite() {
            return None;
        }
        let (mut near, mut far) = (0.0f32, f32::INFINITY);
        for axis in 0..3 {
            let (o, d) = (ray.origin[axis], ray.direction[axis]);
            let (min, max) = (self.min[axis], self.max[axis]);
            if d == 0.0 {
                if o < min || o > max {
                    return None;
                }
                continue;
            }
            let (a, b) = ((min - o) / d, (max - o) / d);
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        (near < far && far.is_finite()).then_some((near, far))
    }
}
