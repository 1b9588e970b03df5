//! Least squares over all frames: each frame has unknowns of its own, tied to those of the next
//! frame, and all frames share some.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// The normal equations of one frame: its own unknowns (P) and the shared ones (B).
#[derive(Clone, Debug)]
pub(super) struct Normal {
    pub own: usize,
    /// Σ w JᵀJ, (P + B)², lower triangle.
    pub matrix: DMatrix<f64>,
    /// Σ w Jᵀr, (P + B).
    pub vector: DVector<f64>,
}

impl Normal {
    pub fn new(own: usize, shared: usize) -> Self {
        Self { own, matrix: DMatrix::zeros(own + shared, own + shared), vector: DVector::zeros(own + shared) }
    }

    /// Adds a residual with the derivatives `row` of the unknowns `columns`.
    pub fn add(&mut self, weight: f64, residual: f64, columns: &[u32], row: &[f64]) {
        for (&i, &a) in columns.iter().zip(row) {
            let (i, a) = (i as usize, weight * a);
            self.vector[i] += a * residual;
            let mut column = self.matrix.column_mut(i);
            for (&j, &b) in columns.iter().zip(row) {
                column[j as usize] += a * b;
            }
        }
    }
}

/// What unknowns are expected to be before anything is seen: those of the frames wander about 0 (a
/// stationary Ornstein-Uhlenbeck process).
pub(super) struct Expected<'a> {
    /// Variance of each unknown of a frame, (P).
    pub own: &'a [f64],
    /// Correlation of each unknown with the same of the next frame, 0 to below 1, (P).
    pub kept: &'a [f64],
    /// Inverse variance of each shared unknown, (B).
    pub shared: &'a [f64],
}

/// Steps towards the least squares.
pub(super) struct Solution {
    /// For the unknowns of each frame, (P).
    pub own: Vec<DVector<f64>>,
    /// For the shared unknowns, (B).
    pub shared: DVector<f64>,
    /// Variance of each frame's unknowns, were the shared ones known, (P).
    pub variances: Vec<DVector<f64>>,
}

/// The steps that take all unknowns to the least squares: for each frame (P), and the shared (B).
/// `own` and `shared` are the unknowns now. `None` where the equations have no solution.
///
/// The frames' blocks are eliminated in order (block tridiagonal Cholesky), the shared unknowns
/// last.
pub(super) fn solve(
    frames: &[Normal],
    expected: &Expected<'_>,
    own: &[DVector<f64>],
    shared: &DVector<f64>,
) -> Option<Solution> {
    let (p, b) = (expected.own.len(), expected.shared.len());
    // The inverse of the process's covariance: ties between neighbours, and what is left for each
    // frame, at the ends and between.
    let each = expected.own.iter().zip(expected.kept);
    let innovation: Vec<f64> = each.map(|(variance, kept)| variance * (1.0 - kept * kept)).collect();
    let change = DVector::from_fn(p, |i, _| expected.kept[i] / innovation[i]);
    let least = |i: usize, neighbours: usize| match neighbours {
        0 => expected.own[i].recip(),
        _ => (1.0 - expected.kept[i]).powi(neighbours as i32) / innovation[i],
    };
    // Of a frame: the factor of its block, and the solutions of the right-hand side and of the
    // shared unknowns' columns, before what follows is known.
    let mut factors: Vec<(Cholesky<f64, Dyn>, DMatrix<f64>)> = Vec::with_capacity(frames.len());
    let mut shared_matrix = DMatrix::from_diagonal(&DVector::from_row_slice(expected.shared));
    let mut shared_vector = DVector::from_fn(b, |k, _| -expected.shared[k] * shared[k]);
    let mut sides: Vec<DMatrix<f64>> = Vec::with_capacity(frames.len());
    for (f, normal) in frames.iter().enumerate() {
        debug_assert_eq!(normal.own, p);
        let mut block = normal.matrix.view((0, 0), (p, p)).into_owned();
        let mut side = DMatrix::zeros(p, 1 + b);
        side.set_column(0, &(-normal.vector.rows(0, p)));
        side.view_mut((0, 1), (p, b)).copy_from(&normal.matrix.view((0, p), (p, b)));
        shared_matrix += normal.matrix.view((p, p), (b, b));
        shared_vector -= normal.vector.rows(p, b);
        let neighbours = || [f.checked_sub(1), Some(f + 1).filter(|&n| n < frames.len())].into_iter().flatten();
        for i in 0..p {
            let least = least(i, neighbours().count());
            block[(i, i)] += least;
            side[(i, 0)] -= least * own[f][i];
            for neighbour in neighbours() {
                block[(i, i)] += change[i];
                side[(i, 0)] -= change[i] * (own[f][i] - own[neighbour][i]);
            }
        }
        if let Some((before, solved)) = factors.last() {
            // The tie to the frame before is −diag(change).
            let mut tie = DMatrix::from_diagonal(&change);
            before.solve_mut(&mut tie);
            for i in 0..p {
                for j in 0..p {
                    block[(i, j)] -= change[i] * tie[(i, j)];
                }
                for k in 0..=b {
                    side[(i, k)] += change[i] * solved[(i, k)];
                }
            }
        }
        let factor = Cholesky::new(block)?;
        let solved = factor.solve(&side);
        sides.push(side);
        factors.push((factor, solved));
    }
    // Back: x_f = A_f⁻¹ (side_f + change · x_{f + 1}), for the right-hand side and each shared
    // unknown.
    let mut solutions: Vec<DMatrix<f64>> = vec![DMatrix::zeros(p, 1 + b); frames.len()];
    let mut variances: Vec<DVector<f64>> = vec![DVector::zeros(p); frames.len()];
    let mut covariance = DMatrix::zeros(p, p);
    for f in (0..frames.len()).rev() {
        let (factor, solved) = &factors[f];
        let alone = factor.inverse();
        covariance = if f + 1 == frames.len() {
            alone
        } else {
            let mut gain = alone.clone();
            gain.column_iter_mut().zip(change.iter()).for_each(|(mut column, change)| column *= *change);
            alone + &gain * covariance * gain.transpose()
        };
        variances[f] = covariance.diagonal();
        solutions[f] = match solutions.get(f + 1) {
            None => solved.clone(),
            Some(next) => {
                let mut side = sides[f].clone();
                for i in 0..p {
                    for k in 0..=b {
                        side[(i, k)] += change[i] * next[(i, k)];
                    }
                }
                factor.solve(&side)
            }
        };
    }
    for (normal, solution) in frames.iter().zip(&solutions) {
        let coupling = normal.matrix.view((p, 0), (b, p));
        shared_matrix -= coupling * solution.view((0, 1), (p, b));
        shared_vector -= coupling * solution.column(0);
    }
    let shared_step = if b == 0 { DVector::zeros(0) } else { Cholesky::new(shared_matrix)?.solve(&shared_vector) };
    let own = solutions.iter().map(|s| s.column(0) - s.view((0, 1), (p, b)) * &shared_step).collect();
    Some(Solution { own, shared: shared_step, variances })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Stream;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        /// All equations in one dense matrix.
        #[test]
        fn blocks_give_what_the_whole_matrix_gives(seed in any::<u64>(), frames in 1usize..6, p in 1usize..5, b in 0usize..4) {
            let mut stream = Stream::new(&[seed]);
            let mut random = || f64::from(stream.normal());
            let mut normals = vec![Normal::new(p, b); frames];
            let columns: Vec<u32> = (0..(p + b) as u32).collect();
            let size = frames * p + b;
            let (mut whole, mut right) = (DMatrix::<f64>::zeros(size, size), DVector::<f64>::zeros(size));
            let own: Vec<DVector<f64>> = (0..frames).map(|_| DVector::from_fn(p, |_, _| random())).collect();
            let shared = DVector::from_fn(b, |_, _| random());
            let mut add = |weight: f64, residual: f64, entries: &[(usize, f64)]| {
                for &(i, a) in entries {
                    right[i] -= weight * a * residual;
                    entries.iter().for_each(|&(j, c)| whole[(i, j)] += weight * a * c);
                }
            };
            for (f, normal) in normals.iter_mut().enumerate() {
                for _ in 0..3 {
                    let row: Vec<f64> = columns.iter().map(|_| random()).collect();
                    let (weight, residual) = (random().abs(), random());
                    normal.add(weight, residual, &columns, &row);
                    let place = |c: usize| if c < p { f * p + c } else { frames * p + c - p };
                    let entries: Vec<_> = row.iter().enumerate().map(|(c, &v)| (place(c), v)).collect();
                    add(weight, residual, &entries);
                }
            }
            let prior: Vec<f64> = (0..p).map(|_| 0.1 + random().abs()).collect();
            let kept: Vec<f64> = (0..p).map(|_| 0.98 * random().sin().abs()).collect();
            let common: Vec<f64> = (0..b).map(|_| 0.1 + random().abs()).collect();
            for f in 0..frames {
                for i in 0..p {
                    // The first is as uncertain as any, each next one is what is kept and some more.
                    if f == 0 {
                        add(prior[i].recip(), own[0][i], &[(i, 1.0)]);
                    } else {
                        let more = prior[i] * (1.0 - kept[i] * kept[i]);
                        let residual = own[f][i] - kept[i] * own[f - 1][i];
                        add(more.recip(), residual, &[(f * p + i, 1.0), ((f - 1) * p + i, -kept[i])]);
                    }
                }
            }
            (0..b).for_each(|k| add(common[k], shared[k], &[(frames * p + k, 1.0)]));
            let expected = Expected { own: &prior, kept: &kept, shared: &common };
            let Solution { own: steps, shared: shared_step, variances } = solve(&normals, &expected, &own, &shared).unwrap();
            let exact = whole.clone().lu().solve(&right).unwrap();
            let inverse = whole.view((0, 0), (frames * p, frames * p)).into_owned().try_inverse().unwrap();
            for f in 0..frames {
                prop_assert!((&steps[f] - exact.rows(f * p, p)).amax() < 1e-8);
                prop_assert!((&variances[f] - inverse.diagonal().rows(f * p, p)).amax() < 1e-8);
            }
            prop_assert!((&shared_step - exact.rows(frames * p, b)).iter().all(|d| d.abs() < 1e-8));
        }
    }
}
