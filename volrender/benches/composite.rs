//! Compositing 6144 rays (six patches of 32×32) of 128 samples, forward and backward, and SSIM of
//! 256×256 images, on two threads. items/s are samples and pixels.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use glam::Vec3;
use rayon::prelude::*;
use testkit::body::Random;
use volrender::{RaySamples, SampleGradients, composite, composite_backward, metrics};

const RAYS: usize = 6 * 32 * 32;
const SAMPLES: usize = 128;
const TOTAL: usize = RAYS * SAMPLES;
/// Width and height of the images.
const SIDE: usize = 256;

fn main() {
    let _ = rayon::ThreadPoolBuilder::new().num_threads(2).build_global();
    divan::main();
}

/// Rays through empty space, a soft surface and an opaque inside.
struct Rays {
    sigma: Vec<f32>,
    likelihood: Vec<f32>,
    delta: Vec<f32>,
    t: Vec<f32>,
    rgb: Vec<Vec3>,
}

impl Rays {
    fn new() -> Self {
        let mut numbers = Random(1);
        let mut random = || numbers.unit();
        let place = |i: usize| (i % SAMPLES) as f32 / SAMPLES as f32;
        Self {
            sigma: (0..TOTAL).map(|i| 100.0 * (place(i) - 0.3).max(0.0) * random()).collect(),
            likelihood: (0..TOTAL).map(|_| 1.0 - 0.2 * random()).collect(),
            delta: vec![1.0 / SAMPLES as f32; TOTAL],
            t: (0..TOTAL).map(|i| 2.0 + place(i)).collect(),
            rgb: (0..TOTAL).map(|_| Vec3::new(random(), random(), random())).collect(),
        }
    }
}

#[divan::bench]
fn forward_and_backward(bencher: Bencher<'_, '_>) {
    let Rays { sigma, likelihood, delta, t, rgb } = &Rays::new();
    let samples = RaySamples { sigma, likelihood, delta, t, rgb };
    let (mut weights, mut d_sigma, mut d_likelihood) = (vec![0.0; TOTAL], vec![0.0; TOTAL], vec![0.0; TOTAL]);
    let mut d_rgb = vec![Vec3::ZERO; TOTAL];
    bencher.counter(ItemsCount::new(TOTAL)).bench_local(|| {
        weights
            .par_chunks_mut(SAMPLES)
            .zip(d_sigma.par_chunks_mut(SAMPLES))
            .zip(d_rgb.par_chunks_mut(SAMPLES))
            .zip(d_likelihood.par_chunks_mut(SAMPLES))
            .enumerate()
            .with_min_len(64)
            .for_each(|(i, (((weights, d_sigma), d_rgb), d_likelihood))| {
                let samples = samples.slice(i * SAMPLES..(i + 1) * SAMPLES);
                let pixel = composite(samples, Vec3::ONE, weights);
                let (d_color, d_opacity) = (2.0 * (pixel.color - 0.5), 0.1);
                let gradients = SampleGradients { d_sigma, d_rgb, d_likelihood };
                composite_backward(samples, Vec3::ONE, weights, d_color, d_opacity, gradients);
            });
    });
}

#[divan::bench]
fn ssim(bencher: Bencher<'_, '_>) {
    let pattern = |seed: usize| -> Vec<f32> {
        (0..3 * SIDE * SIDE).map(|i| ((i * 7919 + seed) % 1009) as f32 / 1009.0).collect()
    };
    let (a, b) = (pattern(0), pattern(104_729));
    bencher.counter(ItemsCount::new(SIDE * SIDE)).bench_local(|| metrics::ssim(black_box(&a), &b, SIDE, SIDE));
}
