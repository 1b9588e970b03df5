//! Compositing 6144 rays (six patches of 32×32) of 128 samples, forward and backward, on two
//! threads, against the definition. items/s are samples.

use divan::Bencher;
use divan::counter::ItemsCount;
use glam::Vec3;
use rayon::prelude::*;
use testkit::body::Random;
use volrender::{RaySamples, SampleGradients, composite, composite_backward};

const RAYS: usize = 6 * 32 * 32;
const SAMPLES: usize = 128;
const TOTAL: usize = RAYS * SAMPLES;

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

struct Outputs {
    weights: Vec<f32>,
    d_sigma: Vec<f32>,
    d_rgb: Vec<Vec3>,
    d_likelihood: Vec<f32>,
}

impl Outputs {
    fn new() -> Self {
        Self {
            weights: vec![0.0; TOTAL],
            d_sigma: vec![0.0; TOTAL],
            d_rgb: vec![Vec3::ZERO; TOTAL],
            d_likelihood: vec![0.0; TOTAL],
        }
    }
}

impl Rays {
    fn samples(&self, ray: std::ops::Range<usize>) -> RaySamples<'_> {
        let Self { sigma, likelihood, delta, t, rgb } = self;
        RaySamples { sigma, likelihood, delta, t, rgb }.slice(ray)
    }
}

type Run<'a> = dyn Fn(RaySamples<'_>, &mut [f32], SampleGradients<'_>) + Sync + 'a;

/// Calls `run` for each ray in parallel.
fn each_ray(rays: &Rays, out: &mut Outputs, run: &Run<'_>) {
    let Outputs { weights, d_sigma, d_rgb, d_likelihood } = out;
    weights
        .par_chunks_mut(SAMPLES)
        .zip(d_sigma.par_chunks_mut(SAMPLES))
        .zip(d_rgb.par_chunks_mut(SAMPLES))
        .zip(d_likelihood.par_chunks_mut(SAMPLES))
        .enumerate()
        .with_min_len(64)
        .for_each(|(i, (((weights, d_sigma), d_rgb), d_likelihood))| {
            let ray = i * SAMPLES..(i + 1) * SAMPLES;
            run(rays.samples(ray), weights, SampleGradients { d_sigma, d_rgb, d_likelihood });
        });
}

#[divan::bench]
fn forward_and_backward(bencher: Bencher<'_, '_>) {
    let (rays, mut out) = (Rays::new(), Outputs::new());
    bencher.counter(ItemsCount::new(TOTAL)).bench_local(|| {
        each_ray(&rays, &mut out, &|samples, weights, gradients| {
            let pixel = composite(samples, Vec3::ONE, weights);
            let d_color = 2.0 * (pixel.color - 0.5);
            composite_backward(samples, Vec3::ONE, weights, d_color, 0.1, gradients);
        });
    });
}

/// The definition: libm's exp, and a suffix sum divided by 1 − α.
#[divan::bench]
fn forward_and_backward_plain(bencher: Bencher<'_, '_>) {
    let (rays, mut out) = (Rays::new(), Outputs::new());
    bencher.counter(ItemsCount::new(TOTAL)).bench_local(|| {
        each_ray(&rays, &mut out, &|samples, weights, gradients| {
            let RaySamples { sigma, likelihood, delta, rgb, .. } = samples;
            let SampleGradients { d_sigma, d_rgb, d_likelihood } = gradients;
            let (mut color, mut transmittance) = (Vec3::ZERO, 1.0);
            for i in 0..SAMPLES {
                let alpha = likelihood[i] * (1.0 - (-sigma[i] * delta[i]).exp());
                weights[i] = transmittance * alpha;
                color += weights[i] * rgb[i];
                transmittance *= 1.0 - alpha;
            }
            let d_color = 2.0 * (color + transmittance * Vec3::ONE - 0.5);
            let mut behind = transmittance * d_color.element_sum();
            for i in (0..SAMPLES).rev() {
                let passed = (-sigma[i] * delta[i]).exp();
                let alpha = likelihood[i] * (1.0 - passed);
                transmittance /= 1.0 - alpha + 1e-10;
                let value = rgb[i].dot(d_color) + 0.1;
                let d_alpha = transmittance * value - behind / (1.0 - alpha + 1e-10);
                behind += weights[i] * value;
                d_sigma[i] = d_alpha * likelihood[i] * delta[i] * passed;
                d_likelihood[i] = d_alpha * (1.0 - passed);
                d_rgb[i] = weights[i] * d_color;
            }
        });
    });
}
