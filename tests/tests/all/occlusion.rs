//! What an occluder hides must not reach training by any way.

use crate::common;

use common::{body, capture, scene, tiny, train};
use glam::Vec3;
use image::{Rgb, RgbImage};
use occnerf::capture::{Capture, LoadOptions, Pixels, load_capture};
use occnerf::{Label, Method, MotionKind, OccludedRule, PriorColors, Scene, upright};
use serde_json::json;
use synth::{DemoConfig, demo};
use testkit::files::Directory;

/// Some colour that changes from pixel to pixel.
fn noise(i: u32, salt: u32) -> u8 {
    (i.wrapping_mul(2_654_435_761).wrapping_add(salt).wrapping_mul(2_246_822_519) >> 24) as u8
}

/// The subject is a column in the middle; an obstacle hides its lower half in the first two frames.
fn shown(frame: u32, x: u32, y: u32) -> bool {
    x.abs_diff(12) < 6 && (4..28).contains(&y) && (frame == 2 || y < 16)
}

/// With the files, which frames are read from again.
fn load(hidden: u32, distortion: [f64; 5]) -> (Directory, Capture) {
    let dir = Directory::new("occluded");
    let frame = json!({
        "poses": [0.0, 0.5, 0.0, 0.0, 0.25, 0.0], "betas": [0.5, 0.0], "distortions": distortion,
        "cam_intrinsics": [[40, 0, 12], [0, 40, 16], [0, 0, 1]],
        "cam_extrinsics": [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3.5], [0, 0, 0, 1]],
    });
    dir.write("metadata.json", json!({ "0": frame, "1": frame, "2": frame }).to_string());
    for i in 0..3 {
        let image = format!("images/{i}.png");
        let color = |x: u32, y: u32| {
            let salt = if shown(i, x, y) { 1 } else { hidden };
            Rgb([0, 1, 2].map(|c| noise(3 * (y * 24 + x) + c + 3000 * i, salt)))
        };
        dir.write(&image, "");
        RgbImage::from_fn(24, 32, color).save(dir.file(&image)).unwrap();
        dir.picture(&format!("masks/{i}.png"), (24, 32), |x, y| 255 * u8::from(shown(i, x, y)));
    }
    let capture = load_capture(dir.path(), &common::tiny_body(), &LoadOptions::default()).unwrap();
    (dir, capture)
}

#[test]
fn the_picture_under_the_mask_never_leaves_the_loader() {
    for distortion in [[0.0; 5], [-0.2, 0.05, 0.001, -0.002, 0.0]] {
        let ((_one, one), (_other, other)) = (load(2, distortion), load(3, distortion));
        for (a, b) in one.train.iter().zip(&other.train) {
            let (a, b) = (a.pixels().unwrap(), b.pixels().unwrap());
            assert!(a.mask == b.mask && a.mask.iter().any(|&m| m > 0.5));
            assert!(a.image == b.image, "values that depend on what is hidden, {distortion:?}");
        }
    }
}

/// Overwrites the colour of every pixel with this label in every training frame, and of the
/// background its coverage.
fn repainted(label: Label) -> Capture {
    let mut changed = capture().clone();
    let mut count = 0;
    for (frame, prepared) in changed.train.iter_mut().zip(&scene().train) {
        let mut repaint = |pixels: &mut Pixels| {
            for (i, _) in prepared.labels.iter().enumerate().filter(|(_, l)| *l == label) {
                count += 1;
                for c in 0..3 {
                    pixels.image.pixels[3 * i + c] = f32::from(noise((3 * i + c) as u32, 9)) / 255.0;
                }
                if label == Label::Background {
                    pixels.mask[i] = 0.4;
                }
            }
        };
        let mut pixels = frame.pixels().unwrap();
        repaint(&mut pixels);
        frame.source = pixels.into();
    }
    assert!(count > 50, "{count} pixels of {label:?}");
    changed
}

#[test]
fn colours_of_unknown_pixels_have_no_influence_and_those_of_known_ones_have() {
    let configs = common::METHODS.map(|method| tiny(method, MotionKind::Surface));
    let truth = configs.each_ref().map(|config| train(scene(), config, 5).1);
    for label in [Label::Unknown, Label::Subject, Label::Background] {
        let scene = Scene::new(&repainted(label), body(), &configs[0]).unwrap();
        for (config, truth) in configs.iter().zip(&truth) {
            let (_, changed) = train(&scene, config, 5);
            assert_eq!(changed == *truth, label == Label::Unknown, "{:?} {label:?}", config.method);
        }
    }
}

#[test]
fn vertex_colours_do_not_depend_on_unknown_pixels() {
    let config = tiny(Method::Prior, MotionKind::Surface);
    let measure = |capture: &Capture| PriorColors::measure(&Scene::new(capture, body(), &config).unwrap()).unwrap();
    assert_eq!(measure(capture()), measure(&repainted(Label::Unknown)));
    assert_ne!(measure(capture()), measure(&repainted(Label::Subject)));
}

#[test]
fn the_background_rule_leaves_nothing_unknown_and_changes_training() {
    let config = tiny(Method::HashPoint, MotionKind::Surface);
    let mut background = config.clone();
    background.occluded = OccludedRule::Background;
    let known = Scene::new(capture(), body(), &background).unwrap();
    assert!(known.train.iter().flat_map(|f| f.labels.iter()).all(|l| l != Label::Unknown));
    let [(a, _), (b, _)] = [train(scene(), &config, 4), train(&known, &background, 4)];
    assert_ne!(common::bits(&a), common::bits(&b));
}

/// A known obstacle is unknown wherever it is not the subject, over empty ground too.
#[test]
fn what_a_known_occluder_covers_is_unknown() {
    let config = tiny(Method::Occnerf, MotionKind::Surface);
    let known = demo(&DemoConfig { known_occluder: true, ..common::demo_config() }, body()).unwrap();
    let scene = Scene::new(&known, body(), &config).unwrap();
    for (frame, prepared) in known.train.iter().zip(&scene.train) {
        let pixels = frame.pixels().unwrap();
        let occluder = pixels.occluder.as_ref().unwrap();
        for ((&occluded, label), &m) in occluder.iter().zip(prepared.labels.iter()).zip(&pixels.mask) {
            match (m > 0.5, occluded) {
                (true, _) => assert_eq!(label, Label::Subject),
                (false, true) => assert_eq!(label, Label::Unknown),
                // Background, or inferred to be hidden.
                (false, false) => assert_ne!(label, Label::Subject),
            }
        }
    }
    let up = upright(&scene.body, scene.train.iter().map(|frame| &*frame.view));
    assert!(up.distance(Vec3::Y) < 1e-6, "{up}");
}
