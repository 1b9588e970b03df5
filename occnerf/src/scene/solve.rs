//! Conjugate gradients.

/// An approximate solution of A x = `rhs` after `iterations` steps of conjugate gradients (Hestenes and
/// Stiefel 1952) from 0, preconditioned by the `diagonal` of the symmetric positive definite A. `apply`
/// maps x to A x.
pub(super) fn conjugate_gradients(
    apply: impl Fn(&[f32]) -> Vec<f32>,
    rhs: &[f32],
    diagonal: &[f32],
    iterations: usize,
) -> Vec<f32> {
    let product = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
    let precondition = |r: &[f32]| -> Vec<f32> { r.iter().zip(diagonal).map(|(r, d)| r * d.recip()).collect() };
    let mut x = vec![0.0; rhs.len()];
    let mut residual = rhs.to_vec();
    let mut conditioned = precondition(&residual);
    let mut direction = conditioned.clone();
    let mut energy = product(&residual, &conditioned);
    for _ in 0..iterations {
        let image = apply(&direction);
        let curvature = product(&direction, &image);
        // False for NaN.
        if !(curvature > 0.0 && energy > 0.0) {
            break;
        }
        let along = (energy / curvature) as f32;
        for (((x, r), d), image) in x.iter_mut().zip(&mut residual).zip(&direction).zip(&image) {
            (*x, *r) = (*x + *d * along, *r - *image * along);
        }
        conditioned = precondition(&residual);
        let next = product(&residual, &conditioned);
        let share = (next / energy) as f32;
        direction.iter_mut().zip(&conditioned).for_each(|(d, z)| *d = *z + *d * share);
        energy = next;
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_solution_is_that_of_a_dense_solver(
            entries in prop::collection::vec(-1.0f64..1.0, 64), rhs in prop::collection::vec(-1.0f64..1.0, 8),
        ) {
            let half = DMatrix::from_vec(8, 8, entries);
            let matrix: DMatrix<f64> = &half * half.transpose() + 0.1 * DMatrix::identity(8, 8);
            let vector = DVector::from_vec(rhs);
            let expected = matrix.clone().cholesky().unwrap().solve(&vector);
            let apply = |x: &[f32]| -> Vec<f32> {
                let x = DVector::from_iterator(8, x.iter().map(|x| f64::from(*x)));
                (&matrix * x).iter().map(|y| *y as f32).collect()
            };
            let singles = |v: &DVector<f64>| v.iter().map(|x| *x as f32).collect::<Vec<f32>>();
            let found =
                conjugate_gradients(apply, &singles(&vector), &singles(&matrix.diagonal()), 40);
            let size = expected.amax().max(1.0);
            for (found, expected) in found.iter().zip(expected.iter()) {
                prop_assert!((f64::from(*found) - expected).abs() < 1e-3 * size, "{found} {expected}");
            }
        }
    }

    #[test]
    fn nothing_is_divided_by_zero() {
        let zero = conjugate_gradients(|x| x.to_vec(), &[0.0f32; 3], &[1.0; 3], 5);
        assert_eq!(zero, [0.0; 3]);
        let bad = conjugate_gradients(|x| x.to_vec(), &[f32::NAN, 1.0], &[1.0; 2], 5);
        assert_eq!(bad.len(), 2);
    }
}
