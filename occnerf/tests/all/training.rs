//! Training: from files as from memory, with LPIPS as the perceptual term, without frames that are
//! held out to choose settings by, and in buffers that are kept from step to step.

use std::path::Path;

use allocation_counter::measure;
use common::{body, capture, config};
use occnerf::capture::{Capture, Layout, LoadOptions, Pixels, load_capture};
use occnerf::{
    Config, Error, FieldRenderer, Label, Lpips, Method, Preset, PriorColors, PriorRenderer, Scene, StepReport, Trainer,
    evaluate,
};
use smpl::BodyModel;
use synth::{DemoConfig, SynthConfig, demo, synthesise};
use testkit::files::Directory;

use crate::{common, formula};

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

/// Writes a SqueezeNet of formula weights.
fn squeezenet_file(path: &Path) {
    let (trunk, lin) = formula::weights();
    std::fs::write(path, formula::safetensors(&trunk.into_iter().chain(lin).collect())).unwrap();
}

fn with_weights(weights: &Path) -> Config {
    let mut config = common::config(Method::Occnerf);
    config.patch_size = 24;
    config.loss.perceptual_weights = weights.to_str().unwrap().to_owned();
    config
}

fn losses(reports: &[StepReport]) -> Vec<[u64; 2]> {
    reports.iter().map(|r| [r.loss.to_bits(), r.perceptual.to_bits()]).collect()
}

#[test]
fn training_with_lpips_goes_on_after_a_stop_as_if_there_was_none_on_any_number_of_threads() {
    let directory = Directory::new("lpips-training");
    let (weights, half) = (directory.file("net.safetensors"), directory.file("half.safetensors"));
    squeezenet_file(&weights);
    let run = |threads: usize, stop: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut trainer = Trainer::new(common::scene(), with_weights(&weights)).unwrap();
            trainer.load_perceptual().unwrap();
            assert_eq!(trainer.perceptual(), "lpips squeezenet");
            let mut reports: Vec<StepReport> = (0..2).map(|_| trainer.step().unwrap()).collect();
            if stop {
                trainer.save(&half).unwrap();
                trainer = Trainer::resume(common::scene(), &half).unwrap();
                trainer.load_perceptual().unwrap();
            }
            reports.extend((0..2).map(|_| trainer.step().unwrap()));
            losses(&reports)
        })
    };
    let whole = run(1, false);
    assert_eq!(run(2, false), whole);
    assert_eq!(run(2, true), whole);
    let mut embedded =
        Trainer::new(common::scene(), Config { loss: common::config(Method::Occnerf).loss, ..with_weights(&weights) })
            .unwrap();
    assert_eq!(embedded.perceptual(), "ms-ssim");
    assert_ne!(embedded.step().unwrap().perceptual.to_bits(), whole[0][1]);
}

#[test]
fn weights_that_are_gone_and_patches_that_are_too_small_are_errors_before_the_first_step() {
    let directory = Directory::new("lpips-refused");
    let weights = directory.file("net.safetensors");
    let mut trainer = Trainer::new(common::scene(), with_weights(&weights)).unwrap();
    assert!(matches!(trainer.load_perceptual(), Err(Error::Lpips(lpips::Error::Io { path, .. })) if path == weights));
    squeezenet_file(&weights);
    let mut trainer = Trainer::new(common::scene(), Config { patch_size: 16, ..with_weights(&weights) }).unwrap();
    let error = trainer.load_perceptual().unwrap_err().to_string();
    assert!(error.contains("16 × 16") && error.contains("at least 17"), "{error}");
    let error = trainer.step().unwrap_err().to_string();
    assert!(error.contains("not loaded") && trainer.steps_done() == 0, "{error}");
}

#[test]
fn scoring_reports_lpips_where_weights_are_given() {
    let directory = Directory::new("lpips-scores");
    let weights = directory.file("net.safetensors");
    squeezenet_file(&weights);
    let lpips = Lpips::load(&weights).unwrap();
    let scene = common::scene();
    let trainer = Trainer::new(scene, common::config(Method::Occnerf)).unwrap();
    let frames: Vec<_> = scene.eval.iter().collect();
    let mut seen = Vec::new();
    let mut renderer = FieldRenderer::new(trainer.model()).unwrap();
    let scores = evaluate(scene, &mut renderer, &frames, Some(&lpips), |frame, rendering| {
        let size = (frame.view.camera.width as usize, frame.view.camera.height as usize);
        let truth = frame.pixels().unwrap();
        seen.push(lpips.distance(&rendering.image.pixels, &truth.image.pixels, size.0, size.1).unwrap()[0]);
    });
    let scores = scores.unwrap();
    let found: Vec<f64> = scores.frames.iter().filter_map(|f| f.lpips_full).collect();
    assert_eq!(found, seen);
    assert!((scores.lpips_full.unwrap() - seen.iter().sum::<f64>() / seen.len() as f64).abs() < 1e-12);
    let mut renderer = FieldRenderer::new(trainer.model()).unwrap();
    let without = evaluate(scene, &mut renderer, &frames, None, |_, _| {}).unwrap();
    assert_eq!(without.lpips_full, None);
}

/// Colours of the prior and losses of some steps.
fn learnt(capture: &Capture, config: &Config) -> (PriorColors, Vec<f64>) {
    let scene = Scene::new(capture, body(), config).unwrap();
    let mut trainer = Trainer::new(&scene, config.clone()).unwrap();
    let losses = (0..6).map(|_| trainer.step().unwrap().loss).collect();
    (PriorColors::measure(&scene).unwrap(), losses)
}

/// What training frame 0 shows, inverted.
fn another_picture() -> Capture {
    let mut capture = capture();
    let invert = |pixels: &mut Pixels| {
        for (colour, mask) in pixels.image.pixels.chunks_exact_mut(3).zip(&pixels.mask) {
            colour.iter_mut().for_each(|c| *c = mask - *c);
        }
    };
    capture.train[0].source.edit(invert);
    capture
}

#[test]
fn nothing_is_learnt_from_what_they_show_and_they_are_what_is_scored() {
    let mut config = config(Method::Occnerf);
    config.registration.rounds = 0;
    let whole = learnt(&capture(), &config);
    assert_ne!(whole.1, learnt(&another_picture(), &config).1);
    config.held_out = 2;
    let (colors, losses) = learnt(&capture(), &config);
    let (others, same) = learnt(&another_picture(), &config);
    assert_eq!((colors.colors, &losses), (others.colors, &same));
    assert!(losses.iter().any(|&loss| loss > 0.0) && losses != whole.1);

    let scene = Scene::new(&capture(), body(), &config).unwrap();
    let [frame] = &scene.eval[..] else { panic!("{} frames held out", scene.eval.len()) };
    assert_eq!((&*frame.name, &*frame.camera_name), (&*scene.train[0].name, "held out"));
    assert!(scene.train[0].labels.iter().all(|label| label == Label::Unknown));
    assert!(frame.labels.num_subject() > 50 && frame.labels.num_subject() < frame.labels.iter().count());
    let colors = PriorColors::measure(&scene).unwrap();
    let mut prior = PriorRenderer::new(&scene.body, &colors);
    let scores = evaluate(&scene, &mut prior, &[frame], None, |_, _| {}).unwrap();
    assert!(scores.psnr_mask.is_some_and(|psnr| psnr > 5.0), "{scores:?}");
}

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
