use glam::{Mat2, Vec2};

/// Lens distortion in OpenCV's five-parameter model, on normalised image coordinates (x/z, y/z).
///
/// With r² = x² + y² and s = 1 + k1 r² + k2 r⁴ + k3 r⁶: x' = s x + 2 p1 x y + p2 (r² + 2 x²) and
/// y' = s y + p1 (r² + 2 y²) + 2 p2 x y (Brown 1966).
///
/// ```
/// use glam::Vec2;
/// use volrender::Distortion;
///
/// let barrel = Distortion::from_opencv([-0.1, 0.0, 0.0, 0.0, 0.0]);
/// let distorted = barrel.distort(Vec2::new(0.5, 0.0));
/// assert!((distorted.x - 0.4875).abs() < 1e-6); // 0.5 (1 − 0.1 · 0.25)
/// assert!(barrel.undistort(distorted).unwrap().distance(Vec2::new(0.5, 0.0)) < 1e-6);
/// assert!((barrel.fold_radius() - (1.0f32 / 0.3).sqrt()).abs() < 1e-6);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// Radial, r².
    pub k1: f32,
    /// Radial, r⁴.
    pub k2: f32,
    /// Tangential.
    pub p1: f32,
    /// Tangential.
    pub p2: f32,
    /// Radial, r⁶.
    pub k3: f32,
}

/// Largest number of Newton steps; photographic lenses need fewer than 10.
const MAX_STEPS: usize = 50;

impl Distortion {
    /// Coefficients in OpenCV's order (k1, k2, p1, p2, k3).
    pub fn from_opencv([k1, k2, p1, p2, k3]: [f32; 5]) -> Self {
        Self { k1, k2, p1, p2, k3 }
    }

    /// Whether all coefficients are 0.
    pub fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    /// Smallest undistorted radius at which r · (1 + k1 r² + k2 r⁴ + k3 r⁶) stops growing; infinite
    /// if it always grows. Beyond it the model is not invertible.
    pub fn fold_radius(&self) -> f32 {
        let [a, b, c] = [3.0 * f64::from(self.k1), 5.0 * f64::from(self.k2), 7.0 * f64::from(self.k3)];
        let slope = |u: f64| 1.0 + u * (a + u * (b + u * c));
        // Between its extrema the slope, a cubic in u = r², crosses zero at most once.
        let discriminant = (b * b - 3.0 * a * c).max(0.0).sqrt();
        let mut ends = if c == 0.0 {
            vec![-a / (2.0 * b)]
        } else {
            vec![(-b - discriminant) / (3.0 * c), (-b + discriminant) / (3.0 * c)]
        };
        ends.retain(|u| u.is_finite() && *u > 0.0);
        ends.sort_by(f64::total_cmp);
        ends.push(f64::from(f32::MAX).sqrt());
        let mut low = 0.0;
        for mut high in ends {
            if slope(high) <= 0.0 {
                while high - low > 1e-12 * high {
                    let middle = 0.5 * (low + high);
                    if middle <= low || middle >= high {
                        break;
                    }
                    if slope(middle) <= 0.0 { high = middle } else { low = middle }
                }
                return high.sqrt() as f32;
            }
            low = high;
        }
        f32::INFINITY
    }

    /// Undistorted to distorted coordinates.
    pub fn distort(&self, p: Vec2) -> Vec2 {
        self.distort_with_jacobian(p).0
    }

    /// Distorted to undistorted coordinates, by Newton's method from `p`.
    ///
    /// `None` if it does not converge. Beyond the [fold radius](Self::fold_radius) there may be no
    /// solution, or the one found lies on another branch.
    pub fn undistort(&self, p: Vec2) -> Option<Vec2> {
        if self.is_identity() {
            return Some(p);
        }
        let tolerance = 4.0 * f32::EPSILON * (1.0 + p.length());
        let mut q = p;
        for _ in 0..MAX_STEPS {
            let (distorted, jacobian) = self.distort_with_jacobian(q);
            let residual = distorted - p;
            if residual.length() <= tolerance {
                return Some(q);
            }
            if jacobian.determinant() == 0.0 {
                return None;
            }
            q -= jacobian.inverse() * residual;
            if !q.is_finite() {
                return None;
            }
        }
        None
    }

    fn distort_with_jacobian(&self, p: Vec2) -> (Vec2, Mat2) {
        let Self { k1, k2, p1, p2, k3 } = *self;
        let (x, y) = (p.x, p.y);
        let r2 = p.length_squared();
        let s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let ds_dr2 = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
        let distorted = Vec2::new(
            s * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            s * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let off_diagonal = 2.0 * (ds_dr2 * x * y + p1 * x + p2 * y);
        let jacobian = Mat2::from_cols(
            Vec2::new(s + 2.0 * ds_dr2 * x * x + 2.0 * p1 * y + 6.0 * p2 * x, off_diagonal),
            Vec2::new(off_diagonal, s + 2.0 * ds_dr2 * y * y + 6.0 * p1 * y + 2.0 * p2 * x),
        );
        (distorted, jacobian)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_distorted_radius_grows_exactly_up_to_the_fold_radius(
            k1 in prop_oneof![Just(0.0f32), -1.0f32..1.0],
            k2 in prop_oneof![Just(0.0f32), -1.0f32..1.0],
            k3 in prop_oneof![Just(0.0f32), -1.0f32..1.0],
        ) {
            let lens = Distortion { k1, k2, k3, ..Distortion::default() };
            let slope = |r: f64| {
                let u = r * r;
                1.0 + u * (3.0 * f64::from(k1) + u * (5.0 * f64::from(k2) + u * 7.0 * f64::from(k3)))
            };
            let fold = f64::from(lens.fold_radius());
            let end = fold.min(1e3);
            for i in 0..1000 {
                let r = end * f64::from(i) / 1000.0;
                // A double root of the slope is decided by rounding.
                prop_assert!(slope(r) > -1e-6 * (1.0 + r.powi(6)), "{r} of {fold}: {}", slope(r));
            }
            if fold.is_finite() {
                prop_assert!(slope(fold * 1.0001) < 1e-3, "{fold}: {}", slope(fold * 1.0001));
            }
        }
    }

    #[test]
    fn the_jacobian_equals_finite_differences() {
        let lens = Distortion::from_opencv([0.3, -0.2, 0.1, -0.15, 0.25]);
        for p in [Vec2::new(0.4, -0.3), Vec2::new(-0.6, 0.1), Vec2::ZERO] {
            let (_, jacobian) = lens.distort_with_jacobian(p);
            for (axis, column) in [(Vec2::X, jacobian.x_axis), (Vec2::Y, jacobian.y_axis)] {
                const STEP: f32 = 1e-2;
                let slope = (lens.distort(p + axis * STEP) - lens.distort(p - axis * STEP)) / (2.0 * STEP);
                // Rounding over the step, and step² / 6 times third derivatives of up to 6.
                assert!(slope.distance(column) < 2e-4, "{p}: {slope} {column}");
            }
        }
    }
}
