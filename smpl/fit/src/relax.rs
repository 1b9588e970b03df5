//! Levenberg–Marquardt over the frames of a window.

use glam::DVec3;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::band::{Band, Beside};
use crate::frame::{Normal, between, cost, normal, stepped};
use crate::skeleton::{Skeleton, State};

/// Standard deviations of what smoothness penalises: first and second differences of rotations, in
/// radians a frame, and of the root's place, in metres a frame.
const TURNS: [f64; 2] = [0.4, 0.04];
const PLACES: [f64; 2] = [0.2, 0.005];
/// Steps at most, and the relative gain of the cost below which they end.
const STEPS: usize = 30;
const GAIN: f64 = 1e-4;

/// What is minimised.
#[derive(Clone, Copy)]
pub(crate) struct Problem<'a> {
    pub skeleton: &'a Skeleton,
    /// Points of each frame, not finite where they are missing.
    pub seen: &'a [Vec<DVec3>],
    /// Standard deviation of a point, metres.
    pub noise: f64,
    /// Whether frames follow each other.
    pub smooth: bool,
}

/// Moves states, and betas if `shaped`, to a minimum near by; its cost.
pub(crate) fn relax(problem: Problem<'_>, states: &mut Vec<State>, betas: &mut Vec<f64>, shaped: bool) -> f64 {
    let Problem { skeleton, seen, noise, smooth } = problem;
    let count = if shaped { betas.len() } else { 0 };
    let mut damping = 1e-3;
    let mut now = total(problem, states, betas);
    for _ in 0..STEPS {
        let shape = skeleton.shape(betas);
        let of = |(state, seen): (&State, &Vec<DVec3>)| normal(skeleton, &shape, state, seen, noise, count);
        let mut normals: Vec<Normal> = states.par_iter().zip(seen).map(of).collect();
        let beside = (smooth && states.len() > 1).then(|| smoothed(skeleton, states, &mut normals));
        let mut better = false;
        for _ in 0..8 {
            if let Some((steps, by_betas)) = step(&normals, beside.as_ref(), betas, damping) {
                let next: Vec<State> = states.iter().zip(&steps).map(|(s, d)| stepped(skeleton, s, d)).collect();
                let moved: Vec<f64> =
                    betas.iter().enumerate().map(|(b, x)| x + by_betas.get(b).unwrap_or(&0.0)).collect();
                let after = total(problem, &next, &moved);
                if after < now {
                    better = after < (1.0 - GAIN) * now;
                    (*states, *betas, now) = (next, moved, after);
                    damping = (0.2 * damping).max(1e-5);
                    break;
                }
            }
            damping *= 10.0;
        }
        if !better {
            break;
        }
    }
    now
}

/// The cost of all frames, betas with a standard deviation of 1.
fn total(problem: Problem<'_>, states: &[State], betas: &[f64]) -> f64 {
    let Problem { skeleton, seen, noise, smooth } = problem;
    let shape = skeleton.shape(betas);
    let frames: Vec<f64> = states.par_iter().zip(seen).map(|(s, p)| cost(skeleton, &shape, s, p, noise)).collect();
    let mut sum = frames.iter().sum::<f64>() + 0.5 * betas.iter().map(|b| b * b).sum::<f64>();
    if smooth {
        let motion = differences(skeleton, states);
        let weights = stiffness(skeleton);
        let square = |v: &DVector<f64>, k: &DVector<f64>| v.component_mul(v).dot(k);
        sum += 0.5 * motion.iter().map(|v| square(v, &weights[0])).sum::<f64>();
        sum += 0.5 * motion.windows(2).map(|v| square(&(&v[1] - &v[0]), &weights[1])).sum::<f64>();
    }
    sum
}

/// Inverse variances of first and of second differences of every unknown.
fn stiffness(skeleton: &Skeleton) -> [DVector<f64>; 2] {
    [0, 1].map(|k| {
        let deviation = |i: usize| if i < 3 { PLACES[k] } else { TURNS[k] };
        DVector::from_fn(skeleton.unknowns, |i, _| deviation(i).powi(-2))
    })
}

/// Motion of the unknowns from each frame to the next.
fn differences(skeleton: &Skeleton, states: &[State]) -> Vec<DVector<f64>> {
    states.windows(2).map(|pair| between(skeleton, &pair[0], &pair[1])).collect()
}

/// Adds smoothness to the normal equations and returns their blocks beside the diagonal. The
/// derivative of a difference of rotations is taken as ±1: between frames of a video joints turn
/// little.
fn smoothed(skeleton: &Skeleton, states: &[State], normals: &mut [Normal]) -> Beside {
    let motion = differences(skeleton, states);
    let weights = stiffness(skeleton);
    let mut beside = Beside::zeros(skeleton.unknowns, states.len());
    for (f, v) in motion.iter().enumerate() {
        couple(&mut normals[f..], &mut beside, f, &[-1.0, 1.0], v, &weights[0]);
    }
    for (f, v) in motion.windows(2).enumerate() {
        couple(&mut normals[f..], &mut beside, f, &[1.0, -2.0, 1.0], &(&v[1] - &v[0]), &weights[1]);
    }
    beside
}

/// Adds residuals that are linear in the unknowns of consecutive frames, the first of them `start`:
/// coefficients, values and inverse variances; `normals` from that frame on.
pub(crate) fn couple(
    normals: &mut [Normal],
    beside: &mut Beside,
    start: usize,
    row: &[f64],
    value: &DVector<f64>,
    weight: &DVector<f64>,
) {
    for ((i, a), normal) in row.iter().enumerate().zip(normals) {
        normal.gradient += *a * weight.component_mul(value);
        for k in 0..weight.len() {
            normal.hessian[(k, k)] += a * a * weight[k];
        }
        for (j, b) in row[..i].iter().enumerate() {
            let block = if i - j == 1 { &mut beside.first } else { &mut beside.second };
            block[start + i] += a * b * weight;
        }
    }
}

/// The damped step of every frame and of the betas; `None` where the system is not definite.
fn step(
    normals: &[Normal],
    beside: Option<&Beside>,
    betas: &[f64],
    damping: f64,
) -> Option<(Vec<DVector<f64>>, Vec<f64>)> {
    let damped = |normal: &Normal| {
        let mut hessian = normal.hessian.clone();
        (0..hessian.nrows()).for_each(|k| hessian[(k, k)] += damping * (hessian[(k, k)] + 1.0));
        hessian
    };
    let band = Band::factor(normals.iter().map(damped).collect(), beside.cloned())?;
    let count = normals.first()?.border.ncols();
    let side = |normal: &Normal| {
        let mut side = normal.border.clone().insert_column(0, 0.0);
        side.set_column(0, &normal.gradient);
        side
    };
    let mut sides: Vec<DMatrix<f64>> = normals.iter().map(side).collect();
    band.solve(&mut sides);
    // Schur's complement of the frames.
    let mut corner = DMatrix::from_diagonal_element(count, count, 1.0 + damping);
    let mut gradient = DVector::from_column_slice(&betas[..count]);
    for (normal, side) in normals.iter().zip(&sides) {
        corner += &normal.corner - normal.border.tr_mul(&side.columns(1, count));
        gradient += &normal.corner_gradient - normal.border.tr_mul(&side.column(0));
    }
    let by_betas = -corner.cholesky()?.solve(&gradient);
    let frame = |side: &DMatrix<f64>| -side.column(0) - side.columns(1, count) * &by_betas;
    Some((sides.iter().map(frame).collect(), by_betas.iter().copied().collect()))
}
