//! A training step and a rendered frame on the demo at its default size, 192 × 192, two threads.
//!
//! `cargo bench -p occnerf`: items/s are rays of a step, and pixels of a frame.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::sync::OnceLock;

use divan::Bencher;
use divan::counter::ItemsCount;
use glam::Vec3;
use occnerf::{Config, FieldRenderer, Method, Preset, Renderer, Scene, Trainer};
use synth::{DemoConfig, demo};

fn main() {
    let _ = rayon::ThreadPoolBuilder::new().num_threads(2).build_global();
    divan::main();
}

/// A few frames are enough: a step sees one of them.
fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| {
        let body = smpl::BodyModel::embedded();
        let config = DemoConfig { frames: 8, eval_cameras: 1, ..DemoConfig::default() };
        let capture = demo(&config, &body).unwrap();
        Scene::new(&capture, &body, &Config::preset(Preset::Fast, Method::Occnerf)).unwrap()
    })
}

fn trainer(preset: Preset) -> Trainer<'static> {
    let mut trainer = Trainer::new(scene(), Config::preset(preset, Method::Occnerf)).unwrap();
    // Buffers have grown to size, and the field is no longer the even fog it starts as.
    for _ in 0..8 {
        trainer.step().unwrap();
    }
    trainer
}

#[divan::bench_group(sample_size = 1, sample_count = 24)]
mod occnerf_demo {
    use super::*;

    #[divan::bench(args = [Preset::Fast, Preset::Balanced])]
    fn training_step(bencher: Bencher<'_, '_>, preset: Preset) {
        let mut trainer = trainer(preset);
        let config = trainer.model().config();
        let rays = config.patches * (config.patch_size * config.patch_size) as usize;
        bencher.counter(ItemsCount::new(rays)).bench_local(|| trainer.step().unwrap());
    }

    #[divan::bench(args = [Preset::Fast, Preset::Balanced])]
    fn rendered_frame(bencher: Bencher<'_, '_>, preset: Preset) {
        let trainer = trainer(preset);
        let mut renderer = FieldRenderer::new(trainer.model()).unwrap();
        let frame = &scene().eval[0];
        let pixels = (frame.view.camera.width * frame.view.camera.height) as usize;
        bencher.counter(ItemsCount::new(pixels)).bench_local(|| renderer.render(&frame.view, Vec3::ZERO).unwrap());
    }
}
