//! A training step works in buffers that are kept from step to step.

use allocation_counter::measure;
use occnerf::{Config, Method, Preset, Scene, Trainer};
use smpl::BodyModel;
use synth::{DemoConfig, demo};

/// What is left are lists of a number or six for each joint; a batch larger than any before makes
/// buffers grow.
#[test]
fn a_step_allocates_next_to_nothing() {
    let mut config = Config::preset(Preset::Fast, Method::Occnerf);
    // Poses are taught from a tenth on, before the buffers are looked at.
    config.steps = 100;
    config.surface.surface_term = true;
    // The look at the shell, every 32 steps, is a pass of its own.
    config.motion.shell_interval = 0;
    let body = BodyModel::embedded();
    let capture = demo(&DemoConfig { size: 48, frames: 2, eval_cameras: 1, ..Default::default() }, &body).unwrap();
    let scene = Scene::new(&capture, &body, &config).unwrap();
    let mut trainer = Trainer::new(&scene, config).unwrap();
    // What counts allocations sees one thread.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let mut steps = |count: usize| (0..count).map(|_| trainer.step().unwrap().live_samples).sum::<usize>();
    pool.install(|| {
        assert!(steps(30) > 0);
        let quietest = (0..4).map(|_| measure(|| assert!(steps(5) > 0))).min_by_key(|found| found.count_total).unwrap();
        let (count, bytes) = (quietest.count_total / 5, quietest.bytes_total / 5);
        assert!(count < 16 && bytes < 16_384, "{count} allocations, {bytes} bytes a step");
    });
}
