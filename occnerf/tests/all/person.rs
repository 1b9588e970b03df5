//! A run's person, drawn with the capture gone.

use crate::common;

use std::path::Path;

use common::{body, capture, config, scene};
use glam::Vec3;
use occnerf::capture::{Mended, Registered};
use occnerf::{
    Error, FieldRenderer, Method, Model, MotionKind, Person, PriorColors, PriorRenderer, Renderer, Scene, Trainer,
    mend_masks,
};
use smpl::BodyModel;
use synth::{DemoConfig, demo};
use testkit::files::Directory;

const CHECKPOINT: &str = "checkpoint.safetensors";
const PERSON: &str = "person.safetensors";

/// Leaves a run of a few steps in `run`; its model, without the trainer.
fn trained(run: &Path, change: impl Fn(&mut occnerf::Config)) -> Model {
    let mut config = config(Method::Occnerf);
    change(&mut config);
    let mut trainer = Trainer::new(scene(), config).unwrap();
    for _ in 0..6 {
        trainer.step().unwrap();
    }
    Person::save(run, &scene().registered, body(), &PriorColors::measure(scene()).unwrap()).unwrap();
    trainer.save(&run.join(CHECKPOINT)).unwrap();
    trainer.into_model()
}

fn pictures(model: &Model) -> Vec<f32> {
    let mut renderer = FieldRenderer::new(model).unwrap();
    let draw = |view: &std::sync::Arc<_>| renderer.render(view, Vec3::new(0.2, 0.4, 0.6)).unwrap().image.pixels;
    model.frames().iter().flat_map(draw).collect()
}

#[test]
fn a_model_read_from_its_run_draws_the_same_bits_as_the_trained_one() {
    let kinds: [fn(&mut occnerf::Config); 3] = [
        |_| {},
        |c| c.field.prior_colors = false,
        |c| {
            (c.motion.kind, c.motion.shell_interval) = (MotionKind::Volume, 0);
            c.field.prior_colors = false;
        },
    ];
    for (kind, change) in kinds.into_iter().enumerate() {
        let dir = Directory::new(&format!("person-{kind}"));
        let model = trained(dir.file("").as_path(), change);
        let loaded = Model::load(dir.file("").as_path()).unwrap();
        assert_eq!(loaded.config(), model.config());
        assert_eq!((loaded.steps_done(), loaded.num_parameters()), (6, model.num_parameters()));
        assert_eq!(loaded.visibility_counts(), model.visibility_counts());
        assert!(pictures(&loaded) == pictures(&model), "kind {kind}");
    }
}

#[test]
fn fists_are_in_the_body_of_a_run_and_are_not_rolled_up_again() {
    let (dir, flat, config) = (Directory::new("person-fists"), BodyModel::embedded(), config(Method::Surface));
    let capture = demo(&DemoConfig { size: 32, frames: 4, eval_cameras: 1, ..Default::default() }, &flat).unwrap();
    let registered = Registered { fists: [0.25, 1.0], ..capture.clone().into() };
    let scene = Scene::prepare(registered.clone(), &flat, &config).unwrap();
    assert_ne!(scene.body.model, flat);
    Person::save(&dir.file(""), &registered, &flat, &PriorColors::measure(&scene).unwrap()).unwrap();
    let kept = BodyModel::load(&dir.file("body.safetensors")).unwrap();
    assert_eq!(kept, scene.body.model);
    let restored = Person::restore(&dir.file(""), capture.into(), &kept).unwrap().unwrap();
    assert_eq!(Scene::prepare(restored, &kept, &config).unwrap().body.model, kept);
}

#[test]
fn a_capture_gets_the_bodies_that_a_run_was_trained_with() {
    let dir = Directory::new("person-registered");
    let mut config = config(Method::Occnerf);
    config.registration.rounds = 3;
    let given = capture();
    let scene = Scene::new(&given, body(), &config).unwrap();
    assert_ne!(scene.registered.capture.train[0].placement, given.train[0].placement);
    Person::save(&dir.file(""), &scene.registered, body(), &PriorColors::measure(&scene).unwrap()).unwrap();
    let mended = mend_masks(given.clone(), body()).unwrap();
    let restored = Person::restore(&dir.file(""), mended.clone(), body()).unwrap().unwrap();
    assert!(restored.clothes == scene.registered.clothes && restored.clothes.iter().any(|&c| c != 0.0));
    let again = Scene::prepare(restored.clone(), body(), &config).unwrap();
    assert_eq!(again.colors().unwrap(), scene.colors().unwrap());
    let bare = Registered { clothes: vec![0.0], ..restored.clone() };
    let refused = Scene::prepare(bare, body(), &config).err().map(|e| e.to_string());
    assert!(refused.is_some_and(|e| e.contains("clothes are 1 numbers")));
    for (a, b) in scene.train.iter().chain(&scene.eval).zip(again.train.iter().chain(&again.eval)) {
        assert_eq!((&a.view.posed, &a.labels), (&b.view.posed, &b.labels));
    }
    // A run of before a body had as many shapes goes on.
    let more = BodyModel { shapedirs: [&body().shapedirs[..]; 2].concat(), ..body().clone() };
    let with_more = Person::restore(&dir.file(""), mended.clone(), &more).unwrap().unwrap();
    assert_eq!(with_more.capture.mean_betas, restored.capture.mean_betas);
    let fewer = BodyModel { shapedirs: Vec::new(), ..body().clone() };
    let error = Person::restore(&dir.file(""), mended.clone(), &fewer).unwrap_err().to_string();
    assert!(error.contains("person.safetensors") && error.contains("betas"), "{error}");
    let again = Scene::prepare(with_more, &more, &config).unwrap();
    assert_eq!(again.train[0].view.posed, scene.train[0].view.posed);
    // A capture of other frames is another.
    let (mut other, mut larger) = (given.clone(), given.clone());
    other.train.pop();
    larger.train[1].camera = larger.train[1].camera.resized(99, 98);
    for (capture, words) in [(other, "frames, the capture has"), (larger, "the capture in (99, 98)")] {
        let error = Person::restore(&dir.file(""), Mended::from(capture), body()).unwrap_err().to_string();
        assert!(error.contains(PERSON) && error.contains(words), "{error}");
    }
    assert!(Person::restore(&dir.file("elsewhere"), mended, body()).unwrap().is_none());
}

#[test]
fn a_run_goes_on_with_the_colours_that_it_began_with() {
    let (dir, fresh) = (Directory::new("person-colors"), PriorColors::measure(scene()).unwrap());
    let run = dir.file("");
    assert_eq!(Person::colors(&run, body()).unwrap(), None);
    // As runs of before colours lay between the vertices have them, and without the header's line.
    let began = PriorColors::of_vertices(vec![Vec3::X; body().num_vertices()], &body().faces);
    assert_ne!(began.colors, fresh.colors);
    Person::save(&run, &scene().registered, body(), &began).unwrap();
    let mut bytes = std::fs::read(run.join(PERSON)).unwrap();
    let at = bytes.windows(12).position(|w| w == b"subdivisions").unwrap();
    bytes[at] = b'x';
    std::fs::write(run.join(PERSON), bytes).unwrap();
    let kept = Person::colors(&run, body()).unwrap().unwrap();
    assert_eq!(kept, began);
    let config = config(Method::HashPoint);
    let first = |scene: &Scene| Trainer::new(scene, config.clone()).unwrap().step().unwrap().loss;
    let prepared = || Scene::new(&capture(), body(), &config).unwrap();
    let (fresh_start, resumed) = (first(&prepared()), first(&prepared().with_colors(kept)));
    assert_ne!(fresh_start, resumed);
    assert_eq!(prepared().with_colors(began.clone()).colors().unwrap(), &began);
}

#[test]
fn the_prior_of_a_run_draws_the_same_bits_too() {
    let dir = Directory::new("person-prior");
    let colors = PriorColors::measure(scene()).unwrap();
    let run = dir.file("");
    Person::save(&run, &scene().registered, body(), &colors).unwrap();
    let person = Person::load(&run, &config(Method::Prior)).unwrap();
    assert_eq!((person.scene.as_str(), &person.colors), (scene().name.as_str(), &colors));
    let view = &scene().train[1].view;
    let drawn = PriorRenderer::new(&scene().body, &colors).render(view, Vec3::ONE).unwrap();
    let again = PriorRenderer::new(&person.body, &person.colors).render(&person.frames[1], Vec3::ONE).unwrap();
    assert!(drawn.image.pixels == again.image.pixels);
}

#[test]
fn what_is_missing_or_damaged_is_named() {
    let dir = Directory::new("person-damage");
    let run = dir.file("");
    let said = || Model::load(&run).err().map(|error| error.to_string()).unwrap_or_default();
    assert!(matches!(Model::load(&run), Err(Error::Io { .. })) && said().contains(CHECKPOINT));
    trained(&run, |_| {});
    let whole = std::fs::read(run.join(PERSON)).unwrap();
    std::fs::remove_file(run.join(PERSON)).unwrap();
    assert!(said().contains(PERSON) && said().contains("--resume"), "{}", said());
    let check = |bytes: &[u8], words: &[&str]| {
        std::fs::write(run.join(PERSON), bytes).unwrap();
        let said = said();
        assert!(words.iter().all(|word| said.contains(word)), "{words:?}: {said}");
    };
    for cut in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        check(&whole[..cut], &[PERSON]);
    }
    let damage = |at: usize, bytes: &[u8], words: &[&str]| {
        let mut damaged = whole.clone();
        damaged[at..at + bytes.len()].copy_from_slice(bytes);
        check(&damaged, words);
    };
    // A NaN, and a camera of no size.
    let start = 8 + u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    damage(start + 64, &[0, 0, 0xc0, 0x7f], &[PERSON]);
    damage(start, &[0xff; 4], &[PERSON]);
    // Numbers that no capture has.
    let parsed = safetensors::SafeTensors::deserialize(&whole).unwrap();
    for key in ["poses", "betas", "placements", "cameras", "colors", "light"] {
        let at = parsed.tensor(key).unwrap().data().as_ptr() as usize - whole.as_ptr() as usize + 4;
        damage(at, &1e38f32.to_le_bytes(), &[PERSON, key]);
    }
    // More than the arrays and the body have.
    let after = |text: &str| whole.windows(text.len()).position(|w| w == text.as_bytes()).unwrap() + text.len();
    damage(after("\"frames\":\""), b"9", &["expected F32 [144]"]);
    for digit in [b"9", b"x"] {
        damage(after("\"subdivisions\":\""), digit, &["`subdivisions`", "fits the body"]);
    }
    std::fs::write(run.join(PERSON), &whole).unwrap();
    assert!(Model::load(&run).is_ok());
}
