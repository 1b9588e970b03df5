//! Metrics against scikit-image (`reference/ssim.py`) and the test kit's reference.

use approx::abs_diff_eq;
use proptest::prelude::*;
use testkit::oracle;
use volrender::metrics::{psnr, psnr_masked, ssim, ssim_masked};

/// The generator of `reference/ssim.py`.
fn noise(n: usize, seed: u64) -> Vec<f32> {
    let mut state = seed;
    (0..n)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u32 << 24) as f32
        })
        .collect()
}

fn pair(kind: &str, width: usize, height: usize) -> (Vec<f32>, Vec<f32>) {
    let n = width * height * 3;
    let (a, b) = (noise(n, 1), noise(n, 2));
    let scaled = |x: &[f32]| x.iter().map(|x| x / 64.0).collect();
    match kind {
        "noise" => (a, b),
        "close" => {
            let mixed = a.iter().zip(&b).map(|(a, b)| a * 0.875 + b * 0.125).collect();
            (a, mixed)
        }
        "dark" => (scaled(&a), scaled(&b)),
        "flat" => (vec![0.5; n], vec![0.25; n]),
        _ => panic!("no such pair: {kind}"),
    }
}

fn mask(width: usize, height: usize) -> Vec<bool> {
    (0..width * height).map(|i| ((i % width) * 3 + (i / width) * 5) % 7 < 3).collect()
}

/// SSIM around one pixel.
fn ssim_at(a: &[f32], b: &[f32], width: usize, height: usize, pixel: usize) -> f64 {
    let mask: Vec<bool> = (0..width * height).map(|i| i == pixel).collect();
    ssim_masked(a, b, &mask, width, height).expect("a pixel")
}

#[test]
fn ssim_equals_scikit_image() {
    // Both sides compute in f64; the reference is printed with 12 decimals.
    const TOLERANCE: f64 = 1e-10;
    let mut cases = 0;
    for line in include_str!("reference/ssim.txt").lines() {
        let mut words = line.split(' ');
        let kind = words.next().unwrap();
        let numbers: Vec<f64> = words.map(|word| word.parse().unwrap()).collect();
        let (width, height) = (numbers[0] as usize, numbers[1] as usize);
        let (a, b) = pair(kind, width, height);
        let close = |what: &str, got: f64, expected: f64, tolerance: f64| {
            assert!(abs_diff_eq!(got, expected, epsilon = tolerance), "{line}\n{what}: {got}");
        };
        close("ssim", ssim(&a, &b, width, height).unwrap(), numbers[2], TOLERANCE);
        let masked = ssim_masked(&a, &b, &mask(width, height), width, height).unwrap();
        close("masked", masked, numbers[3], TOLERANCE);
        let pixels = [0, width / 2, height / 2 * width + width / 2, width * height - 1];
        for (pixel, expected) in pixels.into_iter().zip(&numbers[4..]) {
            close("map", ssim_at(&a, &b, width, height, pixel), *expected, TOLERANCE);
        }
        cases += 1;
    }
    assert_eq!(cases, 12);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn images_smaller_than_the_window_are_mirrored_at_their_borders(width in 1usize..12, height in 1usize..12, seed: u64) {
        let (a, b) = (noise(3 * width * height, seed), noise(3 * width * height, !seed));
        for (pixel, plain) in oracle::ssim_map(&a, &b, width, height).into_iter().enumerate() {
            prop_assert!(abs_diff_eq!(ssim_at(&a, &b, width, height, pixel), plain, epsilon = 1e-10));
        }
    }

    #[test]
    fn masked_psnr_is_the_psnr_of_the_pixels_in_the_mask(width in 1usize..12, height in 1usize..12, seed: u64) {
        let (a, b) = (noise(3 * width * height, seed), noise(3 * width * height, !seed));
        prop_assert!(abs_diff_eq!(psnr(&a, &b), oracle::psnr(&a, &b), epsilon = 1e-9));
        let mask = mask(width, height);
        let picked = |image: &[f32]| -> Vec<f32> {
            let pixels = image.chunks(3).zip(&mask);
            pixels.filter(|(_, inside)| **inside).flat_map(|(pixel, _)| pixel.to_vec()).collect()
        };
        let expected = oracle::psnr(&picked(&a), &picked(&b));
        prop_assert!(abs_diff_eq!(psnr_masked(&a, &b, &mask).unwrap(), expected, epsilon = 1e-9));
    }
}

#[test]
fn empty_masks_and_images_below_the_window_have_no_score() {
    let a = noise(3 * 6 * 20, 1);
    let too_small = ssim(&a, &a, 6, 20).unwrap_err();
    assert_eq!(too_small.to_string(), "an image of 6×20 pixels is smaller than 7×7");
    assert_eq!(psnr_masked(&a, &a, &[false; 120]), None);
    assert_eq!(ssim_masked(&a, &a, &[false; 120], 6, 20), None);
    assert!(psnr(&[], &[]).is_nan());
}

#[test]
fn a_nan_pixel_affects_only_the_windows_that_contain_it() {
    let mut a = noise(3 * 20 * 20, 1);
    let b = a.clone();
    a[3 * (10 * 20 + 10)] = f32::NAN;
    for i in 0..20 * 20usize {
        let near = (i % 20).abs_diff(10) <= 3 && (i / 20).abs_diff(10) <= 3;
        assert_eq!(ssim_at(&a, &b, 20, 20, i).is_nan(), near, "pixel {i}");
    }
}

#[test]
#[should_panic(expected = "expected 3 × 7 × 8")]
fn an_image_of_the_wrong_size_panics() {
    let _ = ssim(&[0.0; 147], &[0.0; 147], 7, 8);
}
