//! What a training run must do from its first step on.

use crate::common;

use common::{METHODS, scene, silhouette, tiny};
use glam::Vec3;
use occnerf::{
    Config, DistanceKind, FieldRenderer, Method, MotionKind, PreparedFrame, Preset, Renderer, Scene, StepReport,
    Trainer, evaluate,
};

/// Whole tables take a while to draw, and start near zero whatever their size.
const SMALL_TABLE: u32 = 12;

/// The least and the mean opacity over the prior's silhouette in a picture of an untrained field.
fn initial_opacity(scene: &Scene, config: Config, frame: &PreparedFrame) -> (f32, f32) {
    let trainer = Trainer::new(scene, config).unwrap();
    let rendering = FieldRenderer::new(trainer.model()).unwrap().render(&frame.view, Vec3::ZERO).unwrap();
    let inside: Vec<f32> =
        rendering.opacity.iter().zip(silhouette(scene, frame)).filter(|(_, s)| *s).map(|(o, _)| *o).collect();
    assert!(inside.len() > 100);
    (inside.iter().copied().fold(1.0, f32::min), inside.iter().sum::<f32>() / inside.len() as f32)
}

/// An image that starts empty stays empty: the published code is known for it.
#[test]
fn no_seed_starts_empty() {
    for method in METHODS {
        let mut paper = Config::preset(Preset::Paper, method);
        (paper.encoding.log2_table_size, paper.samples) = (SMALL_TABLE, 64);
        let mut cases = vec![(paper, 2)];
        for (motion, seeds) in [(MotionKind::Surface, 0..5), (MotionKind::Volume, 5..7)] {
            for seed in seeds {
                let mut config = Config::preset(Preset::Fast, method);
                config.surface.coarse_levels = 3;
                (config.seed, config.motion.kind) = (seed, motion);
                config.motion.shell_interval = 0;
                config.field.prior_colors &= motion == MotionKind::Surface;
                config.encoding.log2_table_size = SMALL_TABLE;
                cases.push((config, 0));
            }
        }
        for (config, view) in cases {
            let (preset, motion, seed) = (config.preset, config.motion.kind, config.seed);
            let (least, mean) = initial_opacity(scene(), config, &scene().eval[view]);
            let said = format!("{method:?} {preset:?} {motion:?} seed {seed}: least {least}, mean {mean}");
            println!("{said}");
            // The Gaussian volume has holes at the joints.
            let opacity = if motion == MotionKind::Surface { least } else { mean };
            assert!(opacity > 0.5, "{said}");
        }
    }
}

/// Enough for every method to learn the outline.
const STEPS: usize = 64;

#[test]
fn a_short_training_lowers_the_loss_and_beats_its_own_start() {
    for method in METHODS {
        let mut config = tiny(method, MotionKind::Surface);
        (config.steps, config.patches, config.patch_size) = (STEPS as u64, 3, 24);
        // Faster than the preset, which has longer.
        (config.rates.field, config.rates.table) = (5e-3, 2e-2);
        let mut frozen = config.clone();
        (frozen.rates.field, frozen.rates.vertices, frozen.rates.table) = (0.0, 0.0, 0.0);
        let mut trainer = Trainer::new(scene(), config).unwrap();
        let psnr = |trainer: &Trainer<'_>| {
            let frames: Vec<&PreparedFrame> = scene().eval.iter().collect();
            let mut renderer = FieldRenderer::new(trainer.model()).unwrap();
            evaluate(scene(), &mut renderer, &frames, None, |_, _| {}).unwrap().psnr_mask.unwrap()
        };
        let start = psnr(&trainer);
        let reports: Vec<_> = (0..STEPS).map(|_| trainer.step().unwrap()).collect();
        let end = psnr(&trainer);
        // One that never learns sees the same patches over the same backgrounds, hard or easy.
        let mut frozen = Trainer::new(scene(), frozen).unwrap();
        let still: Vec<_> = (0..STEPS).map(|_| frozen.step().unwrap()).collect();
        let mean = |of: &[StepReport]| of[STEPS - 12..].iter().map(|r| r.loss).sum::<f64>() / 12.0;
        let (before, after) = (mean(&still), mean(&reports));
        println!("{method:?}: loss {before} {after}, psnr_mask {start} {end}");
        assert!(after < 0.95 * before, "{method:?}: loss {before} to {after}");
        assert!(end > start + 0.5, "{method:?}: psnr_mask {start} to {end} dB");
        for report in &reports {
            assert_eq!(report.bad_gradients, 0, "{method:?} step {}", report.step);
            assert!(report.loss.is_finite() && report.live_samples > 0 && report.psnr.is_finite());
        }
    }
}

#[test]
fn every_motion_and_distance_trains_without_bad_gradients() {
    for motion in [MotionKind::Surface, MotionKind::Volume] {
        for distance in [DistanceKind::Blended, DistanceKind::Exact] {
            let mut config = tiny(Method::Occnerf, motion);
            config.surface.distance = distance;
            // Large steps reach strange parameters sooner.
            (config.rates.vertices, config.rates.motion) = (1e-2, 1e-1);
            let mut trainer = Trainer::new(scene(), config).unwrap();
            for _ in 0..12 {
                let report = trainer.step().unwrap();
                assert!(report.loss.is_finite(), "{motion:?} {distance:?}: {report:?}");
                assert_eq!(report.bad_gradients, 0, "{motion:?} {distance:?}: {report:?}");
            }
        }
    }
}

/// Only the paper's method counts; terminations on visible pixels are what it counts.
#[test]
fn vertices_near_visible_pixels_are_counted_and_the_rest_stay_behind() {
    let mut trainer = Trainer::new(scene(), tiny(Method::Occnerf, MotionKind::Surface)).unwrap();
    assert!(trainer.model().visibility_counts().iter().all(|&c| c == 0));
    let mut rays = 0;
    (0..24).for_each(|_| rays += trainer.step().unwrap().rays as u64);
    let counts = trainer.model().visibility_counts();
    let total: u64 = counts.iter().sum();
    assert!(total > 0 && total.is_multiple_of(5) && total <= 5 * rays, "{total} of {rays} rays");
    // Vertices that ray casting never sees are hit by far fewer terminations than those it sees in
    // many frames.
    let seen = scene().vertex_frequencies().unwrap();
    let mean = |wanted: &dyn Fn(u64) -> bool| {
        let of: Vec<u64> = seen.iter().zip(counts).filter(|(s, _)| wanted(**s)).map(|(_, c)| *c).collect();
        of.iter().sum::<u64>() as f64 / of.len() as f64
    };
    let (never, often) = (mean(&|s| s == 0), mean(&|s| s >= 3));
    assert!(often > 2.0 * never, "never seen {never}, often seen {often}");
}
