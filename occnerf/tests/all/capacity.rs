//! Sizes from the scene, and pruning: within bounds, never more for less to see, and the same
//! pictures.

use crate::common;

use common::{TempDir, body, capture, capture_from, config, scene};
use glam::Vec3;
use occnerf::{Capacity, Config, Error, FieldRenderer, Measured, Method, Preset, Renderer, Scene, Trainer};
use proptest::prelude::*;

const PRESETS: [Preset; 3] = [Preset::Fast, Preset::Balanced, Preset::Paper];
const METHODS: [Method; 2] = [Method::Occnerf, Method::HashPoint];
const SIZES: [&str; 6] =
    ["encoding.n_max", "encoding.levels", "encoding.log2_table_size", "field.width", "samples", "steps"];

/// Largest size that a scene is given, for `preset` in its preset.
fn most(key: &str, preset: f64) -> f64 {
    match key {
        "encoding.n_max" => preset.max(2048.0),
        "encoding.levels" => preset.max(16.0),
        "encoding.log2_table_size" => preset.max(19.0),
        "steps" => 2.5 * preset,
        _ => preset,
    }
}

fn size(capacity: &Capacity, key: &str) -> Option<f64> {
    capacity.choices.iter().find(|c| c.key == key).map(|c| c.chosen)
}

fn measured() -> impl Strategy<Value = Measured> {
    let extent = 0.5f32..4.0;
    (0.0001f32..1.0, extent, 1u64..1 << 30, 1u64..1 << 20, 0.125f32..4.0).prop_map(
        |(metres_a_pixel, extent, subject_pixels, cells, span)| Measured {
            metres_a_pixel,
            extent,
            subject_pixels,
            cells,
            span,
        },
    )
}

proptest! {
    #[test]
    fn every_size_is_within_its_bounds_and_the_result_is_valid(measured in measured()) {
        for (preset, method) in PRESETS.into_iter().flat_map(|p| METHODS.map(|m| (p, m))) {
            let before = Config::preset(preset, method);
            let capacity = Capacity::choose(measured.clone(), &before);
            for choice in &capacity.choices {
                prop_assert!(SIZES.contains(&choice.key.as_str()), "{:?}", choice);
                prop_assert!((1.0..=most(&choice.key, choice.preset)).contains(&choice.chosen), "{:?}", choice);
            }
            let mut after = before.clone();
            capacity.apply(&mut after);
            after.validate().unwrap();
            prop_assert!(after.encoding.n_min <= after.encoding.n_max);
            // Nothing else changes.
            let (field, encoding) = (before.field.clone(), before.encoding.clone());
            prop_assert_eq!(Config { samples: 1, steps: 1, field, encoding, ..after },
                Config { samples: 1, steps: 1, ..before });
            prop_assert!(capacity.growth().choices.iter().all(|choice| choice.chosen > choice.preset));
        }
    }

    #[test]
    fn a_finer_view_of_more_surface_never_gets_a_smaller_model(
        coarse in measured(), finer in 1.0f32..16.0, more in 0u64..1 << 20,
    ) {
        let fine = Measured {
            metres_a_pixel: coarse.metres_a_pixel / finer,
            cells: coarse.cells + more,
            subject_pixels: coarse.subject_pixels + more,
            ..coarse.clone()
        };
        for preset in PRESETS {
            let config = Config::preset(preset, Method::Occnerf);
            let [coarse, fine] = [&coarse, &fine].map(|m| Capacity::choose(m.clone(), &config));
            for key in SIZES {
                prop_assert!(size(&fine, key) >= size(&coarse, key), "{}: {:?} {:?}", key, fine, coarse);
            }
        }
    }
}

#[test]
fn a_scene_twice_as_far_away_has_wider_pixels_fewer_cells_and_no_larger_model() {
    let config = Config { samples: 48, ..config(Method::Occnerf) };
    let config = Config { encoding: Config::preset(Preset::Balanced, Method::Occnerf).encoding, ..config };
    let [near, far] = [3.0, 6.0].map(|metres| {
        let scene = Scene::new(&capture_from(metres), body(), &config).unwrap();
        Capacity::measure(&scene, &config).unwrap()
    });
    assert!((far.measured.metres_a_pixel / near.measured.metres_a_pixel - 2.0).abs() < 0.01);
    assert!(far.measured.cells < near.measured.cells / 2 && far.measured.cells > 20, "{far:?}");
    assert!(far.measured.subject_pixels < near.measured.subject_pixels / 3);
    for key in SIZES {
        assert!(size(&far, key) <= size(&near, key), "{key}: {far:?} {near:?}");
    }
    assert!(size(&far, "encoding.n_max") < size(&near, "encoding.n_max"));
}

#[test]
fn the_same_scene_is_measured_the_same_on_one_and_on_three_threads() {
    let config = config(Method::Occnerf);
    let [one, three] = [1, 3].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| Capacity::measure(scene(), &config).unwrap())
    });
    assert_eq!(one, three);
    // The ellipsoid of half axes 0.35, 0.85 and 0.25 m, seen from two sides: something like half of
    // its 2 m².
    let seen = one.measured.cells as f32 * one.measured.metres_a_pixel.powi(2);
    assert!((0.5..3.0).contains(&seen), "{seen} m²");
    let text = serde_json::to_string(&one).unwrap();
    assert_eq!(serde_json::from_str::<Capacity>(&text).unwrap(), one);
}

#[test]
fn scenes_that_show_nothing_are_errors_that_say_so() {
    let config = config(Method::Occnerf);
    let mut behind = capture();
    behind.train.iter_mut().for_each(|f| f.camera.world_to_camera.translation.z = -3.0);
    // Rays that all pass the body by.
    let mut beside = capture();
    beside.train.iter_mut().for_each(|f| f.camera.world_to_camera.translation.x = 40.0);
    for (capture, word) in [(behind, "before its camera"), (beside, "meets the posed prior")] {
        let scene = Scene::new(&capture, body(), &config).unwrap();
        match Capacity::measure(&scene, &config) {
            Err(Error::Scene(message)) => assert!(message.contains(word) && message.contains("ellipsoid"), "{message}"),
            other => panic!("{other:?}"),
        }
    }
    let mut lost = capture();
    lost.train[0].pose[1].x = f32::NAN;
    let measured = Scene::new(&lost, body(), &config).map(|scene| Capacity::measure(&scene, &config).map(|_| ()));
    assert!(!matches!(measured, Ok(Ok(()))));
    let mut bad = config.clone();
    bad.samples = 0;
    assert!(matches!(Capacity::measure(scene(), &bad), Err(Error::Config(_))));
}

/// A trained model with far more rows than it meets.
fn trained() -> Trainer<'static> {
    let mut config = config(Method::Occnerf);
    (config.encoding.log2_table_size, config.encoding.n_max, config.steps) = (15, 96, 12);
    let mut trainer = Trainer::new(scene(), config).unwrap();
    for _ in 0..12 {
        trainer.step().unwrap();
    }
    trainer
}

fn pictures(trainer: &Trainer<'_>) -> Vec<f32> {
    let mut renderer = FieldRenderer::new(trainer.model()).unwrap();
    let frames = scene().eval.iter().chain(&scene().train);
    frames.flat_map(|frame| renderer.render(&frame.view, Vec3::ONE).unwrap().image.pixels).collect()
}

#[test]
fn a_pruned_model_draws_the_same_pictures_with_fewer_parameters_also_from_its_file() {
    let dir = TempDir::new("prune");
    let (whole_file, file) = (dir.path("whole.safetensors"), dir.path("pruned.safetensors"));
    let mut trainer = trained();
    trainer.save(&whole_file).unwrap();
    let (whole, before) = (trainer.model().num_parameters(), pictures(&trainer));
    let pruned = trainer.prune();
    assert!(pruned.dropped > pruned.rows / 2 && pruned.dropped < pruned.rows, "{pruned:?}");
    assert_eq!(pruned.parameters as usize, trainer.model().num_parameters());
    assert_eq!(whole - trainer.model().num_parameters(), 2 * pruned.dropped as usize);
    let after = pictures(&trainer);
    let worst = before.iter().zip(&after).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // An emptied feature was at most 1e-4; the field's slope is of the order of 1.
    assert!(worst < 1e-3, "{worst}");
    assert_eq!(trainer.prune(), pruned, "twice is once");

    trainer.save(&file).unwrap();
    let [large, small] = [&whole_file, &file].map(|path| std::fs::metadata(path).unwrap().len());
    assert!(small < large / 2, "{small} of {large} bytes");
    let mut resumed = Trainer::resume(scene(), &file).unwrap();
    assert_eq!((resumed.model().num_parameters(), pictures(&resumed)), (trainer.model().num_parameters(), after));
    let again = dir.path("again.safetensors");
    resumed.save(&again).unwrap();
    assert!(std::fs::read(&again).unwrap() == std::fs::read(&file).unwrap());
    // Training on, all rows can be learnt again, and both go the same way.
    assert_eq!(resumed.step().unwrap().loss.to_bits(), trainer.step().unwrap().loss.to_bits());
    assert_eq!(resumed.model().num_parameters(), whole);
}
