use glam::{Mat2, Vec2};

/// Lens distortion in OpenCV's five-parameter model, on normalised image coordinates (x/z, y/z).
///
/// With r² = x² + y² and s = 1 + k1 r² + k2 r⁴ + k3 r⁶: x' = s x + 2 p1 x y + p2 (r² + 2 x²) and
/// y' = s y + p1 (r² + 2 y²) + 2 p2 x y (Brown 1966).
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

/// Newton steps before giving up; a lens anybody sells needs fewer than 10.
const MAX_STEPS: usize = 50;

impl Distortion {
    /// From OpenCV's order (k1, k2, p1, p2, k3).
    #[must_use]
    pub fn from_opencv([k1, k2, p1, p2, k3]: [f32; 5]) -> Self {
        Self { k1, k2, p1, p2, k3 }
    }

    /// Whether the lens is perfect.
    #[must_use]
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Ideal to distorted coordinates.
    #[must_use]
    pub fn distort(&self, p: Vec2) -> Vec2 {
        self.distort_with_jacobian(p).0
    }

    /// Distorted to ideal coordinates, by Newton's method from `p`.
    ///
    /// `None` where it does not converge: beyond the radius where the model folds back nothing maps to `p`, and
    /// the point it finds may then lie on another branch of the fold.
    #[must_use]
    pub fn undistort(&self, p: Vec2) -> Option<Vec2> {
        if self.is_none() {
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
    use super::*;

    #[test]
    fn the_jacobian_is_the_slope_of_distort() {
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
