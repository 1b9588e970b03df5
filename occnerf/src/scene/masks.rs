//! Masks that are too large or too small: where they end, pictures should have an edge.
//!
//! A segmenter that errs by some pixels errs so all around and in every frame. Of all lines inside
//! the mask at an even distance from where it ends, the one across which colours change most is
//! then the person's outline, and not the mask's. Outside the mask photographs are looked at, which
//! captures on disk have; without them nothing can be told of a mask that is too small.

use glam::Vec3;
use rayon::prelude::*;
use smpl::BodyModel;

use crate::Error;
use crate::capture::{Capture, Frame, Pixels};
use crate::config::OccludedRule;
use crate::model::view::PosedView;
use crate::scene::labels::{Label, label_pixels, squared_distance};

/// Frames that are looked at.
const FRAMES: usize = 16;
/// Lines that are compared, and the last of them that can be the outline, pixels inside the mask.
const LINES: usize = 12;
const FARTHEST: usize = 8;
/// Edges of half covered pixels, which an exact mask has, lie this far inside.
const BLUR: usize = 1;
/// How much more colours change across the outline than across the median line.
const OUTSTANDING: f64 = 1.6;
/// Pairs of pixels that a line has to be crossed by, and lines that have to be: of a small picture
/// nothing is said.
const PAIRS: u64 = 100;
const ENOUGH: usize = 8;
/// Lines around a mask: so many outside it, its edge, and 4 inside.
const AROUND: usize = LINES + 5;
/// Part of the largest change that the outline has, and of the outline's that the line outside it
/// can have at most.
const NEARLY: f64 = 0.75;
const RISE: f64 = 0.6;
/// How often masks are looked at again after they have grown.
const PASSES: usize = 3;
/// How far from the body a mask can be too small, metres.
const NEAR: f32 = 0.1;

/// Shrinks the masks of the training frames by as much as they are too large, or grows them by as
/// much as they are too small, as [`crate::Scene`] does before it registers bodies. What was mended
/// is left as it is.
///
/// # Errors
/// Pictures that cannot be read.
pub fn mend_masks(capture: &mut Capture, model: &BodyModel) -> Result<(), Error> {
    if std::mem::replace(&mut capture.mended, true) {
        return Ok(());
    }
    let excess = excess(&capture.train)?;
    if excess == 0 {
        return extend(capture, model);
    }
    let by = -i32::try_from(excess).unwrap_or(i32::MAX);
    capture.train.iter_mut().for_each(|frame| frame.source.edit(move |pixels| pixels.grow(by)));
    Ok(())
}

/// By how many pixels the masks are too large; 0 where no line stands out.
fn excess(frames: &[Frame]) -> Result<u32, Error> {
    let each: Vec<&Frame> = frames.iter().step_by(frames.len().div_ceil(FRAMES).max(1)).collect();
    let changes: Result<Vec<_>, Error> = each.par_iter().map(|frame| Ok(changes(&frame.pixels()?))).collect();
    let mut sums = [(0.0, 0u64); LINES];
    for changes in changes? {
        sums.iter_mut().zip(changes).for_each(|(sum, (change, pairs))| *sum = (sum.0 + change, sum.1 + pairs));
    }
    let crossed = sums.iter().take_while(|sum| sum.1 >= PAIRS);
    let means: Vec<f64> = crossed.map(|(change, pairs)| change / *pairs as f64).collect();
    if means.len() < ENOUGH {
        return Ok(0);
    }
    let mut sorted = means.clone();
    sorted.sort_by(f64::total_cmp);
    let most = (BLUR..FARTHEST).max_by(|&a, &b| means[a].total_cmp(&means[b])).unwrap_or(0);
    Ok(if means[most] > OUTSTANDING * sorted[means.len() / 2] { most as u32 + 1 } else { 0 })
}

/// Grows the masks into what photographs show near the body, but not into what hides it.
fn extend(capture: &mut Capture, model: &BodyModel) -> Result<(), Error> {
    for _ in 0..PASSES {
        let missing = missing(&capture.train, model)?;
        if missing == 0 {
            break;
        }
        capture.train.par_iter_mut().try_for_each(|frame| -> Result<(), Error> {
            let Some(photograph) = frame.source.photograph().transpose()? else { return Ok(()) };
            let pixels = frame.pixels()?;
            let free = free(frame, &pixels, model, missing, NEAR)?;
            let added = pixels.beyond_mask(&photograph, missing, |i| free[i]);
            frame.source.edit(move |pixels| pixels.show(&added));
            Ok(())
        })?;
    }
    Ok(())
}

/// By how many pixels the masks are too small; 0 where no line outside them is the outline.
///
/// That is the outermost line across which colours change nearly as much as across any, if it rises
/// from what lies outside. Ragged and blurred outlines rise slowly.
fn missing(frames: &[Frame], model: &BodyModel) -> Result<u32, Error> {
    let each: Vec<&Frame> = frames.iter().step_by(frames.len().div_ceil(FRAMES).max(1)).collect();
    let changes: Result<Vec<_>, Error> = each.par_iter().map(|frame| changes_around(frame, model)).collect();
    let mut sums = [(0.0, 0u64); AROUND];
    for changes in changes?.into_iter().flatten() {
        sums.iter_mut().zip(changes).for_each(|(sum, (change, pairs))| *sum = (sum.0 + change, sum.1 + pairs));
    }
    if sums.iter().any(|sum| sum.1 < PAIRS) {
        return Ok(0);
    }
    let means = sums.map(|(change, pairs)| change / pairs as f64);
    let mut outside = means[..LINES].to_vec();
    outside.sort_by(f64::total_cmp);
    let candidates = LINES - FARTHEST..AROUND;
    let most = means[candidates.clone()].iter().copied().fold(0.0, f64::max);
    let outline = candidates.clone().find(|&line| means[line] > NEARLY * most).unwrap_or(LINES);
    let rises = means[outline - 1] < RISE * means[outline] && means[outline] > OUTSTANDING * outside[LINES / 2];
    // The first candidate may be the end of something that begins farther out.
    Ok(if outline > candidates.start && outline < LINES && rises { (LINES - outline) as u32 } else { 0 })
}

/// Pixels (H × W) into which a mask may grow by `reach`: within `near` metres of the body, and not
/// near what covers it or may.
fn free(frame: &Frame, pixels: &Pixels, model: &BodyModel, reach: u32, near: f32) -> Result<Vec<bool>, Error> {
    let (width, camera) = (pixels.image.width as usize, &frame.camera);
    let shaped = model.shaped(&frame.betas);
    let posed = model.pose(&shaped, &frame.pose, frame.placement);
    let height = |pick: fn(f32, f32) -> f32| shaped.vertices.iter().map(|v| v.y).reduce(pick).unwrap_or(0.0);
    let centre = posed.vertices.iter().sum::<Vec3>() / posed.vertices.len().max(1) as f32;
    let depth = camera.world_to_camera.transform_point3(centre).z.max(1e-3);
    // Pixels of a metre of a body 1.7 high.
    let metre = (height(f32::max) - height(f32::min)) / 1.7 * camera.focal.x / depth;
    let body = PosedView::new(camera, posed).silhouette(&model.faces)?;
    let reached = larger(&pixels.mask, width, reach as f32);
    let occluder = pixels.occluder.as_deref();
    let labels = label_pixels(OccludedRule::Unknown, &reached, &body, occluder, width, metre);
    let hidden = |i: usize| occluder.is_some_and(|o| o[i]) || frame.source.is_hidden();
    let covered: Vec<bool> = labels.iter().enumerate().map(|(i, &l)| l == Label::Unknown || hidden(i)).collect();
    let (away, covered) = (squared_distance(&body, width), squared_distance(&covered, width));
    let (near, reach) = (near * metre, reach as f32);
    Ok(away.into_iter().zip(covered).map(|(away, covered)| away <= near * near && covered > reach * reach).collect())
}

/// A mask that is larger by so many pixels.
fn larger(mask: &[f32], width: usize, by: f32) -> Vec<f32> {
    let inside: Vec<bool> = mask.iter().map(|&m| m > 0.5).collect();
    squared_distance(&inside, width).into_iter().map(|d| f32::from(d <= by * by)).collect()
}

/// Sum of the changes of colour of the photograph across the lines from 12 pixels outside the mask to
/// 4 inside, and of how many pairs of pixels; `None` without a photograph of the subject.
fn changes_around(frame: &Frame, model: &BodyModel) -> Result<Option<[(f64, u64); AROUND]>, Error> {
    let Some(photograph) = frame.source.photograph().transpose()? else { return Ok(None) };
    let pixels = frame.pixels()?;
    let width = photograph.width as usize;
    let inside: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
    if !inside.contains(&true) {
        return Ok(None);
    }
    let free = free(frame, &pixels, model, FARTHEST as u32, f32::INFINITY)?;
    let outside: Vec<bool> = inside.iter().map(|i| !i).collect();
    let (within, without) = (squared_distance(&outside, width), squared_distance(&inside, width));
    let depth = |i: usize| if inside[i] { within[i].sqrt() } else { 1.0 - without[i].sqrt() };
    let color = |i: usize| photograph.pixels[3 * i..3 * i + 3].iter();
    let mut sums = [(0.0, 0); AROUND];
    let usable = |i: usize| inside[i] || free[i];
    for i in (0..inside.len()).filter(|&i| usable(i)) {
        let neighbours = [(i % width + 1 < width).then_some(i + 1), Some(i + width)];
        for j in neighbours.into_iter().flatten().filter(|&j| j < inside.len() && usable(j)) {
            let (near, far) = (depth(i).min(depth(j)), depth(i).max(depth(j)));
            let change: f32 = color(i).zip(color(j)).map(|(a, b)| (a - b).abs()).sum();
            for line in near.ceil() as i64..far.ceil() as i64 {
                if let Ok(line) = usize::try_from(line + LINES as i64)
                    && line < AROUND
                {
                    sums[line].0 += f64::from(change);
                    sums[line].1 += 1;
                }
            }
        }
    }
    Ok(Some(sums))
}

/// Sum of the changes of colour across the lines 1, 2, … pixels inside the mask, and how many pairs
/// of pixels they were taken from.
fn changes(pixels: &Pixels) -> [(f64, u64); LINES] {
    let width = pixels.image.width as usize;
    let outside: Vec<bool> = pixels.mask.iter().map(|&m| m <= 0.5).collect();
    let depth: Vec<f32> = squared_distance(&outside, width).into_iter().map(f32::sqrt).collect();
    let color = |i: usize| pixels.image.pixels[3 * i..3 * i + 3].iter().map(move |c| c / pixels.mask[i]);
    let mut sums = [(0.0, 0); LINES];
    for i in (0..outside.len()).filter(|&i| !outside[i]) {
        let neighbours = [(i % width + 1 < width).then_some(i + 1), Some(i + width)];
        for j in neighbours.into_iter().flatten().filter(|&j| j < outside.len() && !outside[j]) {
            let (near, far) = (depth[i].min(depth[j]), depth[i].max(depth[j]));
            let change: f32 = color(i).zip(color(j)).map(|(a, b)| (a - b).abs()).sum();
            // Neighbours are less than two lines apart.
            for line in near.ceil() as usize..far.ceil() as usize {
                if (1..=LINES).contains(&line) {
                    sums[line - 1].0 += f64::from(change);
                    sums[line - 1].1 += 1;
                }
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use synth::{DemoConfig, Perturbation, SynthConfig, demo, synthesise};
    use testkit::files::Directory;

    use super::*;
    use crate::capture::{Layout, LoadOptions, load_capture};

    /// A synthetic capture in files, whose photographs masks can grow into.
    fn on_disk(name: &str, size: u32, layout: Layout) -> (Directory, Capture) {
        let config = SynthConfig { size, frames: 12, eval_cameras: 1, eval_every: 12, ..SynthConfig::default() };
        let made = synthesise(None, None, &config, &|_| {}).unwrap();
        let directory = Directory::new(name);
        made.write(directory.path(), layout, &|_| {}).unwrap();
        let capture = load_capture(directory.path(), &made.body, &LoadOptions::default()).unwrap();
        (directory, capture)
    }

    #[test]
    fn masks_that_are_too_large_are_found_and_trimmed_and_no_others() {
        let body = BodyModel::embedded();
        let (_directory, given) = on_disk("masks-large", 192, Layout::HumanNerf);
        let area = |c: &Capture| c.train.iter().map(|f| f.pixels().unwrap().mask.iter().sum::<f32>()).sum::<f32>();
        for (mask_pixels, ragged_pixels) in [(0, 0.0), (-3, 0.0), (-1, 0.0), (0, 2.0), (2, 0.0), (3, 0.0), (5, 0.0)] {
            let mut capture = given.clone();
            let wrong = Perturbation { mask_pixels, ragged_pixels, ..Perturbation::NONE };
            wrong.apply(&mut capture, &body).unwrap();
            let found = excess(&capture.train).unwrap() as i32;
            let spoilt = area(&capture);
            mend_masks(&mut capture, &body).unwrap();
            println!("{mask_pixels} {ragged_pixels}: {found}");
            if mask_pixels < 2 {
                // Those that are too small grow.
                let kept = mask_pixels < 0 || area(&capture) == spoilt;
                assert!(found == 0 && kept, "{mask_pixels} {ragged_pixels}: {found}");
            } else {
                assert!((found - mask_pixels).abs() <= 1, "{mask_pixels}: {found}");
                let (left, was) = ((area(&capture) - area(&given)).abs(), spoilt - area(&given));
                assert!(left < 0.4 * was, "{mask_pixels}: {left} of {was}");
            }
        }
    }

    #[test]
    fn masks_that_are_too_small_grow_into_the_photograph_and_no_others() {
        let body = BodyModel::embedded();
        let config = DemoConfig { frames: 12, eval_cameras: 0, ..DemoConfig::default() };
        let drawn = demo(&config, &body).unwrap();
        let (_directory, given) = on_disk("masks-small", config.size, Layout::HumanNerf);
        assert_eq!(missing(&drawn.train, &body).unwrap(), 0, "without a photograph nothing is known");
        // So little does not move an edge, and leaves a photograph.
        let right = [(0, 0.4), (0, 2.0), (0, 4.0), (2, 0.0), (3, 0.0)];
        for (mask_pixels, ragged_pixels) in right.into_iter().chain([(-1, 0.0), (-2, 0.0), (-3, 0.0), (-2, 2.0)]) {
            let mut capture = given.clone();
            let wrong = Perturbation { mask_pixels, ragged_pixels, ..Perturbation::NONE };
            wrong.apply(&mut capture, &body).unwrap();
            let error = |c: &Capture| -> f32 {
                let frames = c.train.iter().zip(&given.train);
                let each = frames.map(|(frame, given)| {
                    let (frame, given) = (frame.pixels().unwrap(), given.pixels().unwrap());
                    // Whatever is taken for the person is as the person is.
                    let colors = frame.image.pixels.iter().zip(&given.image.pixels);
                    assert!(mask_pixels > 0 || ragged_pixels > 0.0 || colors.into_iter().all(|(a, b)| *a <= b + 1e-6));
                    frame.mask.iter().zip(&given.mask).map(|(a, b)| (a - b).abs()).sum::<f32>()
                });
                each.sum()
            };
            let (found, was) = (missing(&capture.train, &body).unwrap() as i32, error(&capture));
            extend(&mut capture, &body).unwrap();
            let left = error(&capture);
            if mask_pixels < 0 {
                assert!((-mask_pixels - 1..=-mask_pixels).contains(&found) && found > 0, "{mask_pixels}: {found}");
                assert!(left < 0.7 * was, "{mask_pixels} {ragged_pixels}: {left} of {was}");
            } else {
                assert!(found == 0 && left == was, "{mask_pixels} {ragged_pixels}: {found}");
            }
        }
    }

    #[test]
    fn masks_never_grow_into_what_is_known_to_stand_before_the_person() {
        let body = BodyModel::embedded();
        let (_directory, mut capture) = on_disk("masks-occluder", 192, Layout::Wild);
        Perturbation { mask_pixels: -2, ..Perturbation::NONE }.apply(&mut capture, &body).unwrap();
        let small = capture.clone();
        mend_masks(&mut capture, &body).unwrap();
        let mut grown = 0;
        for (frame, small) in capture.train.iter().zip(&small.train) {
            let (frame, small) = (frame.pixels().unwrap(), small.pixels().unwrap());
            let covered = frame.occluder.as_deref().unwrap();
            for i in (0..covered.len()).filter(|&i| frame.mask[i] != small.mask[i]) {
                assert!(!covered[i] && frame.mask[i] > small.mask[i]);
                grown += 1;
            }
        }
        assert!(grown > 1000, "{grown}");
    }

    #[test]
    fn masks_that_show_nothing_stay_as_they_are() {
        let body = BodyModel::embedded();
        let config = DemoConfig { size: 32, frames: 2, eval_cameras: 1, ..DemoConfig::default() };
        let mut capture = demo(&config, &body).unwrap();
        Perturbation { mask_pixels: -40, ..Perturbation::NONE }.apply(&mut capture, &body).unwrap();
        mend_masks(&mut capture, &body).unwrap();
        assert_eq!(excess(&capture.train).unwrap(), 0);
        assert_eq!(excess(&[]).unwrap(), 0);
    }
}
