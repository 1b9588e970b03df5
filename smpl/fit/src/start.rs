//! First guesses of a frame without a neighbour: Procrustes' problem of one joint after the other,
//! within limits.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

use crate::skeleton::{Shape, Skeleton, State, log};

/// Points of a frame from which a first guess is made.
pub(crate) const LEAST: usize = 4;
/// Standard deviation of points on a bone, metres.
const POINT: f64 = 0.03;
/// Least middle of a joint's limits that makes it a hinge, radians.
const HINGE: f64 = 0.9;
/// Squared distance of a guess from bent joints, over that from straight ones, below which it is
/// taken.
const BETTER: f64 = 0.5;
/// Rounds of all joints.
const SWEEPS: usize = 8;

/// A first guess for the points of a frame, at least [`LEAST`] of them finite. From straight elbows
/// and knees a sharp bend is found about another axis: then the guess begins with half bent ones.
pub(crate) fn start(skeleton: &Skeleton, shape: &Shape, seen: &[DVec3]) -> State {
    let square = |state: &State| {
        let points = skeleton.points(shape, &skeleton.frames(shape, state));
        points.iter().zip(seen).filter(|(_, s)| s.is_finite()).map(|(p, s)| p.distance_squared(*s)).sum::<f64>()
    };
    let straight = swept(skeleton, shape, seen, skeleton.rest());
    let mut bent = skeleton.rest();
    for (turn, [low, high]) in bent.turns.iter_mut().zip(&skeleton.ranges) {
        let middle = 0.5 * (*low + *high);
        if middle.is_finite() && middle.length() > HINGE {
            *turn = DQuat::from_scaled_axis(middle);
        }
    }
    let bent = swept(skeleton, shape, seen, bent);
    if square(&bent) < BETTER * square(&straight) { bent } else { straight }
}

/// A first guess from another.
fn swept(skeleton: &Skeleton, shape: &Shape, seen: &[DVec3], mut state: State) -> State {
    let rest = skeleton.frames(shape, &skeleton.rest());
    let points = skeleton.points(shape, &rest);
    // Of a rotation within its limits, an angle about one axis.
    let deviation = |joint: usize| (skeleton.ranges[joint][1] - skeleton.ranges[joint][0]).length() / 7.0;
    // Variance of a point's place on the body that the joints between `top` and it make.
    let spread = |i: usize, top: usize| {
        let reach = |joint: usize| deviation(joint) * points[i].distance(rest.origins[joint]);
        let of = |bone: usize| {
            skeleton.chain(bone).take_while(|j| *j != top && *j != 0).map(|j| reach(j).powi(2)).sum::<f64>()
        };
        shape.points[i].iter().map(|part| part.share.abs() * of(part.bone)).sum::<f64>() + POINT * POINT
    };
    let visible: Vec<usize> = (0..seen.len()).filter(|&i| seen[i].is_finite()).collect();
    let below =
        |i: usize, joint: usize| shape.points[i].iter().any(|part| skeleton.chain(part.bone).any(|j| j == joint));
    for sweep in 0..SWEEPS {
        for joint in (0..skeleton.parents.len()).filter(|&j| skeleton.columns[j].is_some()) {
            let frames = skeleton.frames(shape, &state);
            let now = skeleton.points(shape, &frames);
            // At first the joints below are anywhere, then about where they should be.
            let weight = |i: usize| POINT * POINT / if sweep == 0 { spread(i, joint) } else { POINT * POINT };
            let moved =
                visible.iter().filter(|&&i| joint == 0 || below(i, joint)).map(|&i| (weight(i), now[i], seen[i]));
            let moved: Vec<(f64, DVec3, DVec3)> = moved.collect();
            let total: f64 = moved.iter().map(|(w, ..)| w).sum();
            let mean = |at: fn(&(f64, DVec3, DVec3)) -> DVec3| moved.iter().map(|m| m.0 * at(m)).sum::<DVec3>() / total;
            let is_root = joint == 0;
            let [from, to] = if is_root { [mean(|m| m.1), mean(|m| m.2)] } else { [frames.origins[joint]; 2] };
            let rest = match skeleton.parents[joint] {
                Some(parent) => {
                    frames.turns[parent] * frames.turns[joint].transpose() * (POINT / deviation(joint)).powi(2)
                }
                None => DMat3::ZERO,
            };
            let turn = rotation(moved.iter().map(|(w, a, b)| (*w, *a - from, *b - to)), rest);
            if is_root {
                state.place = to + turn * (state.place - from);
            }
            let turn = frames.turns[joint].transpose() * turn * frames.turns[joint];
            let [low, high] = skeleton.ranges[joint];
            let turned = log((state.turns[joint] * DQuat::from_mat3(&turn)).normalize());
            state.turns[joint] = DQuat::from_scaled_axis(turned.clamp(low, high));
        }
    }
    state
}

/// The rotation that turns each first vector of weighted pairs best to the second, and its axes
/// best to those of `prior`, a rotation times its weight.
fn rotation(pairs: impl Iterator<Item = (f64, DVec3, DVec3)>, prior: DMat3) -> DMat3 {
    let mut sum = prior;
    for (weight, from, to) in pairs {
        let to = weight * to;
        sum += DMat3::from_cols(to * from.x, to * from.y, to * from.z);
    }
    let svd = Matrix3::from_column_slice(&sum.to_cols_array()).svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return DMat3::IDENTITY };
    // Singular values descend: the last axis is the one that a reflection costs least.
    let turn = u * Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, (u * v_t).determinant().signum())) * v_t;
    DMat3::from_cols_slice(turn.as_slice())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rotation_between_vectors_is_found_and_a_single_one_turns_the_shortest_way() {
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(1.0, -2.0, 0.5)));
        let vectors = [DVec3::X, DVec3::new(0.3, 1.0, 0.2), DVec3::new(-0.4, 0.1, 0.9)];
        let found = rotation(vectors.iter().map(|v| (0.5, *v, turn * *v)), DMat3::ZERO);
        assert!((found - turn).to_cols_array().iter().all(|x| x.abs() < 1e-12));
        let quarter = rotation([(1.0, DVec3::X, DVec3::Y)].into_iter(), DMat3::IDENTITY * 1e-9);
        assert!((quarter * DVec3::Z).distance(DVec3::Z) < 1e-6 && (quarter * DVec3::X).distance(DVec3::Y) < 1e-6);
    }
}
