//! Axis-angle rotations.

use glam::{DMat3, Mat3, Vec3};

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

/// Propagates the gradient of [`rodrigues`] from R to the axis-angle vector, in closed form and
/// without cancellation at any angle.
///
/// With k the vector of the skew part of D, S = D + Dᵀ and R = I + a K + b (v vᵀ − θ² I):
/// ∂/∂v = a k + (a'/θ)(k·v) v + b (S v − 2 tr(D) v) + (b'/θ)(vᵀ D v − θ² tr(D)) v.
pub(crate) fn rodrigues_backward(axis_angle: Vec3, d_rotation: DMat3) -> Vec3 {
    let v = axis_angle.as_dvec3();
    let d = d_rotation;
    let square = v.length_squared();
    let theta = square.sqrt();
    // a, b, a'/θ and b'/θ; below 0.01 rad the series are exact to rounding, the quotients are not.
    let (a, b, da, db) = if theta < 1e-2 {
        (
            1.0 - square / 6.0 * (1.0 - square / 20.0),
            0.5 - square / 24.0 * (1.0 - square / 30.0),
            -1.0 / 3.0 + square / 30.0 * (1.0 - square / 28.0),
            -1.0 / 12.0 + square / 180.0 * (1.0 - square / 37.333_333_333_333_336),
        )
    } else {
        let a = theta.sin() / theta;
        let half = (0.5 * theta).sin() / theta;
        let b = 2.0 * half * half;
        (a, b, (theta.cos() - a) / square, (a - 2.0 * b) / square)
    };
    let k = glam::DVec3::new(d.y_axis.z - d.z_axis.y, d.z_axis.x - d.x_axis.z, d.x_axis.y - d.y_axis.x);
    let trace = d.x_axis.x + d.y_axis.y + d.z_axis.z;
    let dv = d * v;
    let symmetric = dv + d.transpose() * v;
    let out = a * k + da * k.dot(v) * v + b * (symmetric - 2.0 * trace * v) + db * (v.dot(dv) - square * trace) * v;
    out.as_vec3()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivative_agrees_with_differences_at_every_angle() {
        let d = DMat3::from_cols_array(&[0.3, -1.2, 0.7, 0.9, 0.4, -0.5, -0.8, 1.1, 0.2]);
        // R in f64, so that the differences are sharp; the entries are those of `rodrigues`.
        let value = |v: glam::DVec3| {
            let theta = v.length();
            let r = if theta == 0.0 { DMat3::IDENTITY } else { DMat3::from_axis_angle(v / theta, theta) };
            r.to_cols_array().iter().zip(d.to_cols_array()).map(|(r, d)| r * d).sum::<f64>()
        };
        let pi = std::f32::consts::PI;
        for direction in [Vec3::X, Vec3::new(0.6, 0.0, -0.8), Vec3::new(0.48, 0.6, 0.64)] {
            for angle in [0.0, 1e-20, 1e-6, 1e-3, 9.9e-3, 1.01e-2, 0.5, 2.0, pi - 1e-3, pi, pi + 1e-3, 5.0, 2.0 * pi] {
                let v = direction * angle;
                let analytic = rodrigues_backward(v, d);
                for axis in 0..3 {
                    let mut step = glam::DVec3::ZERO;
                    step[axis] = 1e-5;
                    let numeric = (value(v.as_dvec3() + step) - value(v.as_dvec3() - step)) / 2e-5;
                    let error = (f64::from(analytic[axis]) - numeric).abs();
                    assert!(error < 1e-6, "{angle} {axis}: {analytic} {numeric}");
                }
            }
        }
    }

    #[test]
    fn tiny_rotations_keep_their_first_order() {
        for length in [0.0, 1e-30, 1e-12, 1e-6, 1e-4, 2e-4] {
            let r = rodrigues(Vec3::new(0.0, 0.0, length));
            assert!((r.x_axis.y - length).abs() <= 1e-6 * length, "{length}: {r}");
        }
        assert_eq!(rodrigues(Vec3::ZERO), Mat3::IDENTITY);
    }

    #[test]
    fn quarter_turns_go_the_right_way() {
        let r = rodrigues(Vec3::Z * std::f32::consts::FRAC_PI_2);
        assert!((r * Vec3::X).distance(Vec3::Y) < 1e-6);
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
