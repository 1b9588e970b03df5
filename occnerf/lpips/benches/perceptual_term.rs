//! The perceptual term of a training step: six patches of 32 × 32, features of prediction and
//! target and the gradient by the prediction. VGG16 and the others with random weights, two
//! threads.
//!
//! `cargo bench -p lpips`: items/s are pixels of the prediction.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use divan::Bencher;
use divan::counter::ItemsCount;
use lpips::{Lpips, Trunk};
use testkit::body::Random;

const PATCHES: usize = 6;
const SIZE: usize = 32;

fn main() {
    let _ = rayon::ThreadPoolBuilder::new().num_threads(2).build_global();
    divan::main();
}

fn network(trunk: Trunk) -> Lpips {
    let mut random = Random(0);
    Lpips::new(trunk, |_, shape| {
        let scale = 2.0 * (6.0 / shape[1..].iter().product::<usize>() as f32).sqrt();
        Ok((0..shape.iter().product()).map(|_| scale * (random.unit() - 0.5)).collect())
    })
    .unwrap()
}

fn noise(count: usize, seed: u64) -> Vec<f32> {
    let mut random = Random(seed);
    (0..count).map(|_| random.unit()).collect()
}

#[divan::bench(args = [Trunk::Vgg16, Trunk::AlexNet, Trunk::SqueezeNet], sample_size = 1, sample_count = 24)]
fn perceptual_term(bencher: Bencher<'_, '_>, trunk: Trunk) {
    let lpips = network(trunk);
    let [a, b] = [1, 2].map(|seed| noise(PATCHES * SIZE * SIZE * 3, seed));
    let mut d_a = vec![0.0; a.len()];
    bencher
        .counter(ItemsCount::new(PATCHES * SIZE * SIZE))
        .bench_local(|| lpips.distance_backward(&a, &b, SIZE, SIZE, 1.0, &mut d_a).unwrap());
}

/// Distance of two images of 256 × 256, as in scoring.
#[divan::bench(args = [Trunk::Vgg16, Trunk::AlexNet, Trunk::SqueezeNet], sample_size = 1, sample_count = 5)]
fn picture(bencher: Bencher<'_, '_>, trunk: Trunk) {
    let lpips = network(trunk);
    let [a, b] = [1, 2].map(|seed| noise(256 * 256 * 3, seed));
    bencher.bench_local(|| lpips.distance(&a, &b, 256, 256).unwrap());
}
