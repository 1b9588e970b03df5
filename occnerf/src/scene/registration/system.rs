//! Least squares over all frames: each frame has unknowns of its own, tied to those of the next two
//! frames, and all frames share some.

use nalgebra::{Cholesky, DMatrix, DVector};

/// Sides of matrices that are inverted as they are.
const DIRECT: usize = 24;

/// The normal equations of one frame: its own unknowns (P) and the shared ones (B).
#[derive(Clone, Debug)]
pub(super) struct Normal {
    pub own: usize,
    /// Σ w JᵀJ, (P + B)².
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
/// stationary autoregressive process of second order).
pub(super) struct Expected<'a> {
    /// Variance of each unknown of a frame, (P).
    pub own: &'a [f64],
    /// What is kept of each unknown in the next frame, and in the one after that, (P).
    pub kept: &'a [[f64; 2]],
    /// Inverse variance of each shared unknown, (B).
    pub shared: &'a [f64],
}

impl Expected<'_> {
    /// Row `t` of the inverse covariance of an unknown over `frames` frames, from the diagonal on.
    fn precision(&self, i: usize, t: usize, frames: usize) -> [f64; 3] {
        let (variance, [a, b]) = (self.own[i], self.kept[i]);
        // Correlation with the next frame (Yule and Walker).
        let next = a / (1.0 - b);
        let mut row = [0.0; 3];
        // The first is as uncertain as any, each next one is what is kept of those before, and some
        // more.
        for frame in t..(t + 3).min(frames) {
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
/// Frames are eliminated in pairs, in order (block tridiagonal Cholesky), the shared unknowns last.
/// An odd number is filled up with a frame that shows nothing.
pub(super) fn solve(
    frames: &[Normal],
    expected: &Expected<'_>,
    own: &[DVector<f64>],
    shared: &DVector<f64>,
) -> Option<Solution> {
    let (p, b) = (expected.own.len(), expected.shared.len());
    let (pairs, count) = (frames.len().div_ceil(2), frames.len());
    let precision: Vec<Vec<[f64; 3]>> =
        (0..2 * pairs).map(|t| (0..p).map(|i| expected.precision(i, t, 2 * pairs)).collect()).collect();
    // A matrix times the ties of a pair to the next, which are few: its rows and the columns of the
    // next are tied.
    let tied = |matrix: &DMatrix<f64>, g: usize| {
        let mut out = DMatrix::zeros(matrix.nrows(), 2 * p);
        for i in 0..p {
            let [first, second] = [precision[2 * g][i], precision[2 * g + 1][i]];
            out.column_mut(i).axpy(first[2], &matrix.column(i), 0.0);
            out.column_mut(i).axpy(second[1], &matrix.column(p + i), 1.0);
            out.column_mut(p + i).axpy(second[2], &matrix.column(p + i), 0.0);
        }
        out
    };
    // Of a pair: the inverse of its block, and the solutions of the right-hand side and of the shared
    // unknowns' columns, before what follows is known.
    let mut pieces: Vec<[DMatrix<f64>; 2]> = Vec::with_capacity(pairs);
    let mut shared_matrix = DMatrix::from_diagonal(&DVector::from_row_slice(expected.shared));
    let mut shared_vector = DVector::from_fn(b, |k, _| -expected.shared[k] * shared[k]);
    for normal in frames {
        shared_matrix += normal.matrix.view((p, p), (b, b));
        shared_vector -= normal.vector.rows(p, b);
    }
    let now = |t: usize, i: usize| own.get(t).map_or(0.0, |own| own[i]);
    for g in 0..pairs {
        let mut block = DMatrix::zeros(2 * p, 2 * p);
        let mut side = DMatrix::zeros(2 * p, 1 + b);
        for half in 0..2 {
            let (t, at) = (2 * g + half, half * p);
            if t < count {
                let normal = &frames[t];
                debug_assert_eq!(normal.own, p);
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
        if let Some([alone, solved]) = pieces.last() {
            block -= tied(&tied(alone, g - 1).transpose(), g - 1);
            side -= tied(&solved.transpose(), g - 1).transpose();
        }
        let alone = inverse(block)?;
        let solved = &alone * side;
        pieces.push([alone, solved]);
    }
    // Back: x_g = A_g⁻¹ (side_g − tie · x_{g + 1}), for the right-hand side and each shared unknown.
    let mut solutions: Vec<DMatrix<f64>> = vec![DMatrix::zeros(p, 1 + b); 2 * pairs];
    let mut variances: Vec<DVector<f64>> = vec![DVector::zeros(p); 2 * pairs];
    // The last pair is tied to nothing.
    let (mut covariance, mut later) = (DMatrix::zeros(2 * p, 2 * p), DMatrix::zeros(2 * p, 1 + b));
    for (g, [alone, solved]) in pieces.iter().enumerate().rev() {
        let gain = tied(alone, g);
        (covariance, later) = (alone + &gain * covariance * gain.transpose(), solved - gain * later);
        for half in 0..2 {
            variances[2 * g + half] = covariance.diagonal().rows(half * p, p).into_owned();
            solutions[2 * g + half] = later.rows(half * p, p).into_owned();
        }
    }
    solutions.truncate(count);
    variances.truncate(count);
    for (normal, solution) in frames.iter().zip(&solutions) {
        let coupling = normal.matrix.view((p, 0), (b, p));
        shared_matrix -= coupling * solution.view((0, 1), (p, b));
        shared_vector -= coupling * solution.column(0);
    }
    let shared_step = if b == 0 { DVector::zeros(0) } else { Cholesky::new(shared_matrix)?.solve(&shared_vector) };
    let own = solutions.iter().map(|s| s.column(0) - s.view((0, 1), (p, b)) * &shared_step).collect();
    Some(Solution { own, shared: shared_step, variances })
}

/// The inverse of a positive definite matrix, from those of its halves: products of matrices are
/// many times faster here than solving.
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
            // Roots within the unit circle.
            let mut root = || 0.98 * random().sin();
            let kept: Vec<[f64; 2]> = (0..p).map(|_| (root(), root())).map(|(x, y)| [x + y, -x * y]).collect();
            let common: Vec<f64> = (0..b).map(|_| 0.1 + random().abs()).collect();
            for f in 0..frames {
                for i in 0..p {
                    // The variance of what is new, from the Yule-Walker equations.
                    let [a, c] = kept[i];
                    let next = a / (1.0 - c);
                    let new = prior[i] * (1.0 - a * next - c * (a * next + c));
                    let at = |back: usize| (f - back) * p + i;
                    match f {
                        0 => add(prior[i].recip(), own[0][i], &[(at(0), 1.0)]),
                        1 => {
                            let residual = own[1][i] - next * own[0][i];
                            add((prior[i] * (1.0 - next * next)).recip(), residual, &[(at(0), 1.0), (at(1), -next)]);
                        }
                        _ => {
                            let residual = own[f][i] - a * own[f - 1][i] - c * own[f - 2][i];
                            add(new.recip(), residual, &[(at(0), 1.0), (at(1), -a), (at(2), -c)]);
                        }
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
