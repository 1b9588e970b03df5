//! The same seed and the same inputs give the same bits: on any number of threads, and with a stop
//! in between.

use crate::common;

use common::{bits, body, checkpoint, demo_config, on_threads, scene, tiny, train};
use glam::Vec3;
use occnerf::{
    Config, DistanceKind, FieldRenderer, Method, MotionKind, PriorColors, PriorRenderer, Renderer, Scene, Trainer,
    checkpoint_config,
};
use synth::demo;
use testkit::files::Directory;

/// Every method that has a field, the main ones with both kinds of motion, and the paper's blended
/// distances with its learnable volume.
fn configs() -> Vec<Config> {
    let kinds = [MotionKind::Surface, MotionKind::Volume];
    let mut configs: Vec<Config> =
        common::METHODS.into_iter().flat_map(|method| kinds.map(|kind| tiny(method, kind))).collect();
    let mut paper = tiny(Method::Occnerf, MotionKind::Volume);
    paper.surface.distance = DistanceKind::Blended;
    configs.push(paper);
    configs
}

fn name(config: &Config) -> String {
    format!("{} {:?} {:?}", config.method.name(), config.motion.kind, config.surface.distance)
}

#[test]
fn training_gives_the_same_bits_on_one_and_on_two_threads() {
    for config in configs() {
        let [one, two] = [1, 2].map(|threads| on_threads(threads, || train(scene(), &config, 6)));
        assert_eq!(bits(&one.0), bits(&two.0), "{}: losses", name(&config));
        assert!(one.1 == two.1, "{}: checkpoints differ", name(&config));
    }
}

#[test]
fn captures_scenes_colours_and_pictures_are_the_same_on_one_and_on_three_threads() {
    let config = tiny(Method::Occnerf, MotionKind::Surface);
    let [one, three] = [1, 3].map(|threads| {
        on_threads(threads, || {
            let capture = demo(&demo_config(), body()).unwrap();
            let scene = Scene::new(&capture, body(), &config).unwrap();
            let trained = train(&scene, &config, 2);
            let trainer = Trainer::new(&scene, config.clone()).unwrap();
            let field = FieldRenderer::new(trainer.model()).unwrap().render(&scene.eval[0].view, Vec3::ONE).unwrap();
            let colors = PriorColors::measure(&scene).unwrap();
            let prior = PriorRenderer::new(&scene.body, &colors).render(&scene.eval[0].view, Vec3::X).unwrap();
            let counts = scene.vertex_frequencies().unwrap();
            let frames: Vec<_> = capture.train.into_iter().map(|f| (f.pixels().unwrap(), f.pose)).collect();
            (frames, colors, counts, [field, prior].map(|r| (r.image, r.opacity)), bits(&trained.0), trained.1)
        })
    });
    assert!(one == three);
}

#[test]
fn stopping_and_going_on_equals_never_having_stopped() {
    let dir = Directory::new("resume");
    let path = dir.path().join("half.safetensors");
    for config in configs() {
        let (reports, whole) = train(scene(), &config, 6);
        let mut first = Trainer::new(scene(), config.clone()).unwrap();
        for _ in 0..3 {
            first.step().unwrap();
        }
        first.save(&path).unwrap();
        assert_eq!(checkpoint_config(&path).unwrap(), config);
        let mut second = Trainer::resume(scene(), &path).unwrap();
        assert_eq!(second.steps_done(), 3);
        assert_eq!(second.model().visibility_counts(), first.model().visibility_counts());
        let rest: Vec<_> = (0..3).map(|_| second.step().unwrap()).collect();
        assert_eq!(bits(&rest), bits(&reports[3..]), "{}: losses", name(&config));
        assert!(checkpoint(&second) == whole, "{}: checkpoints differ", name(&config));
    }
}

#[test]
fn another_seed_gives_another_model_and_other_losses() {
    for method in common::METHODS {
        let config = tiny(method, MotionKind::Surface);
        let other = Config { seed: config.seed + 1, ..config.clone() };
        let (a, b) = (train(scene(), &config, 2), train(scene(), &other, 2));
        assert_ne!(bits(&a.0), bits(&b.0), "{method:?}");
        assert!(a.1 != b.1, "{method:?}");
    }
}
