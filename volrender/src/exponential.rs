/// Optical depth σδ; an infinite factor counts as `f32::MAX`, so that 0 · ∞ is 0, not NaN.
#[inline(always)]
pub(crate) fn optical_depth(sigma: f32, delta: f32) -> f32 {
    saturated(sigma) * saturated(delta)
}

/// `x`, infinities replaced by the largest finite numbers. Comparisons keep NaN, min and max would
/// not.
#[inline(always)]
pub(crate) fn saturated(x: f32) -> f32 {
    let x = if x > f32::MAX { f32::MAX } else { x };
    if x < f32::MIN { f32::MIN } else { x }
}

/// (1 − exp(−x), exp(−x)), both to a few units in the last place, without branches so that loops
/// vectorise.
///
/// exp(−x) = 2ⁿ (1 + q) with |r| ≤ ln 2 / 2 and q = expm1(r): the first result is (1 − 2ⁿ) − 2ⁿ q,
/// which for small x (n = 0) is −q, free of the cancellation of 1 − exp. x > 87 gives exactly
/// (1, 0), x < −88 is treated as −88, NaN stays NaN.
#[inline(always)]
pub(crate) fn one_minus_exp(x: f32) -> (f32, f32) {
    const LN_2_HIGH: f32 = 0.693_359_4; // 9 bits, so that n · LN_2_HIGH is exact
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    // 1.5 · 2^23: adding it rounds to an integer, held in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // Comparisons keep NaN, min and max would not.
    let y = if x > 87.0 { -87.0 } else { -x };
    let y = if y > 88.0 { 88.0 } else { y };
    let shifted = y * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (y - n * LN_2_HIGH) - n * LN_2_LOW;
    // expm1(r) = r + r²/2 + r³ p(r), Taylor to r⁷: the remainder is below 2e-9 relative.
    let p = 1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0 + r / 5040.0)));
    let q = r + r * r * (0.5 + r * p);
    let bits = shifted.to_bits().wrapping_sub(ROUND.to_bits());
    let power = f32::from_bits((bits.wrapping_add(127)) << 23);
    ((1.0 - power) - power * q, if x > 87.0 { 0.0 } else { power + power * q })
}

#[cfg(test)]
mod tests {
    use super::one_minus_exp;

    #[test]
    fn both_results_have_a_relative_error_below_three_ulps() {
        let mut x = 1e-20f32;
        while x < 80.0 {
            let (a, e) = one_minus_exp(x);
            let (exact_a, exact_e) = (-(-f64::from(x)).exp_m1(), (-f64::from(x)).exp());
            assert!((f64::from(a) / exact_a - 1.0).abs() < 3.6e-7, "{x}: {a}");
            // y − n ln 2 is rounded once at the magnitude of y's last bit.
            assert!((f64::from(e) / exact_e - 1.0).abs() < 3.6e-7, "{x}: {e}");
            x *= 1.000_37;
        }
    }

    #[test]
    fn large_arguments_and_zero_are_exact() {
        assert_eq!(one_minus_exp(0.0), (0.0, 1.0));
        for x in [87.1, 100.0, 1e30, f32::MAX, f32::INFINITY] {
            assert_eq!(one_minus_exp(x), (1.0, 0.0), "{x}");
        }
        assert!(one_minus_exp(f32::NAN).0.is_nan());
        assert!(one_minus_exp(f32::NAN).1.is_nan());
        let (a, _) = one_minus_exp(-1.0);
        assert!((f64::from(a) - (1.0 - 1f64.exp())).abs() < 1e-6);
        assert!(one_minus_exp(f32::NEG_INFINITY).0 < -1e38);
    }
}
