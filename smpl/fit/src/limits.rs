//! Limits of joints, and derivatives of rotation vectors.

use glam::{DMat3, DQuat, DVec3};

/// Least and greatest components of a rotation vector, in radians.
pub(crate) type Range = [DVec3; 2];

/// Parents of SMPL's body joints, which SMPL-H and SMPL-X share.
const SMPL: [usize; 21] = [0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19];

/// Limits of SMPL's joints on the left and along the spine, generous; those of the right are mirrored.
/// Knees and elbows bend one way.
const LIMITS: [(usize, Range); 12] = [
    (1, [DVec3::new(-2.5, -1.2, -1.0), DVec3::new(1.2, 1.2, 1.4)]),
    (3, [DVec3::splat(-0.7), DVec3::splat(0.7)]),
    (4, [DVec3::new(-0.2, -0.7, -0.7), DVec3::new(2.8, 0.7, 0.7)]),
    (6, [DVec3::splat(-0.7), DVec3::splat(0.7)]),
    (7, [DVec3::splat(-1.0), DVec3::splat(1.0)]),
    (9, [DVec3::splat(-0.7), DVec3::splat(0.7)]),
    (10, [DVec3::splat(-0.8), DVec3::splat(0.8)]),
    (12, [DVec3::splat(-1.0), DVec3::splat(1.0)]),
    (13, [DVec3::splat(-0.8), DVec3::splat(0.8)]),
    (15, [DVec3::splat(-1.0), DVec3::splat(1.0)]),
    (18, [DVec3::new(-1.7, -2.8, -1.2), DVec3::new(1.7, 0.3, 1.2)]),
    (20, [DVec3::splat(-1.4), DVec3::splat(1.4)]),
];

/// Limit of joints without their own.
const FREE: f64 = 2.4;

/// The limits of every joint; none of the root.
pub(crate) fn ranges(parents: &[Option<usize>]) -> Vec<Range> {
    let free = [DVec3::splat(-FREE), DVec3::splat(FREE)];
    let mut ranges = vec![free; parents.len()];
    if parents.len() > SMPL.len() && parents[1..].iter().zip(SMPL).all(|(parent, smpl)| *parent == Some(smpl)) {
        for (joint, [low, high]) in LIMITS {
            ranges[joint] = [low, high];
            // Twins follow each other; joints of the spine have none.
            if ![3, 6, 9, 12, 15].contains(&joint) {
                let flip = DVec3::new(1.0, -1.0, -1.0);
                ranges[joint + 1] = [(low * flip).min(high * flip), (low * flip).max(high * flip)];
            }
        }
    }
    ranges[0] = [DVec3::NEG_INFINITY, DVec3::INFINITY];
    ranges
}

/// The rotation vector of at most half a turn.
pub(crate) fn log(turn: DQuat) -> DVec3 {
    (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis()
}

/// ∂ log(exp(v) exp(δ)) / ∂δ at δ = 0, the inverse right Jacobian of SO(3).
pub(crate) fn log_derivative(v: DVec3) -> DMat3 {
    let theta = v.length();
    let skew = DMat3::from_cols(v.cross(DVec3::X), v.cross(DVec3::Y), v.cross(DVec3::Z));
    let square = if theta < 1e-3 { 1.0 / 12.0 } else { (1.0 - 0.5 * theta / (0.5 * theta).tan()) / (theta * theta) };
    // [v]ₓ maps x to v × x: its columns are v × e_i.
    DMat3::IDENTITY + 0.5 * skew + square * (skew * skew)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivative_of_the_logarithm_agrees_with_differences() {
        for v in [DVec3::ZERO, DVec3::new(1e-4, 0.0, 2e-4), DVec3::new(0.4, -1.1, 0.3), DVec3::new(-2.0, 1.5, 1.0)] {
            let derivative = log_derivative(v);
            for axis in DVec3::AXES {
                let at = |h: f64| log(DQuat::from_scaled_axis(v) * DQuat::from_scaled_axis(h * axis));
                let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
                assert!((derivative * axis).distance(numeric) < 1e-8, "{v} {axis}: {numeric}");
            }
        }
    }

    #[test]
    fn limits_of_twins_are_mirrored_and_others_have_one_limit() {
        let body = smpl::BodyModel::embedded();
        let ranges = ranges(&body.parents);
        assert_eq!(ranges[19][1], DVec3::new(1.7, 2.8, 1.2));
        assert_eq!((ranges[5][0].x, ranges[5][1].x), (-0.2, 2.8));
        assert_eq!(super::ranges(&[None, Some(0)])[1][1], DVec3::splat(FREE));
    }
}
