//! Residuals of one frame, and their normal equations.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, DVector};

use crate::skeleton::{Shape, Skeleton, State, log, log_derivative};

/// Standard deviation of the prior of a joint's rotation, and of those of spine, neck and collars,
/// on which points are few, radians.
const PRIOR: f64 = 1.0;
const TRUNK: f64 = 0.6;
/// Joints of SMPL's feet.
const FEET: [usize; 4] = [7, 8, 10, 11];
/// Standard deviation beyond a limit, radians.
const LIMIT: f64 = 0.05;
/// Cauchy's scale, in standard deviations of a point: farther points lose their weight.
const ROBUST: f64 = 4.0;

/// Derivatives of a point: first columns, and (3, 3) blocks.
type Blocks = Vec<(usize, DMat3)>;

/// Gauss–Newton normal equations of a frame: n unknowns of pose and place, B betas.
pub(crate) struct Normal {
    /// (n, n) and (n).
    pub hessian: DMatrix<f64>,
    pub gradient: DVector<f64>,
    /// (n, B), (B, B) and (B).
    pub border: DMatrix<f64>,
    pub corner: DMatrix<f64>,
    pub corner_gradient: DVector<f64>,
}

impl Normal {
    pub fn zeros(unknowns: usize, betas: usize) -> Self {
        Self {
            hessian: DMatrix::zeros(unknowns, unknowns),
            gradient: DVector::zeros(unknowns),
            border: DMatrix::zeros(unknowns, betas),
            corner: DMatrix::zeros(betas, betas),
            corner_gradient: DVector::zeros(betas),
        }
    }
}

/// ½ Cauchy's loss of a squared residual in standard deviations, and the weight of its square.
fn robust(square: f64) -> (f64, f64) {
    let scale = ROBUST * ROBUST;
    (0.5 * scale * (square / scale).ln_1p(), 1.0 / (1.0 + square / scale))
}

/// Prior and limits of a joint: cost, and residuals with their derivatives by the rotation vector,
/// to call `add` with.
fn held(skeleton: &Skeleton, joint: usize, turn: DQuat, mut add: impl FnMut(DMat3, DVec3)) -> f64 {
    if skeleton.parents[joint].is_none() {
        return 0.0;
    }
    let v = log(turn);
    let [low, high] = skeleton.ranges[joint];
    let beyond = (v - v.clamp(low, high)) / LIMIT;
    let derivative = log_derivative(v);
    // Of SMPL's joints those of the feet and the trunk turn least.
    let is_trunk = high.max_element() <= 1.0 && !FEET.contains(&joint);
    let prior = if is_trunk { TRUNK } else { PRIOR };
    add(derivative * (1.0 / prior), v / prior);
    if beyond != DVec3::ZERO {
        let active = DVec3::select(beyond.cmpne(DVec3::ZERO), DVec3::ONE, DVec3::ZERO) / LIMIT;
        add(DMat3::from_diagonal(active) * derivative, beyond);
    }
    0.5 * (v.length_squared() / (prior * prior) + beyond.length_squared())
}

/// Cost of a frame: points (those that are not finite are missing), prior and limits.
pub(crate) fn cost(skeleton: &Skeleton, shape: &Shape, state: &State, seen: &[DVec3], noise: f64) -> f64 {
    let points = skeleton.points(shape, &skeleton.frames(shape, state));
    let off = points.iter().zip(seen).filter(|(_, seen)| seen.is_finite());
    let off: f64 = off.map(|(p, seen)| robust(p.distance_squared(*seen) / (noise * noise)).0).sum();
    let moving = (0..state.turns.len()).filter(|&j| skeleton.columns[j].is_some());
    off + moving.map(|j| held(skeleton, j, state.turns[j], |_, _| {})).sum::<f64>()
}

/// Every point, its derivatives by the unknowns and by the betas.
///
/// A joint's unknown δ turns it to L exp(δ): what it carries turns by R δ about its origin.
pub(crate) fn jacobian(
    skeleton: &Skeleton,
    shape: &Shape,
    state: &State,
    betas: usize,
) -> (Vec<DVec3>, Vec<Blocks>, Vec<Vec<DVec3>>) {
    let frames = skeleton.frames(shape, state);
    // ∂ origins / ∂ beta; the root's place is an unknown of its own.
    let origins = |shape: &Shape| {
        let mut moved = vec![DVec3::ZERO; skeleton.parents.len()];
        for (j, parent) in skeleton.parents.iter().enumerate() {
            if let Some(p) = parent {
                moved[j] = moved[*p] + frames.turns[*p] * shape.offsets[j];
            }
        }
        moved
    };
    let directions = &skeleton.directions[..betas];
    let moved: Vec<Vec<DVec3>> = directions.iter().map(origins).collect();
    let mut by_pose = Vec::with_capacity(shape.points.len());
    for parts in &shape.points {
        let mut blocks: Blocks = vec![(0, DMat3::IDENTITY)];
        for part in parts {
            let carried = frames.carried(part);
            for joint in skeleton.chain(part.bone) {
                let Some(column) = skeleton.columns[joint] else { continue };
                let lever = carried - part.share * frames.origins[joint];
                let turned = |axis: DVec3| axis.cross(lever);
                let turn = frames.turns[joint];
                let block = DMat3::from_cols(turned(turn.x_axis), turned(turn.y_axis), turned(turn.z_axis));
                match blocks.iter_mut().find(|(at, _)| *at == column) {
                    Some((_, sum)) => *sum += block,
                    None => blocks.push((column, block)),
                }
            }
        }
        by_pose.push(blocks);
    }
    let by_shape = (0..shape.points.len()).map(|i| {
        let of = |(direction, moved): (&Shape, &Vec<DVec3>)| {
            let parts = direction.points[i].iter();
            parts.map(|part| part.share * moved[part.bone] + frames.turns[part.bone] * part.arm).sum()
        };
        directions.iter().zip(&moved).map(of).collect()
    });
    let by_shape = by_shape.collect();
    (skeleton.points(shape, &frames), by_pose, by_shape)
}

/// The normal equations of [`cost`].
pub(crate) fn normal(
    skeleton: &Skeleton,
    shape: &Shape,
    state: &State,
    seen: &[DVec3],
    noise: f64,
    betas: usize,
) -> Normal {
    let mut out = Normal::zeros(skeleton.unknowns, betas);
    let (points, by_pose, by_shape) = jacobian(skeleton, shape, state, betas);
    for (i, point) in points.iter().enumerate().filter(|(i, _)| seen[*i].is_finite()) {
        let residual = *point - seen[i];
        let weight = robust(residual.length_squared() / (noise * noise)).1 / (noise * noise);
        for (a, block) in &by_pose[i] {
            let weighted = block.transpose() * weight;
            add(&mut out.gradient, *a, weighted * residual);
            for (b, other) in &by_pose[i] {
                add_block(&mut out.hessian, *a, *b, weighted * *other);
            }
            for (b, by) in by_shape[i].iter().enumerate() {
                let sum = weighted * *by;
                (0..3).for_each(|k| out.border[(a + k, b)] += sum[k]);
            }
        }
        for (a, by) in by_shape[i].iter().enumerate() {
            out.corner_gradient[a] += weight * by.dot(residual);
            by_shape[i].iter().enumerate().for_each(|(b, other)| out.corner[(a, b)] += weight * by.dot(*other));
        }
    }
    for (joint, column) in skeleton.columns.iter().enumerate() {
        let Some(column) = *column else { continue };
        held(skeleton, joint, state.turns[joint], |derivative, residual| {
            add(&mut out.gradient, column, derivative.transpose() * residual);
            add_block(&mut out.hessian, column, column, derivative.transpose() * derivative);
        });
    }
    out
}

pub(crate) fn add(to: &mut DVector<f64>, at: usize, v: DVec3) {
    (0..3).for_each(|k| to[at + k] += v[k]);
}

pub(crate) fn add_block(to: &mut DMatrix<f64>, row: usize, column: usize, block: DMat3) {
    for c in 0..3 {
        (0..3).for_each(|r| to[(row + r, column + c)] += block.col(c)[r]);
    }
}

/// The state after a step of the unknowns.
pub(crate) fn stepped(skeleton: &Skeleton, state: &State, step: &DVector<f64>) -> State {
    let vector = |at: usize| DVec3::new(step[at], step[at + 1], step[at + 2]);
    let mut next = State { place: state.place + vector(0), turns: state.turns.clone() };
    for (turn, column) in next.turns.iter_mut().zip(&skeleton.columns) {
        if let Some(column) = column {
            *turn = (*turn * DQuat::from_scaled_axis(vector(*column))).normalize();
        }
    }
    next
}

/// Motion of the unknowns from one state to another: the root's way, then rotations as log(L⁻¹ L').
pub(crate) fn between(skeleton: &Skeleton, from: &State, to: &State) -> DVector<f64> {
    let mut out = DVector::zeros(skeleton.unknowns);
    add(&mut out, 0, to.place - from.place);
    for (joint, column) in skeleton.columns.iter().enumerate() {
        if let Some(column) = column {
            add(&mut out, *column, log(from.turns[joint].conjugate() * to.turns[joint]));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;
    use smpl::{BodyModel, Placement, SparseRows};
    use testkit::strategy::vec3;

    use super::*;
    use crate::Anchor;

    fn anchors(body: &BodyModel) -> Vec<Anchor> {
        let blend = Anchor { joints: vec![(20, 0.5), (0, 0.2)], vertices: vec![(100, 0.1), (3000, 0.2)] };
        let set = crate::joint_set(body, "mhr70").unwrap().into_iter().flatten();
        (0..24).map(Anchor::joint).chain(set).chain([blend]).collect()
    }

    /// The same without blend shapes of the pose, which the solver leaves out.
    fn body() -> BodyModel {
        let body = BodyModel::embedded();
        let none = SparseRows::from_rows((0..body.num_vertices()).map(|_| None::<(u32, Vec3)>));
        BodyModel { posedirs: none, ..body }
    }

    fn state_of(pose: &[Vec3], place: Vec3) -> State {
        let turns = pose.iter().map(|v| DQuat::from_scaled_axis(v.as_dvec3())).collect();
        State { place: place.as_dvec3(), turns }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(8))]

        #[test]
        fn points_are_where_posing_puts_them_and_derivatives_agree_with_differences(
            pose in prop::collection::vec(vec3(0.9), 24),
            place in vec3(2.0),
            betas in prop::collection::vec(-2.0f32..2.0, 10),
        ) {
            let body = body();
            let anchors = anchors(&body);
            let skeleton = Skeleton::new(&body, &anchors, 10);
            let wide: Vec<f64> = betas.iter().map(|b| f64::from(*b)).collect();
            let shape = skeleton.shape(&wide);
            let state = state_of(&pose, place);
            let (points, by_pose, by_shape) = jacobian(&skeleton, &shape, &state, 10);

            let shaped = body.shaped(&betas);
            let placement = Placement::Pelvis { translation: place - shaped.joints[0] };
            let posed = body.pose(&shaped, &pose, placement);
            for (point, anchor) in points.iter().zip(&anchors) {
                let joints = anchor.joints.iter().map(|(j, w)| *w * posed.joints[*j]);
                let expected: Vec3 = joints.chain(anchor.vertices.iter().map(|(v, w)| *w * posed.vertices[*v])).sum();
                // f32 positions of a few metres.
                prop_assert!(point.distance(expected.as_dvec3()) < 2e-5, "{point} {expected}");
            }

            let h = 1e-6;
            let at = |state: &State, shape: &Shape| skeleton.points(shape, &skeleton.frames(shape, state));
            for unknown in 0..skeleton.unknowns {
                let mut step = DVector::zeros(skeleton.unknowns);
                step[unknown] = h;
                let (up, down) = (stepped(&skeleton, &state, &step), stepped(&skeleton, &state, &-step));
                let (up, down) = (at(&up, &shape), at(&down, &shape));
                for i in 0..points.len() {
                    let block = by_pose[i].iter().find(|(column, _)| *column == unknown - unknown % 3);
                    let found = block.map_or(DVec3::ZERO, |(_, block)| block.col(unknown % 3));
                    let numeric = (up[i] - down[i]) / (2.0 * h);
                    prop_assert!(found.distance(numeric) < 1e-8, "point {i}, unknown {unknown}: {found} {numeric}");
                }
            }
            for b in 0..10 {
                let moved = |by: f64| {
                    let betas: Vec<f64> = wide.iter().enumerate().map(|(i, x)| x + if i == b { by } else { 0.0 }).collect();
                    at(&state, &skeleton.shape(&betas))
                };
                let (up, down) = (moved(0.5), moved(-0.5));
                for i in 0..points.len() {
                    prop_assert!(by_shape[i][b].distance(up[i] - down[i]) < 1e-10, "point {i}, beta {b}");
                }
            }
        }

        #[test]
        fn the_gradient_of_the_cost_agrees_with_differences(
            pose in prop::collection::vec(vec3(1.8), 24),
            off in prop::collection::vec(vec3(0.1), 24),
        ) {
            let body = body();
            let skeleton = Skeleton::new(&body, &(0..24).map(Anchor::joint).collect::<Vec<_>>(), 2);
            let (state, shape) = (state_of(&pose, Vec3::ONE), skeleton.shape(&[0.4, -0.3]));
            let mut seen = skeleton.points(&shape, &skeleton.frames(&shape, &state));
            seen.iter_mut().zip(off).for_each(|(p, off)| *p += off.as_dvec3());
            seen[5] = DVec3::NAN;
            let found = normal(&skeleton, &shape, &state, &seen, 0.02, 2);
            let value = |state: &State, betas: [f64; 2]| cost(&skeleton, &skeleton.shape(&betas), state, &seen, 0.02);
            let h = 1e-6;
            let near = |analytic: f64, numeric: f64| (analytic - numeric).abs() < 1e-4 + 1e-5 * numeric.abs();
            for k in 0..skeleton.unknowns {
                let mut step = DVector::zeros(skeleton.unknowns);
                step[k] = h;
                let ends = [stepped(&skeleton, &state, &step), stepped(&skeleton, &state, &-step)];
                let [up, down] = ends.map(|state| value(&state, [0.4, -0.3]));
                let numeric = (up - down) / (2.0 * h);
                prop_assert!(near(found.gradient[k], numeric), "{k}: {} {numeric}", found.gradient[k]);
            }
            let numeric = (value(&state, [0.4, -0.3 + h]) - value(&state, [0.4, -0.3 - h])) / (2.0 * h);
            prop_assert!(near(found.corner_gradient[1], numeric), "{} {numeric}", found.corner_gradient[1]);
        }
    }
}
