//! Values and gradients of another implementation in double precision, and properties that any
//! distance has.

use array_files::npz::Npz;
use lpips::{Lpips, Trunk};
use safetensors::SafeTensors;
use testkit::gradient::{Tolerance, assert_gradient};

use crate::formula::{network, tensor, weight};
use crate::{noise, shared};

/// (N, 3, H, W) in [−1, 1] to (N, H, W, 3) in [0, 1], and N, H, W.
fn pictures(golden: &mut Npz, key: &str, half: bool) -> ([usize; 3], Vec<f32>) {
    let (shape, values) = golden.f32(key, &[None, Some(3), None, None]).unwrap();
    let (n, h, w) = (shape[0], shape[2], shape[3]);
    let mut out = vec![0.0; values.len()];
    for (i, v) in values.iter().enumerate() {
        let (image, channel, pixel) = (i / (3 * h * w), i / (h * w) % 3, i % (h * w));
        out[(image * h * w + pixel) * 3 + channel] = if half { 0.5 * v + 0.5 } else { *v };
    }
    ([n, h, w], out)
}

fn compare(lpips: &Lpips, golden: &mut Npz, name: &str, set: &str) {
    let ([_, h, w], a) = pictures(golden, &format!("a_{set}"), true);
    let (_, b) = pictures(golden, &format!("b_{set}"), true);
    let expected = golden.array(&format!("lpips_{name}_{set}")).unwrap().to_f64();
    let len = expected.len() * h * w * 3;
    let values = lpips.distance(&a[..len], &b[..len], w, h).unwrap();
    for (i, (value, expected)) in values.iter().zip(&expected).enumerate() {
        assert!((value - expected).abs() < 2e-4, "{name} {set}, pair {i}: {value}, expected {expected}");
    }
    let key = format!("grad_a_{name}_{set}");
    if !golden.keys().contains(&key) {
        return;
    }
    // By x in [−1, 1]; ours is by x in [0, 1].
    let (_, expected) = pictures(golden, &key, false);
    let len = expected.len();
    let mut d_a = vec![0.0; len];
    let again = lpips.distance_backward(&a[..len], &b[..len], w, h, 0.5, &mut d_a).unwrap();
    assert_eq!(again, values[..again.len()], "the value beside the gradient is the value");
    let error = d_a.iter().zip(&expected).map(|(d, e)| f64::from(d - e).powi(2)).sum::<f64>().sqrt();
    let size = expected.iter().map(|e| f64::from(*e).powi(2)).sum::<f64>().sqrt();
    println!("{name} {set}: relative error of the gradient {:.1e}", error / size);
    assert!(error < 1e-3 * size, "{name} {set}: gradient off by {error:.3e} of {size:.3e}");
}

#[test]
fn squeezenet_gives_the_golden_values_and_gradients() {
    let (Some(weights), Some(golden)) = (shared("squeezenet1_1_lpips.safetensors"), shared("golden.npz")) else {
        return;
    };
    let lpips = Lpips::load(&weights).unwrap();
    assert_eq!(lpips.name(), "squeezenet");
    let mut golden = Npz::open(&golden).unwrap();
    for set in ["64", "32", "hw"] {
        compare(&lpips, &mut golden, "squeeze", set);
    }
}

#[test]
fn vgg16_of_formula_weights_gives_the_golden_values_and_gradients() {
    let (Some(lin), Some(golden)) = (shared("lin_vgg.safetensors"), shared("golden.npz")) else { return };
    let mut golden = Npz::open(&golden).unwrap();
    let probe = golden.f32("vgg_weight_probe", &[Some(5)]).unwrap().1;
    let ours = [
        weight(0, false, 27, 0),
        weight(0, false, 27, 100),
        weight(0, true, 0, 3),
        weight(28, false, 512 * 9, 2_359_295),
        weight(28, true, 0, 511),
    ];
    assert_eq!(ours, probe[..]);
    let bytes = std::fs::read(lin).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let mut lin = |name: &str| -> Vec<f32> {
        let view = file.tensor(name).unwrap();
        view.data().as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
    };
    let lpips = Lpips::new(Trunk::Vgg16, |name, shape| Ok(tensor(name, shape, &mut lin))).unwrap();
    for set in ["64", "32"] {
        compare(&lpips, &mut golden, "vggformula", set);
    }
}

#[test]
fn gradients_of_every_trunk_agree_with_central_differences() {
    for trunk in [Trunk::SqueezeNet, Trunk::AlexNet, Trunk::Vgg16] {
        let lpips = network(trunk);
        let (w, h) = (35, 32);
        let (a, b) = (noise(3 * w * h, 1), noise(3 * w * h, 2));
        let mut d_a = vec![0.0; a.len()];
        lpips.distance_backward(&a, &b, w, h, 1.0, &mut d_a).unwrap();
        // Along smooth directions: single pixels of noise meet a kink within any step that single
        // precision resolves.
        let waves: Vec<Vec<f32>> = (0..4)
            .map(|k| (0..a.len()).map(|i| ((i / 3 % w + k * (i / 3 / w)) as f32 * 0.2 + k as f32).sin()).collect())
            .collect();
        let along = |x: &[f32]| -> Vec<f32> {
            a.iter()
                .enumerate()
                .map(|(i, a)| a + waves.iter().zip(x).map(|(wave, x)| x * wave[i]).sum::<f32>())
                .collect()
        };
        let analytic: Vec<f32> =
            waves.iter().map(|wave| wave.iter().zip(&d_a).map(|(w, d)| f64::from(w * d)).sum::<f64>() as f32).collect();
        let size = analytic.iter().fold(0.0f32, |m, d| m.max(d.abs()));
        let tolerance = Tolerance { abs: 0.03 * f64::from(size), rel: 0.02 };
        assert_gradient(trunk.name(), &[0.0; 4], &analytic, 1e-4, tolerance, |x| {
            lpips.distance(&along(x), &b, w, h).unwrap()[0]
        });
    }
}

#[test]
fn equal_pictures_are_at_no_distance_and_have_no_gradient_whatever_they_show() {
    let lpips = network(Trunk::AlexNet);
    for a in [vec![0.0; 3 * 40 * 40], vec![1.0; 3 * 40 * 40], noise(3 * 40 * 40, 3)] {
        let mut d_a = vec![0.0; a.len()];
        assert_eq!(lpips.distance_backward(&a, &a, 40, 40, 1.0, &mut d_a).unwrap(), [0.0]);
        assert!(d_a.iter().all(|&d| d == 0.0));
    }
}

#[test]
fn a_picture_counts_the_same_alone_and_among_others_and_either_way_round() {
    let lpips = network(Trunk::SqueezeNet);
    let (w, h, len) = (33, 47, 3 * 33 * 47);
    let (a, b) = (noise(9 * len, 4), noise(9 * len, 5));
    let mut d_all = vec![0.0; a.len()];
    let all = lpips.distance_backward(&a, &b, w, h, 1.0, &mut d_all).unwrap();
    assert_eq!(all, lpips.distance(&b, &a, w, h).unwrap());
    for i in [0, 5, 8] {
        let range = i * len..(i + 1) * len;
        let mut d_one = vec![0.0; len];
        let one = lpips.distance_backward(&a[range.clone()], &b[range.clone()], w, h, 1.0, &mut d_one).unwrap();
        assert_eq!(one, all[i..i + 1]);
        assert_eq!(d_one, d_all[range]);
    }
}

#[test]
fn pictures_that_are_too_small_or_too_large_are_refused_with_the_size() {
    for (trunk, least) in [(Trunk::Vgg16, 16), (Trunk::AlexNet, 31), (Trunk::SqueezeNet, 17)] {
        let lpips = network(trunk);
        assert!(lpips.check_size(least, least).is_ok(), "{} {least}", trunk.name());
        let small = vec![0.0; 3 * least * (least - 1)];
        let error = lpips.distance(&small, &small, least, least - 1).unwrap_err().to_string();
        assert!(error.contains(&format!("{least} × {}", least - 1)), "{error}");
        assert!(error.contains(trunk.name()) && error.contains(&format!("at least {least} pixels")), "{error}");
        for (w, h) in [(0, 0), (0, 64), (1 << 20, 64), (usize::MAX, 2)] {
            assert!(lpips.check_size(w, h).is_err());
        }
        lpips.distance(&vec![0.5; 3 * least * least], &vec![0.1; 3 * least * least], least, least).unwrap();
    }
}
