//! Frames that show little or nothing: they happen in real videos and must cost nothing but
//! themselves.

use crate::common;

use common::{SIZE, body, capture, config, scene};
use glam::{Affine3A, Mat3, Vec3};
use occnerf::capture::{Frame, Pixels};
use occnerf::{FieldRenderer, Label, Method, PosedView, PriorColors, PriorRenderer, Renderer, Scene, Trainer};
use volrender::Camera;

/// The person wholly hidden, behind the camera, far beside the picture, and around the camera.
fn odd(kind: &str) -> Frame {
    let mut frame = capture().train[0].clone();
    let empty = |pixels: &mut Pixels| {
        pixels.mask.fill(0.0);
        pixels.image.pixels.fill(0.0);
    };
    frame.source.edit(empty);
    let camera = &mut frame.camera.world_to_camera;
    match kind {
        "hidden" => {}
        "behind" => camera.translation.z = -3.0,
        "beside" => camera.translation.x = 9.0,
        "around" => camera.translation.z = 0.01,
        _ => unreachable!(),
    }
    frame
}

#[test]
fn training_goes_on_over_frames_that_show_nobody() {
    for kind in ["hidden", "behind", "beside", "around"] {
        for method in [Method::Occnerf, Method::HashPoint] {
            let mut capture = capture();
            capture.train.push(odd(kind));
            let config = config(method);
            let scene = Scene::new(&capture, body(), &config).unwrap();
            assert_eq!(scene.train[2].labels.num_subject(), 0);
            let mut trainer = Trainer::new(&scene, config).unwrap();
            for _ in 0..6 {
                let report = trainer.step().unwrap();
                assert!(report.loss.is_finite() && report.psnr.is_finite(), "{kind} {method:?}: {report:?}");
                assert_eq!(report.bad_gradients, 0, "{kind} {method:?}: {report:?}");
            }
            PriorColors::measure(&scene).unwrap();
            scene.vertex_frequencies().unwrap();
        }
    }
}

/// Where every pixel is unknown there is nothing to learn from, and nothing to divide by.
#[test]
fn a_capture_that_is_nearly_all_unknown_still_trains() {
    let mut capture = capture();
    for frame in &mut capture.train {
        let nearly_all = |pixels: &mut Pixels| {
            let mut first = true;
            pixels.mask.iter_mut().filter(|m| **m > 0.5).for_each(|m| *m = f32::from(std::mem::take(&mut first)));
            pixels.occluder = Some(vec![true; (SIZE * SIZE) as usize]);
        };
        frame.source.edit(nearly_all);
    }
    let config = config(Method::Occnerf);
    let scene = Scene::new(&capture, body(), &config).unwrap();
    let known = scene.train.iter().flat_map(|f| f.labels.iter()).filter(|l| *l != Label::Unknown).count();
    assert_eq!(known, 2, "one pixel of each frame");
    let mut trainer = Trainer::new(&scene, config).unwrap();
    for _ in 0..6 {
        let report = trainer.step().unwrap();
        assert!(report.loss.is_finite() && report.psnr.is_finite() && report.bad_gradients == 0, "{report:?}");
    }
}

#[test]
fn pictures_from_anywhere_are_finite_and_empty_where_nobody_is() {
    let trainer = Trainer::new(scene(), config(Method::Occnerf)).unwrap();
    let colors = PriorColors::measure(scene()).unwrap();
    let background = Vec3::new(0.2, 0.4, 0.6);
    for kind in ["behind", "beside", "around"] {
        let view = PosedView::new(&odd(kind).camera, scene().body.rest());
        let pictures = [
            FieldRenderer::new(trainer.model()).unwrap().render(&view, background).unwrap(),
            PriorRenderer::new(&scene().body, &colors).render(&view, background).unwrap(),
        ];
        for picture in pictures {
            assert!(picture.image.pixels.iter().all(|p| (0.0..=1.0).contains(p)), "{kind}");
            assert!(picture.opacity.iter().all(|o| (0.0..=1.0 + 1e-6).contains(o)), "{kind}");
            if kind != "around" {
                assert!(picture.opacity.iter().all(|o| *o == 0.0), "{kind}");
                assert!(picture.image.pixels.chunks(3).all(|p| p == background.to_array()), "{kind}");
            }
        }
    }
}

#[test]
fn pictures_of_a_single_pixel_and_long_thin_ones_are_drawn() {
    let trainer = Trainer::new(scene(), config(Method::Occnerf)).unwrap();
    for (width, height) in [(1, 1), (1, 90), (90, 1), (5, 64)] {
        let focal = 1.4 * width.max(height) as f32;
        let centre = Vec3::new(0.5 * width as f32, 0.5 * height as f32, 1.0);
        let intrinsics = Mat3::from_cols(Vec3::X * focal, Vec3::Y * focal, centre);
        let extrinsics = Affine3A::from_mat3_translation(Mat3::from_cols(Vec3::X, -Vec3::Y, -Vec3::Z), Vec3::Z * 3.0);
        let camera = Camera::new(intrinsics, extrinsics, width, height).unwrap();
        let view = PosedView::new(&camera, scene().body.rest());
        let picture = FieldRenderer::new(trainer.model()).unwrap().render(&view, Vec3::ZERO).unwrap();
        assert_eq!(picture.opacity.len(), (width * height) as usize);
        // The middle of the picture is the middle of the person.
        let middle = (height / 2 * width + width / 2) as usize;
        assert!(picture.opacity[middle] > 0.9, "{width}×{height}: {}", picture.opacity[middle]);
    }
}

#[test]
fn a_view_of_a_frame_that_training_has_not_is_refused() {
    let mut capture = capture();
    capture.eval[1].train_index = capture.train.len();
    let refused = Scene::new(&capture, body(), &config(Method::Occnerf));
    let message = refused.err().map(|e| e.to_string()).unwrap_or_default();
    assert!(message.contains("training frame 2") && message.contains("expected one of 2"), "{message}");
}
