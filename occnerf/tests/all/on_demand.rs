//! Captures whose pictures do not all fit in memory train as those do that fit.

use crate::common;

use common::config;
use occnerf::capture::{Capture, Layout, LoadOptions, load_capture};
use occnerf::{FieldRenderer, Method, PriorColors, Scene, Trainer, evaluate};
use smpl::BodyModel;
use synth::{SynthConfig, synthesise};
use testkit::files::Directory;

const SIZE: u32 = 32;
const STEPS: u64 = 8;

/// A capture on disk, read with room for this many bytes of pictures and to decode one.
fn read(dir: &Directory, body: &BodyModel, room: u64) -> Capture {
    let bodies = 8 * body.num_vertices() as u64 * 24;
    let picture = u64::from(SIZE * SIZE) * 16;
    let max_bytes = bodies + 4 * picture.div_ceil(42) + 3 * picture + room;
    load_capture(&dir.file("capture"), body, &LoadOptions { max_bytes, ..LoadOptions::default() }).unwrap()
}

/// Checkpoint after all steps, and the scores of the views kept back.
fn trained(dir: &Directory, trainer: &Trainer<'_>, scene: &Scene) -> (Vec<u8>, Option<f64>) {
    trainer.save(&dir.file("checkpoint")).unwrap();
    let frames: Vec<_> = scene.eval.iter().collect();
    let scores = evaluate(scene, &mut FieldRenderer::new(trainer.model()).unwrap(), &frames, None, |_, _| {}).unwrap();
    (std::fs::read(dir.file("checkpoint")).unwrap(), scores.psnr_mask)
}

#[test]
fn training_from_files_is_training_from_memory() {
    let dir = Directory::new("on-demand");
    let synth = SynthConfig { size: SIZE, frames: 4, eval_cameras: 2, eval_every: 2, ..SynthConfig::default() };
    let made = synthesise(None, None, &synth, &|_| {}).unwrap();
    made.write(&dir.file("capture"), Layout::HumanNerf, &|_| {}).unwrap();
    let config = occnerf::Config { steps: STEPS, ..config(Method::Occnerf) };

    // Eight pictures, and a quarter again for decoding.
    let capture = read(&dir, &made.body, 11 * u64::from(SIZE * SIZE) * 16);
    assert_eq!((capture.train.len(), capture.eval.len()), (4, 4));
    let scene = Scene::new(&capture, &made.body, &config).unwrap();
    let mut trainer = Trainer::new(&scene, config.clone()).unwrap();
    (0..STEPS).for_each(|_| assert!(trainer.step().unwrap().loss.is_finite()));
    let in_memory = trained(&dir, &trainer, &scene);

    // Packed they have room in an eighth of it, and are not read again.
    let capture = read(&dir, &made.body, u64::from(SIZE * SIZE) * 16);
    let packed = Scene::new(&capture, &made.body, &config).unwrap();
    let mut trainer = Trainer::new(&packed, config.clone()).unwrap();
    let (all, hidden) = (dir.file("capture/images"), dir.file("hidden"));
    std::fs::rename(&all, &hidden).unwrap();
    (0..STEPS).for_each(|_| assert!(trainer.step().unwrap().loss.is_finite()));
    assert!(trained(&dir, &trainer, &packed) == in_memory);
    std::fs::rename(&hidden, &all).unwrap();

    let capture = read(&dir, &made.body, 0);
    let few = Scene::new(&capture, &made.body, &config).unwrap();
    assert_eq!(PriorColors::measure(&few).unwrap(), PriorColors::measure(&scene).unwrap());
    let mut trainer = Trainer::new(&few, config).unwrap();
    // A picture that goes missing stops training where it was, and nothing is lost when it comes
    // back.
    let (picture, away) = (dir.file("capture/images/frame_000002.png"), dir.file("away.png"));
    let mut missed = 0;
    while trainer.steps_done() < STEPS {
        if trainer.steps_done() == 2 && missed == 0 {
            std::fs::rename(&picture, &away).unwrap();
        }
        if let Err(error) = trainer.step() {
            assert!(error.to_string().contains("frame_000002.png"), "{error}");
            missed += 1;
            std::fs::rename(&away, &picture).unwrap();
        }
    }
    assert_eq!(missed, 1);
    assert!(trained(&dir, &trainer, &few) == in_memory);
    std::fs::remove_file(&picture).unwrap();
    let message = PriorColors::measure(&few).unwrap_err().to_string();
    assert!(message.contains("frame_000002.png"), "{message}");
}
