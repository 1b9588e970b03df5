//! The scores of renderers whose scores are known beforehand.

use crate::common;

use common::{SIZE, body, capture, config, scene};
use glam::Vec3;
use occnerf::capture::Image;
use occnerf::{
    Error, Label, Labels, Method, PosedView, PreparedFrame, Renderer, Rendering, Scene, SplitMetrics, evaluate,
    least_seen_quartile,
};

/// Returns the truth of the frame with a view after `change` has been at the pixels and opacities
/// of (frame, index).
struct Truth<F: Fn(&PreparedFrame, usize, &mut [f32], &mut f32) + Sync>(F);

impl<F: Fn(&PreparedFrame, usize, &mut [f32], &mut f32) + Sync> Renderer for Truth<F> {
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error> {
        let frame = scene().eval.iter().chain(&scene().train).find(|frame| std::ptr::eq(&*frame.view, view)).unwrap();
        assert_eq!(background, Vec3::ZERO, "pictures are compared on black");
        let truth = frame.pixels()?;
        let (mut pixels, mut opacity) = (truth.image.pixels.clone(), truth.mask.clone());
        for (i, (pixel, opacity)) in pixels.chunks_exact_mut(3).zip(&mut opacity).enumerate() {
            self.0(frame, i, pixel, opacity);
        }
        let image = Image { width: frame.view.camera.width, height: frame.view.camera.height, pixels };
        Ok(Rendering { image, opacity })
    }
}

fn scores(
    frames: &[PreparedFrame],
    change: impl Fn(&PreparedFrame, usize, &mut [f32], &mut f32) + Sync,
) -> SplitMetrics {
    let frames: Vec<&PreparedFrame> = frames.iter().collect();
    evaluate(scene(), &mut Truth(change), &frames, None, |_, _| {}).unwrap()
}

fn near(a: Option<f64>, b: f64) -> bool {
    a.is_some_and(|a| (a - b).abs() < 1e-3)
}

#[test]
fn the_truth_has_no_error_anywhere() {
    let split = scores(&scene().eval, |_, _, _, _| {});
    assert_eq!(split.frames.len(), 2);
    for frame in &split.frames {
        assert_eq!(frame.mask_iou, 1.0);
        assert_eq!((frame.psnr_mask, frame.psnr_vis), (Some(f64::INFINITY), Some(f64::INFINITY)));
        assert_eq!(frame.psnr_full, Some(f64::INFINITY));
        assert!(near(frame.ssim_mask, 1.0) && near(frame.ssim_vis, 1.0) && near(frame.ssim_full, 1.0));
    }
    assert_eq!(split.mask_iou, Some(1.0));
    assert!(near(split.ssim_mask, 1.0) && near(split.ssim_full, 1.0));
    // A mean with an infinite member says nothing: left out rather than written down.
    for psnr in [split.psnr_mask, split.psnr_vis, split.psnr_full, split.psnr_hidden] {
        assert!(psnr.is_none_or(f64::is_finite), "{psnr:?}");
    }
    assert!(split.render_seconds_per_frame >= 0.0 && split.lpips_full.is_none());
    // JSON knows no infinity.
    let back: SplitMetrics = serde_json::from_str(&serde_json::to_string(&split).unwrap()).unwrap();
    assert_eq!((back.frames.len(), back.frames[0].psnr_mask, back.ssim_mask), (2, None, split.ssim_mask));
}

#[test]
fn a_constant_error_has_its_decibels_in_every_set() {
    let split = scores(&scene().eval, |_, _, pixel, _| pixel.iter_mut().for_each(|p| *p += 0.1));
    for psnr in [split.psnr_mask, split.psnr_vis, split.psnr_full, split.psnr_hidden] {
        assert!(near(psnr, 20.0), "{psnr:?}");
    }
    assert!(split.ssim_full.unwrap() < 0.999);
}

#[test]
fn errors_outside_the_subject_count_in_the_whole_picture_alone() {
    let outside = |frame: &PreparedFrame, i: usize, pixel: &mut [f32], _: &mut f32| {
        let frame = frame.source.as_ref().unwrap().reader().unwrap();
        if frame.at(i as u32).1 <= 0.5 {
            pixel.fill(0.5);
        }
    };
    let split = scores(&scene().eval, outside);
    assert!(split.frames.iter().all(|f| f.psnr_mask == Some(f64::INFINITY) && f.psnr_full.is_some_and(|p| p < 12.0)));
}

#[test]
fn overlap_is_that_of_the_solid_pixels() {
    // Upper half of the picture only.
    let half = scores(&scene().eval, |_, i, _, opacity| {
        if i >= (SIZE * SIZE / 2) as usize {
            *opacity = 0.4;
        }
    });
    assert!((half.mask_iou.unwrap() - 0.5).abs() < 0.06, "{:?}", half.mask_iou);
    let empty = scores(&scene().eval, |_, _, _, opacity| *opacity = 0.0);
    assert_eq!(empty.mask_iou, Some(0.0));
    assert_eq!((empty.psnr_vis, empty.ssim_vis), (None, None), "nothing is visible in an empty picture");
    let full = scores(&scene().eval, |_, _, _, opacity| *opacity = 1.0);
    let covered = |f: &PreparedFrame| {
        let mask = &f.pixels().unwrap().mask;
        mask.iter().filter(|m| **m > 0.5).count() as f64 / mask.len() as f64
    };
    let expected = scene().eval.iter().map(covered).sum::<f64>() / scene().eval.len() as f64;
    assert!((full.mask_iou.unwrap() - expected).abs() < 1e-9);
}

/// A training view's unknown pixels have no truth.
#[test]
fn unknown_pixels_of_training_views_are_not_scored() {
    let train = &scene().train[1..];
    assert!(train[0].labels.iter().filter(|l| *l == Label::Unknown).count() > 50);
    let split = scores(train, |frame, i, pixel, opacity| {
        if frame.labels.at(i as u32) == Label::Unknown {
            pixel.fill(0.9);
            *opacity = 1.0;
        }
    });
    assert_eq!(split.frames[0].psnr_full, Some(f64::INFINITY));
    assert_eq!(split.frames[0].mask_iou, 1.0);
    let known = scores(train, |frame, i, pixel, _| {
        if frame.labels.at(i as u32) == Label::Background {
            pixel.fill(0.9);
        }
    });
    assert!(known.frames[0].psnr_full.is_some_and(|p| p < 10.0));
}

/// Calling pixels unknown improves no score of the others, and excuses nothing in `psnr_all`.
#[test]
fn unknown_pixels_of_the_subject_are_counted_and_not_excused() {
    let given = &scene().eval[0];
    let mask = given.pixels().unwrap().mask.clone();
    let is_unknown = |i: usize| i.is_multiple_of(2);
    let label = |i: usize| if is_unknown(i) { Label::Unknown } else { Label::Subject };
    let frame = PreparedFrame {
        name: given.name.clone(),
        camera_name: given.camera_name.clone(),
        view: std::sync::Arc::clone(&given.view),
        source: given.source.clone(),
        labels: Labels::new(&(0..mask.len()).map(label).collect::<Vec<_>>()),
    };
    let split = scores(&[frame], |_, i, pixel, _| {
        let error = if is_unknown(i) { 0.3 } else { 0.1 };
        pixel.iter_mut().for_each(|p| *p += error);
    });
    let subject = (0..mask.len()).filter(|i| mask[*i] > 0.5);
    let (unknown, all) = (subject.clone().filter(|i| is_unknown(*i)).count() as f64, subject.count() as f64);
    assert!(near(split.known, 1.0 - unknown / all) && near(split.psnr_mask, 20.0), "{split:?}");
    let squared = (0.09 * unknown + 0.01 * (all - unknown)) / all;
    assert!(near(split.psnr_all, -10.0 * squared.log10()), "{split:?}");
}

/// Hidden pixels show vertices that ray casting found least often in the training frames.
#[test]
fn hidden_pixels_are_those_of_the_least_seen_quarter() {
    let least = least_seen_quartile(scene()).unwrap();
    let seen = scene().vertex_frequencies().unwrap();
    assert_eq!(least.iter().filter(|l| **l).count(), least.len() / 4);
    let bound = |wanted: bool| seen.iter().zip(&least).filter(move |(_, l)| **l == wanted).map(|(s, _)| *s);
    assert!(bound(true).max() <= bound(false).min());
    // An error on all of the subject but its never-seen side leaves the hidden pixels perfect.
    let view = &scene().eval[1];
    let mesh = visibility::RayMesh::new(&view.view.posed.vertices, &scene().body.model.faces).unwrap();
    let split = scores(std::slice::from_ref(view), |frame, i, pixel, _| {
        let (column, row) = ((i % SIZE as usize) as f32, (i / SIZE as usize) as f32);
        let ray = frame.view.camera.ray(column + 0.5, row + 0.5);
        let hidden = mesh.first_hit(ray.origin, ray.direction).is_some_and(|hit| {
            let corners = scene().body.model.faces[hit.face as usize];
            let largest = (0..3).rev().max_by(|&a, &b| hit.barycentric[a].total_cmp(&hit.barycentric[b]));
            least[corners[largest.unwrap()] as usize]
        });
        if !hidden {
            pixel[1] += 0.2;
        }
    });
    assert_eq!(split.frames[0].psnr_hidden, Some(f64::INFINITY));
    assert!(split.frames[0].psnr_mask.unwrap().is_finite());
}

#[test]
fn no_frames_give_no_scores_and_progress_hears_of_every_frame() {
    let none = scores(&[], |_, _, _, _| {});
    assert!(none.psnr_mask.is_none() && none.mask_iou.is_none() && none.frames.is_empty());
    let frames: Vec<&PreparedFrame> = scene().eval.iter().collect();
    let mut heard = Vec::new();
    let mut truth = Truth(|_: &PreparedFrame, _: usize, _: &mut [f32], _: &mut f32| {});
    evaluate(scene(), &mut truth, &frames, None, |frame, rendering| {
        heard.push((frame.camera_name.clone(), rendering.opacity.len()));
    })
    .unwrap();
    let pixels = (SIZE * SIZE) as usize;
    assert_eq!(heard, [("Camera_B2".to_owned(), pixels), ("Camera_B3".to_owned(), pixels)]);
}

#[test]
fn captures_that_show_nobody_are_refused() {
    let mut blank = capture();
    blank.train.iter_mut().for_each(|f| f.source.edit(|pixels| pixels.mask.fill(0.0)));
    let message = Scene::new(&blank, body(), &config(Method::Occnerf)).err().unwrap().to_string();
    assert!(message.contains("ellipsoid") && message.contains("mask"), "{message}");
    blank.train.clear();
    assert!(Scene::new(&blank, body(), &config(Method::Occnerf)).is_err());
}
