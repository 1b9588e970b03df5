//! The perceptual term of a training step: six patches of 32 × 32, features of prediction and
//! target and the gradient by the prediction. VGG16 and the others with random weights, two
//! threads.
//!
//! `cargo bench -p lpips`: items/s are pixels of the prediction.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use divan::Bencher;
use divan::counter::ItemsCount;
use lpips::{Lpips, Trunk};

const PATCHES: usize = 6;
const SIZE: usize = 32;

fn main() {
    let _ = rayon::ThreadPoolBuilder::new().num_threads(2).build_global();
    divan::main();
}

/// In [0, 1), from SplitMix64's finaliser.
fn random(address: usize) -> f32 {
    let mut x = (address as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    (x >> 40) as f32 * (1.0 / 16_777_216.0)
}

fn network(trunk: Trunk) -> Lpips {
    Lpips::new(trunk, |_, shape| {
        let scale = 2.0 * (6.0 / shape[1..].iter().product::<usize>() as f32).sqrt();
        Ok((0..shape.iter().product()).map(|i| scale * (random(i) - 0.5)).collect())
    })
    .unwrap()
}

fn patches(seed: usize) -> Vec<f32> {
    (0..PATCHES * SIZE * SIZE * 3).map(|i| random(seed << 40 | i)).collect()
}

#[divan::bench(args = [Trunk::Vgg16, Trunk::AlexNet, Trunk::SqueezeNet], sample_size = 1, sample_count = 24)]
fn perceptual_term(bencher: Bencher<'_, '_>, trunk: Trunk) {
    let (lpips, a, b) = (network(trunk), patches(1), patches(2));
    let mut d_a = vec![0.0; a.len()];
    bencher
        .counter(ItemsCount::new(PATCHES * SIZE * SIZE))
        .bench_local(|| lpips.distance_backward(&a, &b, SIZE, SIZE, 1.0, &mut d_a).unwrap());
}

/// Distance of two images of 256 × 256, as in scoring.
#[divan::bench(args = [Trunk::Vgg16, Trunk::AlexNet, Trunk::SqueezeNet], sample_size = 1, sample_count = 5)]
fn picture(bencher: Bencher<'_, '_>, trunk: Trunk) {
    let lpips = network(trunk);
    let [a, b] = [1, 2].map(|seed| (0..256 * 256 * 3).map(|i| random(seed << 40 | i)).collect::<Vec<_>>());
    bencher.bench_local(|| lpips.distance(&a, &b, 256, 256).unwrap());
}
