//! Training frames that are held out to choose settings by.

use crate::common;

use common::{body, capture, config};
use occnerf::capture::{Capture, Pixels};
use occnerf::{Config, Label, Method, PriorColors, PriorRenderer, Scene, Trainer, evaluate};

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
