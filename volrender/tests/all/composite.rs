//! Compositing against the test kit's reference in f64, its gradients against finite differences
//! of the reference.

use approx::{abs_diff_eq, assert_abs_diff_eq};
use glam::Vec3;
use proptest::prelude::*;
use testkit::gradient::{Tolerance, assert_gradient};
use testkit::oracle;
use volrender::{Composite, RaySamples, SampleGradients, composite, composite_backward};

#[derive(Clone, Debug, Default)]
struct Samples {
    sigma: Vec<f32>,
    likelihood: Vec<f32>,
    delta: Vec<f32>,
    t: Vec<f32>,
    rgb: Vec<Vec3>,
}

impl Samples {
    fn push(&mut self, (sigma, likelihood, delta, rgb): (f32, f32, f32, Vec3)) {
        let end = self.t.last().copied().unwrap_or(1.0);
        self.sigma.push(sigma);
        self.likelihood.push(likelihood);
        self.delta.push(delta);
        self.t.push(end + delta);
        self.rgb.push(rgb);
    }

    fn composite(&self, background: Vec3) -> (Composite, Vec<f32>) {
        let mut weights = vec![f32::NAN; self.sigma.len()];
        let composite = composite(self.as_ray(), background, &mut weights);
        (composite, weights)
    }

    fn as_ray(&self) -> RaySamples<'_> {
        let Self { sigma, likelihood, delta, t, rgb } = self;
        RaySamples { sigma, likelihood, delta, t, rgb }
    }

    fn backward(&self, background: Vec3, d_color: Vec3, d_opacity: f32) -> Gradients {
        let n = self.sigma.len();
        let (_, weights) = self.composite(background);
        // NaN shows outputs that are not overwritten.
        let mut d = Gradients { sigma: vec![f32::NAN; n], rgb: vec![Vec3::NAN; n], likelihood: vec![f32::NAN; n] };
        let gradients = SampleGradients { d_sigma: &mut d.sigma, d_rgb: &mut d.rgb, d_likelihood: &mut d.likelihood };
        composite_backward(self.as_ray(), background, &weights, d_color, d_opacity, gradients);
        d
    }

    /// The loss whose gradient `backward` computes, in f64.
    fn loss(&self, background: Vec3, d_color: Vec3, d_opacity: f32) -> f64 {
        let Self { sigma, likelihood, delta, rgb, .. } = self;
        let (color, opacity, ..) = oracle::composite(sigma, likelihood, delta, rgb, background);
        color.dot(d_color.as_dvec3()) + opacity * f64::from(d_opacity)
    }

    fn check_gradients(&self, background: Vec3, d_color: Vec3, d_opacity: f32) {
        let d = self.backward(background, d_color, d_opacity);
        // The oracle is exact; the error is f32 rounding of the backward pass (a few ulps per
        // sample, values up to 4) and the third derivative of exp, δ³ step² / 6.
        let ulps = 8.0 * f64::from(f32::EPSILON) * (4 + self.sigma.len()) as f64;
        let tolerance = Tolerance { abs: ulps, rel: 1e-3 };
        assert_gradient("likelihood", &self.likelihood, &d.likelihood, 1e-3, tolerance, |x| {
            let moved = Self { likelihood: x.to_vec(), ..self.clone() };
            moved.loss(background, d_color, d_opacity)
        });
        let colors: Vec<f32> = self.rgb.iter().flat_map(|c| c.to_array()).collect();
        let d_colors: Vec<f32> = d.rgb.iter().flat_map(|c| c.to_array()).collect();
        assert_gradient("rgb", &colors, &d_colors, 0.125, tolerance, |x| {
            let rgb = x.as_chunks::<3>().0.iter().map(|&c| Vec3::from(c)).collect();
            Self { rgb, ..self.clone() }.loss(background, d_color, d_opacity)
        });
        // Steps are lost to rounding in huge densities, which have a test below.
        let movable: Vec<usize> = (0..self.sigma.len()).filter(|&i| self.sigma[i] < 1e4).collect();
        let pick = |from: &[f32]| -> Vec<f32> { movable.iter().map(|&i| from[i]).collect() };
        assert_gradient("sigma", &pick(&self.sigma), &pick(&d.sigma), 1e-2, tolerance, |x| {
            let mut moved = self.clone();
            for (&i, &sigma) in movable.iter().zip(x) {
                moved.sigma[i] = sigma;
            }
            moved.loss(background, d_color, d_opacity)
        });
    }
}

struct Gradients {
    sigma: Vec<f32>,
    rgb: Vec<Vec3>,
    likelihood: Vec<f32>,
}

fn color() -> impl Strategy<Value = Vec3> {
    prop::array::uniform3(0.0f32..=1.0).prop_map(Vec3::from)
}

/// Rays through fog, empty space and opaque samples, with likelihoods of 0 and 1 and empty bins.
fn ray(count: std::ops::Range<usize>) -> impl Strategy<Value = Samples> {
    let sigma = prop_oneof![4 => 0.0f32..30.0, 1 => 0.0f32..1e-4, 1 => Just(0.0), 1 => Just(1e30), 1 => 50.0f32..2e3];
    let likelihood = prop_oneof![2 => 0.0f32..=1.0, 2 => Just(1.0), 1 => Just(0.0)];
    let delta = prop_oneof![6 => 1e-3f32..0.3, 1 => Just(0.0)];
    prop::collection::vec((sigma, likelihood, delta, color()), count).prop_map(|samples| {
        let mut ray = Samples::default();
        samples.into_iter().for_each(|sample| ray.push(sample));
        ray
    })
}

fn numbers(values: &'static [f32], count: std::ops::Range<usize>) -> impl Strategy<Value = Vec<f32>> {
    prop::collection::vec(prop::sample::select(values), count)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn compositing_equals_the_reference(ray in ray(0..150), background in color()) {
        let (got, weights) = ray.composite(background);
        let (color, opacity, expected, _) =
            oracle::composite(&ray.sigma, &ray.likelihood, &ray.delta, &ray.rgb, background);
        // T is a product of up to 150 factors, each with a rounding error.
        let tolerance = f64::from(f32::EPSILON) * (8 + ray.sigma.len()) as f64;
        prop_assert!(got.color.as_dvec3().distance(color) <= 2.0 * tolerance, "{} {color}", got.color);
        prop_assert!(abs_diff_eq!(f64::from(got.opacity), opacity, epsilon = tolerance));
        for (i, (w, expected)) in weights.iter().zip(&expected).enumerate() {
            prop_assert!(abs_diff_eq!(f64::from(*w), expected, epsilon = tolerance), "{i}: {w} {expected}");
        }
        let depth: f64 = expected.iter().zip(&ray.t).map(|(w, t)| w * f64::from(*t)).sum();
        prop_assert!((f64::from(got.depth) - depth).abs() <= tolerance * (1.0 + depth.abs()));
    }

    #[test]
    fn termination_is_the_lowest_index_of_the_largest_alpha(ray in ray(0..150)) {
        let (got, _) = ray.composite(Vec3::ZERO);
        let alpha: Vec<f64> = (0..ray.sigma.len())
            .map(|i| f64::from(ray.likelihood[i]) * -(-f64::from(ray.sigma[i]) * f64::from(ray.delta[i])).exp_m1())
            .collect();
        let largest = alpha.iter().fold(0.0f64, |a, &b| a.max(b));
        match got.termination {
            None => prop_assert_eq!(largest, 0.0),
            Some(i) => {
                // Alphas equal within f32 rounding are ties.
                prop_assert!(alpha[i as usize] >= largest * (1.0 - 5e-7));
                prop_assert!(alpha[..i as usize].iter().all(|a| *a <= alpha[i as usize] * (1.0 + 5e-7)));
                prop_assert!(largest < 1.0 || alpha[i as usize] >= 1.0 - 6e-8);
            }
        }
    }

    #[test]
    fn omitting_samples_of_alpha_zero_changes_nothing(ray in ray(0..150), background in color()) {
        let mut live = Samples::default();
        for i in 0..ray.sigma.len() {
            if ray.sigma[i] * ray.delta[i] * ray.likelihood[i] > 0.0 {
                live.push((ray.sigma[i], ray.likelihood[i], ray.delta[i], ray.rgb[i]));
                *live.t.last_mut().unwrap() = ray.t[i];
            }
        }
        let (all, _) = ray.composite(background);
        let (some, _) = live.composite(background);
        prop_assert_eq!((all.color, all.opacity, all.depth), (some.color, some.opacity, some.depth));
        prop_assert_eq!(all.termination.is_some(), some.termination.is_some());
    }

    #[test]
    fn bins_of_any_finite_width_give_finite_pixels_and_gradients(
        mut edges in numbers(&[-3.4e38, -3e38, -1.0, 0.0, 1.0, 1e30, 3e38, 3.4e38], 2..40),
        sigma in numbers(&[0.0, 1e-38, 1e-30, 1.0, 1e30, f32::MAX, f32::INFINITY], 40..41),
        likelihood in prop::sample::select(vec![0.0, 0.3, 1.0f32]), d_opacity in -1.0f32..1.0,
    ) {
        edges.sort_by(f32::total_cmp);
        let n = edges.len() - 1;
        let t: Vec<f32> = edges.windows(2).map(|bin| 0.5 * bin[0] + 0.5 * bin[1]).collect();
        let delta: Vec<f32> = edges.windows(2).map(|bin| bin[1] - bin[0]).collect();
        let (sigma, likelihood, rgb) = (sigma[..n].to_vec(), vec![likelihood; n], vec![Vec3::X; n]);
        let ray = Samples { sigma, likelihood, delta, t, rgb };
        let (got, weights) = ray.composite(Vec3::ONE);
        prop_assert!(got.color.is_finite() && got.depth.is_finite() && (0.0..=1.0).contains(&got.opacity), "{got:?}");
        prop_assert!(weights.iter().all(|w| (0.0..=1.0).contains(w)), "{weights:?}");
        let d = ray.backward(Vec3::ONE, Vec3::new(1.0, -2.0, 0.5), d_opacity);
        prop_assert!(d.sigma.iter().chain(&d.likelihood).all(|d| d.is_finite()), "{:?}", d.sigma);
        // The density of an opaque sample has no influence.
        let opaque = |i: &usize| ray.sigma[*i].min(f32::MAX) * ray.delta[*i].min(f32::MAX) > 100.0;
        prop_assert!((0..n).filter(opaque).all(|i| d.sigma[i] == 0.0), "{:?}", d.sigma);
    }

    #[test]
    fn gradients_equal_finite_differences(ray in ray(0..70), background in color(), d_color in color(), d_opacity in -1.0f32..1.0) {
        ray.check_gradients(background, d_color - 0.5, d_opacity);
    }
}

/// Three samples of fog around a sample of density `sigma`.
fn wall(sigma: f32) -> Samples {
    let mut ray = Samples::default();
    for (i, sigma) in [1.0, sigma, 2.0, 0.0].into_iter().enumerate() {
        let c = i as f32 * 0.2;
        ray.push((sigma, 1.0, 0.25, Vec3::new(c, 1.0 - c, 0.5)));
    }
    ray
}

#[test]
fn opaque_samples_have_exact_gradients() {
    for sigma in [80.0, 1e3, 1e30, f32::MAX, f32::INFINITY] {
        let ray = wall(sigma);
        let (got, weights) = ray.composite(Vec3::ONE);
        assert_eq!(got.opacity, 1.0);
        assert_eq!(got.termination, Some(1));
        assert_eq!(weights[2..], [0.0, 0.0]);
        let d = ray.backward(Vec3::ONE, Vec3::new(1.0, -2.0, 0.5), 0.3);
        // Samples behind the wall have no influence, nor has the wall's density.
        assert_eq!(d.rgb[2..], [Vec3::ZERO; 2]);
        assert_eq!(d.sigma[2..], [0.0; 2]);
        assert_eq!(d.likelihood[2..], [0.0; 2]);
        assert!(d.sigma[1].abs() < 1e-8);
        // Its likelihood has: dividing by 1 − α would give 0/0 here.
        assert!(d.likelihood[1].abs() > 0.1);
        ray.check_gradients(Vec3::ONE, Vec3::new(1.0, -2.0, 0.5), 0.3);
    }
}

#[test]
fn faint_fog_keeps_its_relative_accuracy() {
    let mut ray = Samples::default();
    ray.push((1e-6, 1.0, 1e-3, Vec3::ONE));
    let (got, _) = ray.composite(Vec3::ZERO);
    assert_abs_diff_eq!(got.opacity / 1e-9, 1.0, epsilon = 1e-6);
}

#[test]
fn nan_propagates_to_the_colour_and_is_never_the_termination() {
    let mut ray = wall(3.0);
    ray.sigma[2] = f32::NAN;
    let (got, weights) = ray.composite(Vec3::ZERO);
    assert!(got.color.is_nan() && got.opacity.is_nan());
    assert!(!weights[1].is_nan());
    assert_eq!(got.termination, Some(1));
}

#[test]
#[should_panic(expected = "2 sigma, 1 likelihood")]
fn slices_of_different_lengths_panic() {
    let samples = RaySamples { sigma: &[1.0; 2], likelihood: &[1.0], ..RaySamples::default() };
    composite(samples, Vec3::ZERO, &mut [0.0; 2]);
}

#[test]
fn transmittance_underflows_to_zero_with_finite_gradients() {
    let mut ray = Samples::default();
    for _ in 0..5000 {
        ray.push((10.0, 0.9, 0.1, Vec3::ONE));
    }
    let (got, weights) = ray.composite(Vec3::ZERO);
    assert_abs_diff_eq!(got.opacity, 1.0, epsilon = 1e-6);
    assert_eq!(weights[4999], 0.0);
    let d = ray.backward(Vec3::ZERO, Vec3::ONE, 1.0);
    assert!(d.sigma.iter().chain(&d.likelihood).all(|d| d.is_finite()));
}
