//! Metrics of 256×256 images on two threads, against the test kit's reference SSIM. items/s are pixels.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use volrender::metrics;

const SIDE: usize = 256;

fn main() {
    let _ = rayon::ThreadPoolBuilder::new().num_threads(2).build_global();
    divan::main();
}

fn images() -> (Vec<f32>, Vec<f32>) {
    let pattern = |seed: usize| (0..3 * SIDE * SIDE).map(|i| ((i * 7919 + seed) % 1009) as f32 / 1009.0).collect();
    (pattern(0), pattern(104_729))
}

#[divan::bench]
fn ssim(bencher: Bencher<'_, '_>) {
    let (a, b) = images();
    bencher.counter(ItemsCount::new(SIDE * SIDE)).bench_local(|| metrics::ssim(black_box(&a), &b, SIDE, SIDE));
}

#[divan::bench]
fn ssim_plain(bencher: Bencher<'_, '_>) {
    let (a, b) = images();
    bencher.counter(ItemsCount::new(SIDE * SIDE)).bench_local(|| testkit::oracle::ssim(black_box(&a), &b, SIDE, SIDE));
}
