//! Central finite differences against a hand-written gradient.

use std::fmt::Write as _;

/// Largest difference of analytic and numeric derivative: `|a − n| ≤ abs + rel · max(|a|, |n|)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerance {
    /// Allowed difference whatever the magnitude; covers the rounding of the function under test,
    /// which a central difference magnifies by 1 / (2 · step).
    pub abs: f64,
    /// Allowed difference as a fraction of the larger derivative; covers the third-order term step²
    /// / 6 · f‴.
    pub rel: f64,
}

impl Default for Tolerance {
    /// Fits functions of magnitude one evaluated in `f32` with a step of 1e-2.
    fn default() -> Self {
        Self { abs: 1e-3, rel: 1e-2 }
    }
}

impl Tolerance {
    /// Whether two derivatives agree. Anything not finite never agrees.
    #[must_use]
    pub fn accepts(&self, analytic: f64, numeric: f64) -> bool {
        // Written so that NaN falls on the rejecting side.
        (analytic - numeric).abs() <= self.abs + self.rel * analytic.abs().max(numeric.abs())
            && analytic.is_finite()
            && numeric.is_finite()
    }
}

/// Compares `analytic` (N) with central differences of `f` at `x` (N), one coordinate at a time.
///
/// The difference is divided by the step that `f32` really represents, `(x + h) − (x − h)`. `f`
/// must be smooth within `step` of `x`: keep off kinks, grid faces and ties.
///
/// # Errors
/// Every disagreeing coordinate together, each with its index, value and both derivatives; also
/// different lengths, and a step lost to rounding.
pub fn check(
    name: &str,
    x: &[f32],
    analytic: &[f32],
    step: f32,
    tolerance: Tolerance,
    mut f: impl FnMut(&[f32]) -> f64,
) -> Result<(), String> {
    if x.len() != analytic.len() {
        return Err(format!("{name}: {} inputs but {} derivatives", x.len(), analytic.len()));
    }
    let mut failures = String::new();
    let mut count = 0;
    let mut moved = x.to_vec();
    for i in 0..x.len() {
        let (above, below) = (x[i] + step, x[i] - step);
        moved[i] = above;
        let f_above = f(&moved);
        moved[i] = below;
        let f_below = f(&moved);
        moved[i] = x[i];
        let numeric = (f_above - f_below) / (f64::from(above) - f64::from(below));
        if !tolerance.accepts(f64::from(analytic[i]), numeric) {
            count += 1;
            let _ = write!(failures, "\n  [{i}] x = {}: analytic {}, numeric {numeric}", x[i], analytic[i]);
        }
    }
    if count == 0 {
        return Ok(());
    }
    Err(format!(
        "{name}: {count} of {} derivatives disagree (step {step}, abs {}, rel {}):{failures}",
        x.len(),
        tolerance.abs,
        tolerance.rel
    ))
}

/// [`check`], panicking with its message.
///
/// # Panics
/// Where `check` would return an error.
#[track_caller]
pub fn assert_gradient(
    name: &str,
    x: &[f32],
    analytic: &[f32],
    step: f32,
    tolerance: Tolerance,
    f: impl FnMut(&[f32]) -> f64,
) {
    if let Err(message) = check(name, x, analytic, step, tolerance, f) {
        panic!("{message}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn f(x: &[f32]) -> f64 {
        let [a, b, c] = [0, 1, 2].map(|i| f64::from(x[i]));
        a.sin() * b + (c * 0.5).exp()
    }

    fn gradient(x: &[f32]) -> Vec<f32> {
        vec![x[0].cos() * x[1], x[0].sin(), 0.5 * (x[2] * 0.5).exp()]
    }

    const X: [f32; 3] = [0.7, -1.3, 0.4];

    #[test]
    fn every_wrong_derivative_is_reported_together() {
        let mut wrong = gradient(&X);
        wrong[0] *= -1.0;
        wrong[2] *= 1.05;
        let message = check("f", &X, &wrong, 1e-2, Tolerance::default(), f).unwrap_err();
        assert!(message.contains("2 of 3"), "{message}");
        assert!(message.contains("[0]") && message.contains("[2]") && !message.contains("[1]"));
    }

    #[test]
    fn nan_and_wrong_lengths_and_lost_steps_fail() {
        let mut nan = gradient(&X);
        nan[1] = f32::NAN;
        assert!(check("f", &X, &nan, 1e-2, Tolerance::default(), f).is_err());
        assert!(check("f", &X, &[0.0; 2], 1e-2, Tolerance::default(), f).is_err());
        let flat = check("flat", &[1e9], &[0.0], 1e-3, Tolerance::default(), |_| 0.0);
        assert!(flat.is_err(), "a step that vanishes in f32 must not pass");
        let infinite =
            check("inf", &[1.0], &[0.0], 1e-2, Tolerance::default(), |x| if x[0] > 1.0 { f64::INFINITY } else { 0.0 });
        assert!(infinite.is_err());
    }
}
