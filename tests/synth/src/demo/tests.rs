use std::sync::OnceLock;

use capture::Pixels;

use super::*;

fn body() -> &'static BodyModel {
    static BODY: OnceLock<BodyModel> = OnceLock::new();
    BODY.get_or_init(BodyModel::embedded)
}

fn small() -> DemoConfig {
    DemoConfig { size: 48, frames: 6, eval_cameras: 3, eval_every: 4, ..DemoConfig::default() }
}

#[test]
fn what_the_obstacle_hides_is_zero_and_the_rest_untouched() {
    let clear = demo(&DemoConfig { occluded_fraction: 0.0, ..small() }, body()).unwrap();
    let occluded = demo(&small(), body()).unwrap();
    for (with, without) in occluded.train.iter().zip(&clear.train) {
        let (with, without) = (with.pixels().unwrap(), without.pixels().unwrap());
        for pixel in 0..with.mask.len() {
            let color = |pixels: &Pixels| [0, 1, 2].map(|c| pixels.image.pixels[3 * pixel + c]);
            if with.mask[pixel] == without.mask[pixel] {
                assert_eq!(color(&with), color(&without));
            } else {
                assert_eq!((with.mask[pixel], color(&with)), (0.0, [0.0; 3]));
            }
        }
    }
    for (with, without) in occluded.eval.iter().zip(&clear.eval) {
        assert_eq!(
            with.frame.pixels().unwrap().image,
            without.frame.pixels().unwrap().image,
            "evaluation views are never occluded"
        );
    }
}

#[test]
fn impossible_settings_are_named() {
    for (word, config) in [
        ("size", DemoConfig { size: 4, ..small() }),
        ("size", DemoConfig { size: u32::MAX, ..small() }),
        ("frames", DemoConfig { frames: 0, ..small() }),
        ("eval_every", DemoConfig { eval_every: 0, ..small() }),
        ("eval_cameras", DemoConfig { eval_cameras: 1000, ..small() }),
        ("occluded_fraction", DemoConfig { occluded_fraction: 1.0, ..small() }),
        ("occluded_share", DemoConfig { occluded_share: -0.1, ..small() }),
        ("pressed", DemoConfig { pressed: f32::NAN, ..small() }),
        ("lamp", DemoConfig { lamp: 1.5, ..small() }),
        ("pose_noise_degrees", DemoConfig { pose_noise_degrees: f32::NAN, ..small() }),
    ] {
        let message = demo(&config, body()).unwrap_err().to_string();
        assert!(message.contains(word) && message.contains("expected"), "{message}");
    }
    let mut other = body().clone();
    other.parents.pop();
    assert!(demo(&small(), &other).unwrap_err().to_string().contains("24 joints"));
}

#[test]
fn an_outfit_covers_pixels_beside_the_body_and_leaves_the_motion_as_it_is() {
    let plain = demo(&small(), body()).unwrap();
    for (outfit, least) in [(Outfit::Skirt, 1.15), (Outfit::LongHair, 1.01)] {
        let dressed = demo(&DemoConfig { outfit, ..small() }, body()).unwrap();
        let [mut covered, mut more] = [0.0, 0.0];
        for (a, b) in plain.eval.iter().zip(&dressed.eval) {
            assert_eq!((&a.frame.pose, a.frame.placement), (&b.frame.pose, b.frame.placement));
            let [a, b] = [a, b].map(|view| view.frame.pixels().unwrap().mask);
            assert!(a.iter().zip(&b).all(|(a, b)| a <= b), "{outfit:?} hides the person");
            covered += a.iter().sum::<f32>();
            more += b.iter().sum::<f32>();
        }
        assert!(more > least * covered, "{outfit:?}: {more} of {covered}");
    }
}
