//! Cost of drawing a baked person, skinning included: the demo's person after a few steps.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed bench")]

use std::sync::OnceLock;

use divan::Bencher;
use glam::Affine3A;
use occnerf::bake::{Avatar, BakedRenderer, bake};
use occnerf::{Config, Method, Model, Preset, Scene, Trainer};
use visibility::Samples;
use volrender::Camera;

/// Enough for a surface near the prior; drawing time does not depend on its quality.
const STEPS: u64 = 60;

fn main() {
    divan::main();
}

struct Trained {
    scene: Scene,
    model: Model,
}

fn trained() -> &'static Trained {
    static TRAINED: OnceLock<Trained> = OnceLock::new();
    TRAINED.get_or_init(|| {
        let body = smpl::BodyModel::embedded();
        let demo = synth::DemoConfig { eval_cameras: 1, frames: 12, ..synth::DemoConfig::default() };
        let config = Config { steps: STEPS, ..Config::preset(Preset::Fast, Method::Occnerf) };
        let scene = Scene::new(&synth::demo(&demo, &body).unwrap(), &body, &config).unwrap();
        let mut trainer = Trainer::new(&scene, config).unwrap();
        for _ in 0..STEPS {
            trainer.step().unwrap();
        }
        let model = trainer.into_model();
        Trained { scene, model }
    })
}

fn avatar() -> &'static Avatar {
    static AVATAR: OnceLock<Avatar> = OnceLock::new();
    AVATAR.get_or_init(|| bake(&trained().model, Some(&trained().scene)).unwrap().0)
}

/// On one thread.
fn draw(bencher: Bencher<'_, '_>, samples: Samples, size: (u32, u32)) {
    let model = &trained().model;
    let mut renderer = BakedRenderer::new(avatar(), model.body().scale, model.light(), samples);
    let view = &model.frames()[0];
    let bones: Vec<Affine3A> = view.posed.bones.clone();
    // As high as the square picture, in the middle of a wide one.
    let mut camera: Camera = view.camera.resized(size.1, size.1);
    camera.centre.x += (size.0 - size.1) as f32 / 2.0;
    camera.width = size.0;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    bencher.bench_local(|| pool.install(|| renderer.draw(&bones, &camera).map(drop)).unwrap());
}

const SIZES: [(u32, u32); 4] = [(256, 256), (512, 512), (1024, 1024), (1920, 1080)];

/// One surface, one thread.
#[divan::bench(args = SIZES)]
fn one_surface_one_thread(bencher: Bencher<'_, '_>, size: (u32, u32)) {
    draw(bencher, Samples::One, size);
}

/// One surface, four samples a pixel, one thread.
#[divan::bench(args = SIZES)]
fn one_surface_four_samples_one_thread(bencher: Bencher<'_, '_>, size: (u32, u32)) {
    draw(bencher, Samples::Four, size);
}
