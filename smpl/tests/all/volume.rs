//! The weight volumes: the prior and gradients.

use std::sync::LazyLock;

use glam::{Affine3A, Vec3};
use proptest::prelude::*;
use smpl::{BodyModel, Placement, Shaped, WeightVolume};
use testkit::gradient::{Tolerance, check};

static BODY: LazyLock<(BodyModel, Shaped)> = LazyLock::new(|| {
    let body = BodyModel::embedded();
    let shaped = body.shaped(&[]);
    (body, shaped)
});

const IDENTITY: [Affine3A; 24] = [Affine3A::IDENTITY; 24];

fn f(volume: &WeightVolume, x: Vec3) -> f32 {
    volume.map(&IDENTITY, x, 0.0).map_or(0.0, |s| s.likelihood)
}

#[test]
fn the_prior_fills_the_limbs_and_has_holes_at_the_joints() {
    let (body, shaped) = &*BODY;
    let volume = WeightVolume::gaussian(body, shaped, 32);
    let [hip, knee, elbow] = [1, 4, 18].map(|joint| shaped.joints[joint]);
    let at = |x| f(&volume, x);
    println!("thigh {:.3}, knee {:.3}, elbow {:.3}", at(hip.midpoint(knee)), at(knee), at(elbow));
    assert!(at(hip.midpoint(knee)) > 0.8 && at(knee) < 0.2 && at(elbow) < 0.2);
    assert!(at(volume.max + 0.1) == 0.0 && at(volume.min - 0.1) == 0.0);
}

/// Oracle: every channel sampled by its definition, in f64.
fn plain_map(volume: &WeightVolume, to_canonical: &[Affine3A], x: Vec3) -> ([f64; 3], f64) {
    let n = volume.resolution;
    let mut sum = 0.0;
    let mut mean = [0.0; 3];
    for (bone, t) in to_canonical.iter().enumerate() {
        let y = t.transform_point3(x);
        let at = (y - volume.min) / (volume.max - volume.min) * (n - 1) as f32;
        if at.min_element() < 0.0 || at.max_element() > (n - 1) as f32 {
            continue;
        }
        let mut w = 0.0;
        for corner in 0..8 {
            let mut index = 0;
            let mut mix = 1.0;
            for axis in (0..3).rev() {
                let base = (at[axis] as usize).min(n - 2);
                let t = f64::from(at[axis]) - base as f64;
                let up = corner >> axis & 1;
                index = index * n + base + up;
                mix *= if up == 1 { t } else { 1.0 - t };
            }
            w += mix * f64::from(volume.weights[bone * n * n * n + index]);
        }
        sum += w;
        for axis in 0..3 {
            mean[axis] += w * f64::from(y[axis]);
        }
    }
    (mean.map(|m| m / sum), sum.min(1.0))
}

/// A small volume with bones that disagree, and where to sample it.
fn small() -> (WeightVolume, Vec<Affine3A>) {
    let (body, shaped) = &*BODY;
    let mut volume = WeightVolume::gaussian(body, shaped, 6);
    for (i, d) in volume.delta.iter_mut().enumerate() {
        *d = (i as f32 * 0.37).sin();
    }
    volume.update();
    let pose: Vec<Vec3> = (0..24).map(|i| Vec3::new(0.2, 0.1, -0.1) * ((i * 7) % 5) as f32 * 0.3).collect();
    let posed = body.pose(shaped, &pose, Placement::default());
    (volume, posed.to_canonical())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn mapping_equals_its_definition(x in testkit::strategy::vec3(1.5)) {
        let (volume, bones) = small();
        let (canonical, f) = plain_map(&volume, &bones, x);
        match volume.map(&bones, x, 1e-3) {
            Some(sample) => {
                prop_assert!((f64::from(sample.likelihood) - f).abs() < 1e-5);
                for axis in 0..3 {
                    prop_assert!((f64::from(sample.canonical[axis]) - canonical[axis]).abs() < 2e-4 / f.min(1.0));
                }
            }
            None => prop_assert!(f < 1.01e-3),
        }
    }
}

#[test]
fn update_is_a_softmax() {
    let (volume, _) = small();
    let samples = volume.resolution.pow(3);
    for i in 0..samples {
        let logits: Vec<f64> = (0..volume.channels)
            .map(|c| f64::from(volume.log_prior[c * samples + i]) + f64::from(volume.delta[c * samples + i]))
            .collect();
        let total: f64 = logits.iter().map(|l| l.exp()).sum();
        for (c, logit) in logits.iter().enumerate() {
            let w = f64::from(volume.weights[c * samples + i]);
            assert!((w - logit.exp() / total).abs() < 1e-6);
        }
    }
}

#[test]
fn gradients_with_respect_to_the_weights_agree_with_finite_differences() {
    let (volume, bones) = small();
    let (d_canonical, d_likelihood) = (Vec3::new(0.7, -1.1, 0.4), 0.9);
    let mut checked = 0;
    for i in 0..40 {
        let t = i as f32;
        let x = Vec3::new((t * 0.7).sin() * 0.4, (t * 1.1).cos() * 0.8, (t * 0.3).sin() * 0.15);
        let mut d_weights = vec![0.0; volume.weights.len()];
        volume.map_backward(&bones, x, d_canonical, d_likelihood, &mut d_weights);
        let (_, f) = plain_map(&volume, &bones, x);
        // Off the kink of min(Σ w, 1), and where dividing by Σ w does not blow up rounding.
        if !(0.1..0.98).contains(&f) {
            continue;
        }
        let touched: Vec<usize> = (0..d_weights.len()).filter(|&i| d_weights[i] != 0.0).collect();
        if touched.is_empty() {
            continue;
        }
        let start: Vec<f32> = touched.iter().map(|&i| volume.weights[i]).collect();
        let analytic: Vec<f32> = touched.iter().map(|&i| d_weights[i]).collect();
        let mut moved = volume.clone();
        let loss = |w: &[f32]| {
            for (&i, &w) in touched.iter().zip(w) {
                moved.weights[i] = w;
            }
            let (canonical, f) = plain_map(&moved, &bones, x);
            let dot: f64 = (0..3).map(|a| canonical[a] * f64::from(d_canonical[a])).sum();
            dot + f * f64::from(d_likelihood)
        };
        // The oracle is in f64: the third-order term remains.
        let tolerance = Tolerance { abs: 2e-5, rel: 1e-3 };
        check("map", &start, &analytic, 1e-3, tolerance, loss).unwrap();
        checked += 1;
    }
    assert!(checked >= 5, "only {checked} points were usable");
}

#[test]
fn likelihood_has_no_gradient_where_it_is_capped() {
    let (body, shaped) = &*BODY;
    let mut volume = WeightVolume::gaussian(body, shaped, 8);
    volume.weights.iter_mut().for_each(|w| *w = 1.0);
    let mut d_weights = vec![0.0; volume.weights.len()];
    volume.map_backward(&IDENTITY, shaped.joints[0], Vec3::ZERO, 1.0, &mut d_weights);
    assert!(d_weights.iter().all(|&d| d == 0.0));
}

#[test]
fn gradients_with_respect_to_delta_agree_with_finite_differences() {
    let (mut volume, _) = small();
    let samples = volume.resolution.pow(3);
    let d_weights: Vec<f32> = (0..volume.weights.len()).map(|i| (i as f32 * 1.7).cos()).collect();
    let mut d_delta = vec![0.0; volume.weights.len()];
    volume.softmax_backward(&d_weights, &mut d_delta);
    // Samples where several channels compete.
    let channels = volume.channels;
    let at = |i: usize| (0..channels).map(move |c| c * samples + i);
    let alive = |i: usize| at(i).filter(|&j| volume.weights[j] > 0.02).count();
    let chosen: Vec<usize> = (0..samples).filter(|&i| alive(i) > 2).take(6).collect();
    assert_eq!(chosen.len(), 6);
    for i in chosen {
        let indices: Vec<usize> = at(i).collect();
        let start: Vec<f32> = indices.iter().map(|&j| volume.delta[j]).collect();
        let analytic: Vec<f32> = indices.iter().map(|&j| d_delta[j]).collect();
        let loss = |delta: &[f32]| {
            for (&j, &d) in indices.iter().zip(delta) {
                volume.delta[j] = d;
            }
            volume.update();
            indices.iter().map(|&j| f64::from(volume.weights[j]) * f64::from(d_weights[j])).sum()
        };
        // Weights are f32 of size 1: 6e-8 of rounding over a step of 1e-2.
        let tolerance = Tolerance { abs: 3e-5, rel: 1e-3 };
        check("softmax", &start, &analytic, 1e-2, tolerance, loss).unwrap();
        for (&j, &d) in indices.iter().zip(&start) {
            volume.delta[j] = d;
        }
        volume.update();
    }
}

#[test]
fn backward_accumulates() {
    let (volume, bones) = small();
    let x = BODY.1.joints[0];
    let mut once = vec![0.0; volume.weights.len()];
    volume.map_backward(&bones, x, Vec3::ONE, 1.0, &mut once);
    let mut twice = once.clone();
    volume.map_backward(&bones, x, Vec3::ONE, 1.0, &mut twice);
    assert!(once.iter().any(|&d| d != 0.0));
    assert!(once.iter().zip(&twice).all(|(a, b)| *b == 2.0 * a));
}

#[test]
fn points_outside_the_volume_are_dead() {
    let (volume, bones) = small();
    for x in [Vec3::NAN, Vec3::INFINITY, Vec3::splat(1e30), Vec3::splat(50.0)] {
        assert_eq!(volume.map(&bones, x, 0.0), None, "{x}");
        let mut d_weights = vec![0.0; volume.weights.len()];
        volume.map_backward(&bones, x, Vec3::ONE, 1.0, &mut d_weights);
        assert!(d_weights.iter().all(|&d| d == 0.0));
    }
    let inside = BODY.1.joints[0];
    let sum = volume.map(&IDENTITY, inside, 0.0).unwrap().likelihood;
    assert!(sum < 1.0 && volume.map(&IDENTITY, inside, 0.9 * sum).is_some());
    assert_eq!(volume.map(&IDENTITY, inside, 1.1 * sum), None, "a threshold above Σ w");
}
