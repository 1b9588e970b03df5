//! LPIPS as the perceptual term of a training, and as a score.

use crate::common;
#[allow(dead_code, reason = "this test writes one network")]
use crate::formula;

use std::path::Path;

use occnerf::{Config, Error, FieldRenderer, Lpips, Method, StepReport, Trainer, evaluate};
use testkit::files::Directory;

/// Writes a SqueezeNet of formula weights.
fn squeezenet_file(path: &Path) {
    let (trunk, lin) = formula::weights();
    std::fs::write(path, formula::safetensors(&trunk.into_iter().chain(lin).collect())).unwrap();
}

fn config(weights: &Path) -> Config {
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
            let mut trainer = Trainer::new(common::scene(), config(&weights)).unwrap();
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
        Trainer::new(common::scene(), Config { loss: common::config(Method::Occnerf).loss, ..config(&weights) })
            .unwrap();
    assert_eq!(embedded.perceptual(), "ms-ssim");
    assert_ne!(embedded.step().unwrap().perceptual.to_bits(), whole[0][1]);
}

#[test]
fn weights_that_are_gone_and_patches_that_are_too_small_are_errors_before_the_first_step() {
    let directory = Directory::new("lpips-refused");
    let weights = directory.file("net.safetensors");
    let mut trainer = Trainer::new(common::scene(), config(&weights)).unwrap();
    assert!(matches!(trainer.load_perceptual(), Err(Error::Lpips(lpips::Error::Io { path, .. })) if path == weights));
    squeezenet_file(&weights);
    let mut trainer = Trainer::new(common::scene(), Config { patch_size: 16, ..config(&weights) }).unwrap();
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
