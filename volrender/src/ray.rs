use glam::Vec3;

/// A half-line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// The point at t = 0.
    pub origin: Vec3,
    /// Unit length.
    pub direction: Vec3,
}

impl Ray {
    /// The point at distance `t`.
    #[must_use]
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }
}

/// An axis-aligned box. Empty where `min` exceeds `max` on an axis.
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

    /// The smallest box around `points`. Points that are not finite do not count; without any point
    /// it is [`Aabb::EMPTY`].
    #[must_use]
    pub fn from_points(points: &[Vec3]) -> Self {
        points
            .iter()
            .filter(|p| p.is_finite())
            .fold(Self::EMPTY, |bounds, &p| Self { min: bounds.min.min(p), max: bounds.max.max(p) })
    }

    /// The box with every face moved outwards by `margin`. A negative margin shrinks it, an empty
    /// box stays empty.
    #[must_use]
    pub fn inflated(&self, margin: f32) -> Self {
        if self.is_empty() {
            return Self::EMPTY;
        }
        Self { min: self.min - margin, max: self.max + margin }
    }

    /// Whether no point lies in the box.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        !self.min.cmple(self.max).all()
    }

    /// Whether `point` lies in the box or on its faces.
    #[must_use]
    pub fn contains(&self, point: Vec3) -> bool {
        self.min.cmple(point).all() && point.cmple(self.max).all()
    }

    /// The range of t ≥ 0 for which the ray is in the box, as (near, far) with near < far.
    ///
    /// `None` where the ray misses, where it touches in a single point (a flat box seen from its
    /// side is touched by no ray for longer), where the direction is zero, the box empty, or
    /// anything is NaN or infinite.
    ///
    /// A direction parallel to a face is handled exactly: such an axis either excludes the ray or
    /// does not bound it.
    #[must_use]
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
