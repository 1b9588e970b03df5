//! Axis-angle rotations.

use glam::{Mat3, Vec3};

/// Rotation matrix of the axis-angle vector `axis_angle` (direction: axis; length: radians), by
/// Rodrigues' formula R = I + a·K + b·K² with a = sin θ/θ and b = (1 − cos θ)/θ².
///
/// Both coefficients are evaluated without cancellation: exact to rounding at every angle, zero
/// included. A vector that is not finite gives a matrix of NaN.
///
/// ```
/// use glam::Vec3;
///
/// let quarter = smpl::rodrigues(Vec3::Z * std::f32::consts::FRAC_PI_2);
/// assert!((quarter * Vec3::X).distance(Vec3::Y) < 1e-6);
/// ```
pub fn rodrigues(axis_angle: Vec3) -> Mat3 {
    // f64, because a product of a dozen of these is held against references in f64.
    let v = axis_angle.as_dvec3();
    let theta = v.length();
    let sinc = |x: f64| {
        if x < 1e-4 { 1.0 - x * x / 6.0 } else { x.sin() / x }
    };
    let a = sinc(theta);
    // (1 − cos θ)/θ² = ½ sinc²(θ/2)
    let b = 0.5 * sinc(0.5 * theta).powi(2);
    let (x, y, z) = (v.x, v.y, v.z);
    let columns = [
        [1.0 - b * (y * y + z * z), b * x * y + a * z, b * x * z - a * y],
        [b * x * y - a * z, 1.0 - b * (x * x + z * z), b * y * z + a * x],
        [b * x * z + a * y, b * y * z - a * x, 1.0 - b * (x * x + y * y)],
    ];
    Mat3::from_cols_array_2d(&columns.map(|c| c.map(|x| x as f32)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiny_rotations_keep_their_first_order() {
        for length in [0.0, 1e-30, 1e-12, 1e-6, 1e-4, 2e-4] {
            let r = rodrigues(Vec3::new(0.0, 0.0, length));
            assert!((r.x_axis.y - length).abs() <= 1e-6 * length, "{length}: {r}");
        }
        assert_eq!(rodrigues(Vec3::ZERO), Mat3::IDENTITY);
    }

    #[test]
    fn rotations_are_orthonormal() {
        for i in 0..50 {
            let t = i as f32;
            let v = Vec3::new((t * 1.3).sin(), (t * 0.7).cos(), (t * 2.1).sin()) * t * 0.3;
            let r = rodrigues(v);
            let error = (r * r.transpose() - Mat3::IDENTITY).to_cols_array();
            assert!(error.iter().all(|e| e.abs() < 1e-6), "{v}: {error:?}");
            assert!((r.determinant() - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn values_that_are_not_finite_do_not_pass_as_rotations() {
        assert!(rodrigues(Vec3::new(f32::NAN, 0.0, 0.0)).is_nan());
        assert!(rodrigues(Vec3::new(0.0, f32::INFINITY, 0.0)).is_nan());
    }
}
