//! Regularised linear least squares over all frames: per-frame unknowns coupled over two frames by
//! the prior, and global unknowns.

use nalgebra::{Cholesky, DMatrix, DVector};

/// Size from which matrices are inverted by blocks.
const DIRECT: usize = 24;

/// Normal equations of one frame, the per-frame unknowns (P) before the global ones (B).
#[derive(Clone, Debug)]
pub(super) struct NormalEquations {
    /// P.
    pub per_frame: usize,
    /// Σ w JᵀJ, (P + B)².
    pub matrix: DMatrix<f64>,
    /// Σ w Jᵀr, (P + B).
    pub vector: DVector<f64>,
}

impl NormalEquations {
    pub fn new(per_frame: usize, global: usize) -> Self {
        let size = per_frame + global;
        Self { per_frame, matrix: DMatrix::zeros(size, size), vector: DVector::zeros(size) }
    }

    /// Adds a residual with the sparse Jacobian `row` in `columns`.
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

/// Gaussian prior with zero mean: per-frame unknowns are stationary autoregressive processes of
/// second order over the frames.
pub(super) struct Prior<'a> {
    /// Variance of each per-frame unknown, (P).
    pub per_frame: &'a [f64],
    /// Coefficients of each per-frame unknown at lags 1 and 2, (P).
    pub ar_coefficients: &'a [[f64; 2]],
    /// Inverse variance of each global unknown, (B).
    pub global: &'a [f64],
}

impl Prior<'_> {
    /// Row `t` of the inverse covariance of unknown `i` over `frames` frames, from the diagonal on.
    fn precision(&self, i: usize, t: usize, frames: usize) -> [f64; 3] {
        let (variance, [a, b]) = (self.per_frame[i], self.ar_coefficients[i]);
        // Autocorrelation at lag 1 (Yule and Walker).
        let next = a / (1.0 - b);
        let mut row = [0.0; 3];
        for frame in t..(t + 3).min(frames) {
            // Prediction error filter, and its variance relative to the process's.
            let (of, left) = match frame {
                0 => ([1.0, 0.0, 0.0], 1.0),
                1 => ([1.0, -next, 0.0], 1.0 - next * next),
                _ => ([1.0, -a, -b], (1.0 - b * b) * (1.0 - next * next)),
            };
            let back = frame - t;
            for (entry, k) in row.iter_mut().zip(0..=back) {
                *entry += of[back] * of[back - k] / (variance * left);
            }
        }
        row
    }
}

/// Gauss-Newton step.
pub(super) struct Solution {
    /// Step of each frame's unknowns, (P).
    pub per_frame: Vec<DVector<f64>>,
    /// Step of the global unknowns, (B).
    pub global: DVector<f64>,
    /// Posterior variance of each frame's unknowns, given the global ones, (P).
    pub variances: Vec<DVector<f64>>,
}

/// Solves for the steps of all unknowns, whose current values are `per_frame` (P a frame) and
/// `global` (B). `None` for a singular system.
///
/// Pairs of frames are eliminated in order (block tridiagonal Cholesky), the global unknowns last
/// (Schur complement). An odd number of frames is padded with one without observations.
pub(super) fn solve(
    frames: &[NormalEquations],
    prior: &Prior<'_>,
    per_frame: &[DVector<f64>],
    global: &DVector<f64>,
) -> Option<Solution> {
    let (p, b) = (prior.per_frame.len(), prior.global.len());
    let (pairs, count) = (frames.len().div_ceil(2), frames.len());
    let precision: Vec<Vec<[f64; 3]>> =
        (0..2 * pairs).map(|t| (0..p).map(|i| prior.precision(i, t, 2 * pairs)).collect()).collect();
    // Product of a matrix with the sparse off-diagonal block between pairs g and g + 1.
    let coupled = |matrix: &DMatrix<f64>, g: usize| {
        let mut out = DMatrix::zeros(matrix.nrows(), 2 * p);
        for i in 0..p {
            let [first, second] = [precision[2 * g][i], precision[2 * g + 1][i]];
            out.column_mut(i).axpy(first[2], &matrix.column(i), 0.0);
            out.column_mut(i).axpy(second[1], &matrix.column(p + i), 1.0);
            out.column_mut(p + i).axpy(second[2], &matrix.column(p + i), 0.0);
        }
        out
    };
    // Of each pair: the inverse of its block after elimination of earlier pairs, and that times the
    // right-hand side and the columns of the global unknowns.
    let mut pieces: Vec<[DMatrix<f64>; 2]> = Vec::with_capacity(pairs);
    let mut global_matrix = DMatrix::from_diagonal(&DVector::from_row_slice(prior.global));
    let mut global_vector = DVector::from_fn(b, |k, _| -prior.global[k] * global[k]);
    for normal in frames {
        global_matrix += normal.matrix.view((p, p), (b, b));
        global_vector -= normal.vector.rows(p, b);
    }
    let now = |t: usize, i: usize| per_frame.get(t).map_or(0.0, |values| values[i]);
    for g in 0..pairs {
        let mut block = DMatrix::zeros(2 * p, 2 * p);
        let mut side = DMatrix::zeros(2 * p, 1 + b);
        for half in 0..2 {
            let (t, at) = (2 * g + half, half * p);
            if t < count {
                let normal = &frames[t];
                debug_assert_eq!(normal.per_frame, p);
                block.view_mut((at, at), (p, p)).copy_from(&normal.matrix.view((0, 0), (p, p)));
                side.view_mut((at, 0), (p, 1)).copy_from(&(-normal.vector.rows(0, p)));
                side.view_mut((at, 1), (p, b)).copy_from(&normal.matrix.view((0, p), (p, b)));
            }
            for i in 0..p {
                let row = precision[t][i];
                block[(at + i, at + i)] += row[0];
                if half == 0 {
                    block[(i, p + i)] += row[1];
                    block[(p + i, i)] += row[1];
                }
                let back = |k: usize| t.checked_sub(k).map_or(0.0, |s| precision[s][i][k] * now(s, i));
                let ahead = row[0] * now(t, i) + row[1] * now(t + 1, i) + row[2] * now(t + 2, i);
                side[(at + i, 0)] -= ahead + back(1) + back(2);
            }
        }
        if let Some([inverse, solved]) = pieces.last() {
            block -= coupled(&coupled(inverse, g - 1).transpose(), g - 1);
            side -= coupled(&solved.transpose(), g - 1).transpose();
        }
        let inverse = inverse(block)?;
        let solved = &inverse * side;
        pieces.push([inverse, solved]);
    }
    // Back substitution: x_g = A_g⁻¹ (side_g − coupling · x_{g + 1}).
    let mut solutions: Vec<DMatrix<f64>> = vec![DMatrix::zeros(p, 1 + b); 2 * pairs];
    let mut variances: Vec<DVector<f64>> = vec![DVector::zeros(p); 2 * pairs];
    let (mut covariance, mut later) = (DMatrix::zeros(2 * p, 2 * p), DMatrix::zeros(2 * p, 1 + b));
    for (g, [inverse, solved]) in pieces.iter().enumerate().rev() {
        let gain = coupled(inverse, g);
        (covariance, later) = (inverse + &gain * covariance * gain.transpose(), solved - gain * later);
        for half in 0..2 {
            variances[2 * g + half] = covariance.diagonal().rows(half * p, p).into_owned();
            solutions[2 * g + half] = later.rows(half * p, p).into_owned();
        }
    }
    solutions.truncate(count);
    variances.truncate(count);
    for (normal, solution) in frames.iter().zip(&solutions) {
        let coupling = normal.matrix.view((p, 0), (b, p));
        global_matrix -= coupling * solution.view((0, 1), (p, b));
        global_vector -= coupling * solution.column(0);
    }
    let global = if b == 0 { DVector::zeros(0) } else { Cholesky::new(global_matrix)?.solve(&global_vector) };
    let per_frame = solutions.iter().map(|s| s.column(0) - s.view((0, 1), (p, b)) * &global).collect();
    Some(Solution { per_frame, global, variances })
}

/// Inverse of a positive definite matrix by recursive 2 × 2 blocks, whose matrix products are
/// faster than triangular solves.
pub(super) fn inverse(matrix: DMatrix<f64>) -> Option<DMatrix<f64>> {
    let (size, half) = (matrix.nrows(), matrix.nrows() / 2);
    if size <= DIRECT {
        return Some(Cholesky::new(matrix)?.inverse());
    }
    let rest = size - half;
    let first = inverse(matrix.view((0, 0), (half, half)).into_owned())?;
    let below = matrix.view((half, 0), (rest, half));
    let gain = below * &first;
    let second = inverse(matrix.view((half, half), (rest, rest)) - &gain * below.transpose())?;
    let across = &second * &gain;
    let mut out = DMatrix::zeros(size, size);
    out.view_mut((0, 0), (half, half)).copy_from(&(first + gain.tr_mul(&across)));
    out.view_mut((half, half), (rest, rest)).copy_from(&second);
    out.view_mut((half, 0), (rest, half)).copy_from(&-&across);
    out.view_mut((0, half), (half, rest)).copy_from(&-across.transpose());
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use volrender::RandomStream;

    #[test]
    fn a_matrix_times_its_inverse_is_one_and_what_is_not_positive_has_none() {
        let mut stream = RandomStream::new(&[5]);
        for size in [1, DIRECT, DIRECT + 1, 75, 150] {
            let root = DMatrix::from_fn(size, size, |_, _| f64::from(stream.normal()));
            let mut matrix = &root * root.transpose() + DMatrix::identity(size, size);
            let error = &matrix * inverse(matrix.clone()).unwrap() - DMatrix::identity(size, size);
            assert!(error.amax() < 1e-9, "{size}: {}", error.amax());
            matrix[(size - 1, size - 1)] = -1.0;
            assert!(inverse(matrix).is_none());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        /// All equations in one dense matrix.
        #[test]
        fn blocks_give_what_the_whole_matrix_gives(seed in any::<u64>(), frames in 1usize..6, p in 1usize..15, b in 0usize..4) {
            let mut stream = RandomStream::new(&[seed]);
            let mut random = || f64::from(stream.normal());
            let mut normals = vec![NormalEquations::new(p, b); frames];
            let columns: Vec<u32> = (0..(p + b) as u32).collect();
            let size = frames * p + b;
            let (mut whole, mut right) = (DMatrix::<f64>::zeros(size, size), DVector::<f64>::zeros(size));
            let per_frame: Vec<DVector<f64>> = (0..frames).map(|_| DVector::from_fn(p, |_, _| random())).collect();
            let global = DVector::from_fn(b, |_, _| random());
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
            let variances: Vec<f64> = (0..p).map(|_| 0.1 + random().abs()).collect();
            // Roots within the unit circle.
            let mut root = || 0.98 * random().sin();
            let ar_coefficients: Vec<[f64; 2]> = (0..p).map(|_| (root(), root())).map(|(x, y)| [x + y, -x * y]).collect();
            let common: Vec<f64> = (0..b).map(|_| 0.1 + random().abs()).collect();
            for f in 0..frames {
                for i in 0..p {
                    // Variance of the innovation, by the Yule-Walker equations.
                    let [a, c] = ar_coefficients[i];
                    let next = a / (1.0 - c);
                    let new = variances[i] * (1.0 - a * next - c * (a * next + c));
                    let at = |back: usize| (f - back) * p + i;
                    match f {
                        0 => add(variances[i].recip(), per_frame[0][i], &[(at(0), 1.0)]),
                        1 => {
                            let residual = per_frame[1][i] - next * per_frame[0][i];
                            add((variances[i] * (1.0 - next * next)).recip(), residual, &[(at(0), 1.0), (at(1), -next)]);
                        }
                        _ => {
                            let residual = per_frame[f][i] - a * per_frame[f - 1][i] - c * per_frame[f - 2][i];
                            add(new.recip(), residual, &[(at(0), 1.0), (at(1), -a), (at(2), -c)]);
                        }
                    }
                }
            }
            (0..b).for_each(|k| add(common[k], global[k], &[(frames * p + k, 1.0)]));
            let prior = Prior { per_frame: &variances, ar_coefficients: &ar_coefficients, global: &common };
            let Solution { per_frame: steps, global: step, variances } = solve(&normals, &prior, &per_frame, &global).unwrap();
            let exact = whole.clone().lu().solve(&right).unwrap();
            let inverse = whole.view((0, 0), (frames * p, frames * p)).into_owned().try_inverse().unwrap();
            for f in 0..frames {
                prop_assert!((&steps[f] - exact.rows(f * p, p)).amax() < 1e-8);
                prop_assert!((&variances[f] - inverse.diagonal().rows(f * p, p)).amax() < 1e-8);
            }
            prop_assert!((&step - exact.rows(frames * p, b)).iter().all(|d| d.abs() < 1e-8));
        }
    }
}
