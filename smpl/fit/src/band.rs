//! Linear systems of all frames: dense blocks on the diagonal, and diagonal blocks between a frame
//! and the two after it.

use nalgebra::{DMatrix, DVector};

/// L D Lᵀ of a block-pentadiagonal matrix whose blocks off the diagonal are diagonal.
pub(crate) struct Band {
    /// Inverses of D.
    inverses: Vec<DMatrix<f64>>,
    /// Blocks of L beside the diagonal, by their row; empty for the first.
    below: Vec<DMatrix<f64>>,
    /// Blocks of the matrix two beside the diagonal, by their row; empty for the first two.
    second: Vec<DVector<f64>>,
}

/// Blocks beside the diagonal and two beside it, by their row.
#[derive(Clone)]
pub(crate) struct Beside {
    pub first: Vec<DVector<f64>>,
    pub second: Vec<DVector<f64>>,
}

impl Beside {
    pub fn zeros(unknowns: usize, frames: usize) -> Self {
        let zeros = vec![DVector::zeros(unknowns); frames];
        Self { first: zeros.clone(), second: zeros }
    }
}

impl Band {
    /// Factors the matrix; `None` where it is not positive definite.
    pub fn factor(diagonal: Vec<DMatrix<f64>>, beside: Option<Beside>) -> Option<Self> {
        let mut band = Self { inverses: Vec::new(), below: Vec::new(), second: Vec::new() };
        let scaled = |scale: &DVector<f64>, matrix: &DMatrix<f64>| {
            let mut out = matrix.clone();
            out.row_iter_mut().zip(scale.iter()).for_each(|(mut row, s)| row *= *s);
            out
        };
        for (i, mut block) in diagonal.into_iter().enumerate() {
            let mut below = DMatrix::zeros(0, 0);
            if let Some(beside) = beside.as_ref().filter(|_| i > 0) {
                // Row i, column i − 1 after columns up to i − 2 are eliminated.
                let mut rest = DMatrix::from_diagonal(&beside.first[i]);
                if i > 1 {
                    let second = &beside.second[i];
                    rest -= scaled(second, &band.below[i - 1].transpose());
                    let inverse = scaled(second, &band.inverses[i - 2]);
                    block -= scaled(second, &inverse.transpose());
                }
                below = &rest * &band.inverses[i - 1];
                block.gemm(-1.0, &below, &rest.transpose(), 1.0);
            }
            band.inverses.push(inverse(&block)?);
            band.below.push(below);
        }
        band.second = beside.map_or(Vec::new(), |beside| beside.second);
        Some(band)
    }

    /// Solves for right-hand sides (n, R) of every frame, in place.
    pub fn solve(&self, sides: &mut [DMatrix<f64>]) {
        let scale = |matrix: &mut DMatrix<f64>, by: &DVector<f64>| {
            matrix.row_iter_mut().zip(by.iter()).for_each(|(mut row, s)| row *= *s);
        };
        let coupled = !self.second.is_empty();
        for i in 1..if coupled { sides.len() } else { 0 } {
            let mut out = &self.below[i] * &sides[i - 1];
            if i > 1 {
                let mut two = &self.inverses[i - 2] * &sides[i - 2];
                scale(&mut two, &self.second[i]);
                out += two;
            }
            sides[i] -= out;
        }
        for i in (0..sides.len()).rev() {
            sides[i] = &self.inverses[i] * &sides[i];
            if coupled && i + 1 < sides.len() {
                let mut out = self.below[i + 1].tr_mul(&sides[i + 1]);
                if let Some(second) = self.second.get(i + 2) {
                    let mut two = sides[i + 2].clone();
                    scale(&mut two, second);
                    out += &self.inverses[i] * two;
                }
                sides[i] -= out;
            }
        }
    }
}

/// The inverse of a symmetric matrix by halves, most of it products; `None` unless positive
/// definite.
fn inverse(matrix: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let (n, half) = (matrix.nrows(), matrix.nrows() / 2);
    if n <= 16 {
        return Some(matrix.clone().cholesky()?.inverse());
    }
    let first = inverse(&matrix.view((0, 0), (half, half)).into_owned())?;
    let below = matrix.view((half, 0), (n - half, half));
    let across = below * &first;
    let second = inverse(&(matrix.view((half, half), (n - half, n - half)) - &across * below.transpose()))?;
    let corner = -(&second * &across);
    let mut out = DMatrix::zeros(n, n);
    out.view_mut((0, 0), (half, half)).copy_from(&(first - across.transpose() * &corner));
    out.view_mut((0, half), (half, n - half)).copy_from(&corner.transpose());
    out.view_mut((half, 0), (n - half, half)).copy_from(&corner);
    out.view_mut((half, half), (n - half, n - half)).copy_from(&second);
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_band_is_solved_as_the_dense_matrix_is() {
        let (n, frames) = (37, 6);
        let wave = |i: usize| (i as f64 * 1.7).sin();
        let block = |f: usize| {
            let a = DMatrix::from_fn(n, n, |r, c| wave(f * 11 + r * 5 + c * 3));
            &a * a.transpose() + DMatrix::identity(n, n) * 20.0
        };
        let diagonal: Vec<DMatrix<f64>> = (0..frames).map(block).collect();
        let off = |seed: usize| (0..frames).map(|f| DVector::from_fn(n, |r, _| wave(seed + f * 7 + r))).collect();
        let beside: Beside = Beside { first: off(3), second: off(50) };
        let mut dense = DMatrix::zeros(n * frames, n * frames);
        for f in 0..frames {
            dense.view_mut((f * n, f * n), (n, n)).copy_from(&diagonal[f]);
            for (back, blocks) in [(1, &beside.first), (2, &beside.second)] {
                for r in (0..n).filter(|_| f >= back) {
                    dense[(f * n + r, (f - back) * n + r)] = blocks[f][r];
                    dense[((f - back) * n + r, f * n + r)] = blocks[f][r];
                }
            }
        }
        let side = DMatrix::from_fn(n * frames, 2, |r, c| wave(r * 3 + c));
        let expected = dense.lu().solve(&side).unwrap();
        let mut sides: Vec<DMatrix<f64>> = (0..frames).map(|f| side.rows(f * n, n).into_owned()).collect();
        Band::factor(diagonal, Some(beside)).unwrap().solve(&mut sides);
        for (f, found) in sides.iter().enumerate() {
            assert!((found - expected.rows(f * n, n)).amax() < 1e-10, "frame {f}");
        }
        assert!(Band::factor(vec![-DMatrix::<f64>::identity(40, 40)], None).is_none());
    }
}
