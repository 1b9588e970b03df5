//! Correction of masks that are dilated or eroded by a constant number of pixels, or have
//! background at their rims.
//!
//! The person's outline is the level set of the distance to the mask's edge with the largest mean
//! colour gradient over all frames. Level sets outside the mask need the unmasked photograph, which
//! captures on disk have.

use glam::Vec3;
use rayon::prelude::*;
use smpl::BodyModel;

use crate::Error;
use crate::capture::{Capture, Frame, Image, Mended, Mending, Pixels};
use crate::config::OccludedRule;
use crate::model::view::PosedView;
use crate::scene::labels::{Label, label_pixels, squared_distance};

/// Most sampled frames.
const FRAMES: usize = 16;
/// Level sets inside the mask, one a pixel, and the deepest candidate for the outline.
const LINES: usize = 12;
const FARTHEST: usize = 8;
/// Depth of the antialiased edge of an exact mask, pixels.
const BLUR: usize = 1;
/// Least ratio of the gradient across the outline to the median level set's.
const OUTSTANDING: f64 = 1.6;
/// Least pixel pairs across a level set, and least level sets with that many.
const PAIRS: u64 = 100;
const ENOUGH: usize = 8;
/// Level sets around a mask: [`LINES`] outside, the edge, and 4 inside.
const AROUND: usize = LINES + 5;
/// Least gradient of the outline relative to the largest, and largest gradient of a level set
/// outside relative to the outline's.
const NEARLY: f64 = 0.75;
const RISE: f64 = 0.6;
/// Passes of growing.
const PASSES: usize = 3;
/// Largest distance of grown pixels from the body, metres.
const NEAR: f32 = 0.1;

/// Erodes or dilates the masks of the training frames to the person's outline, and removes
/// background at their rims.
///
/// # Errors
/// Pictures that cannot be read.
pub fn mend_masks(mut capture: Capture, model: &BodyModel) -> Result<Mended, Error> {
    let growth = resize(&mut capture, model)?;
    let background = leave_out_background(&mut capture, model)?;
    Ok(Mended { capture, mending: Mending { growth, background } })
}

/// Erodes or dilates the masks to the person's outline; returns the pixels by which they grow.
fn resize(capture: &mut Capture, model: &BodyModel) -> Result<i32, Error> {
    match excess(&capture.train)? {
        0 => extend(capture, model),
        excess => {
            capture.train.iter_mut().for_each(|frame| frame.source.edit(move |pixels| pixels.grow(-excess)));
            Ok(-excess)
        }
    }
}

/// Removes pixels from the masks that look like the background beside them, which is where neither
/// the person nor an occluder may be; their share of the masks.
fn leave_out_background(capture: &mut Capture, model: &BodyModel) -> Result<f32, Error> {
    let of_frame = |frame: &mut Frame| -> Result<[usize; 2], Error> {
        let Some(photograph) = frame.source.photograph().transpose()? else { return Ok([0; 2]) };
        let pixels = frame.pixels()?;
        let outside = free(frame, &pixels, model, 0, f32::INFINITY)?;
        let found = background(&pixels, &photograph, outside);
        let counts = [found.len(), pixels.mask.iter().filter(|&&m| m > 0.5).count()];
        if !found.is_empty() {
            frame.source.edit(move |pixels| found.iter().for_each(|&i| pixels.cover(i, 0.0)));
        }
        Ok(counts)
    };
    let counts: Vec<[usize; 2]> = capture.train.par_iter_mut().map(of_frame).collect::<Result<_, _>>()?;
    let [found, all] = [0, 1].map(|k| counts.iter().map(|count| count[k]).sum::<usize>());
    Ok(found as f32 / all.max(1) as f32)
}

/// Number of pixels by which the masks are too large; 0 where no level set stands out, or the
/// gradient does not fall from it towards the mask's edge: photographs are blurred, and the outline
/// of an exact mask is at its edge.
fn excess(frames: &[Frame]) -> Result<i32, Error> {
    let sums = total(frames, |frame| Ok(Some(inner_gradients(&frame.pixels()?))))?;
    let crossed = sums.iter().take_while(|sum| sum.1 >= PAIRS);
    let means: Vec<f64> = crossed.map(|(change, pairs)| change / *pairs as f64).collect();
    if means.len() < ENOUGH {
        return Ok(0);
    }
    let mut sorted = means.clone();
    sorted.sort_by(f64::total_cmp);
    let most = (BLUR..FARTHEST).max_by(|&a, &b| means[a].total_cmp(&means[b])).unwrap_or(0);
    let stands_out = means[most] > OUTSTANDING * sorted[means.len() / 2] && means[0] < RISE * means[most];
    Ok(if stands_out { most as i32 + 1 } else { 0 })
}

/// Sums over the sampled frames.
fn total<const N: usize>(
    frames: &[Frame],
    gradients: impl Fn(&Frame) -> Result<Option<Gradients<N>>, Error> + Sync,
) -> Result<Gradients<N>, Error> {
    let sampled: Vec<&Frame> = frames.iter().step_by(frames.len().div_ceil(FRAMES).max(1)).collect();
    let each: Result<Vec<_>, Error> = sampled.par_iter().map(|frame| gradients(frame)).collect();
    let mut sums = [(0.0, 0); N];
    for gradients in each?.into_iter().flatten() {
        sums.iter_mut().zip(gradients).for_each(|(sum, (change, pairs))| *sum = (sum.0 + change, sum.1 + pairs));
    }
    Ok(sums)
}

/// Grows the masks into the photographs near the body, away from occluders; returns the pixels by
/// which they grow.
fn extend(capture: &mut Capture, model: &BodyModel) -> Result<i32, Error> {
    let mut growth = 0;
    for _ in 0..PASSES {
        let missing = missing(&capture.train, model)?;
        if missing == 0 {
            break;
        }
        growth += missing as i32;
        capture.train.par_iter_mut().try_for_each(|frame| -> Result<(), Error> {
            let Some(photograph) = frame.source.photograph().transpose()? else { return Ok(()) };
            let pixels = frame.pixels()?;
            let free = free(frame, &pixels, model, missing, NEAR)?;
            let added = pixels.beyond_mask(&photograph, missing, |i| free[i]);
            frame.source.edit(move |pixels| pixels.show(&added));
            Ok(())
        })?;
    }
    Ok(growth)
}

/// Number of pixels by which the masks are too small; 0 where no level set outside is the outline.
///
/// The outline is the outermost level set with nearly the largest gradient, if the next one outside
/// has a much smaller one. Ragged and blurred outlines rise slowly.
fn missing(frames: &[Frame], model: &BodyModel) -> Result<u32, Error> {
    let sums = total(frames, |frame| outer_gradients(frame, model))?;
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
    // The first candidate may belong to an edge farther out.
    Ok(if outline > candidates.start && outline < LINES && rises { (LINES - outline) as u32 } else { 0 })
}

/// Pixels (H × W) into which a mask may grow by `reach`: within `near` metres of the body, and away
/// from known and possible occluders.
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

/// The mask dilated by `by` pixels.
fn larger(mask: &[f32], width: usize, by: f32) -> Vec<f32> {
    let inside: Vec<bool> = mask.iter().map(|&m| m > 0.5).collect();
    squared_distance(&inside, width).into_iter().map(|d| f32::from(d <= by * by)).collect()
}

/// Summed colour difference across each of N level sets, and number of pixel pairs.
type Gradients<const N: usize> = [(f64, u64); N];

/// Gradients of the photograph from 12 pixels outside the mask to 4 inside; `None` without a
/// photograph of the subject.
fn outer_gradients(frame: &Frame, model: &BodyModel) -> Result<Option<Gradients<AROUND>>, Error> {
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
    let color = |i: usize, c: usize| photograph.pixels[3 * i + c];
    let usable: Vec<bool> = inside.iter().zip(free).map(|(&inside, free)| inside || free).collect();
    Ok(Some(gradients(&usable, width, depth, color, -(LINES as i64))))
}

/// Gradients 1, 2, … pixels inside the mask.
fn inner_gradients(pixels: &Pixels) -> Gradients<LINES> {
    let width = pixels.image.width as usize;
    let inside: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
    let outside: Vec<bool> = inside.iter().map(|i| !i).collect();
    let depth: Vec<f32> = squared_distance(&outside, width).into_iter().map(f32::sqrt).collect();
    let color = |i: usize, c: usize| pixels.image.pixels[3 * i + c] / pixels.mask[i];
    gradients(&inside, width, |i| depth[i], color, 1)
}

/// Sums over pairs of `usable` neighbours across the level sets of `depth` from `first` on.
fn gradients<const N: usize>(
    usable: &[bool],
    width: usize,
    depth: impl Fn(usize) -> f32,
    color: impl Fn(usize, usize) -> f32,
    first: i64,
) -> Gradients<N> {
    let mut sums = [(0.0, 0); N];
    for i in (0..usable.len()).filter(|&i| usable[i]) {
        let neighbours = [(i % width + 1 < width).then_some(i + 1), Some(i + width)];
        for j in neighbours.into_iter().flatten().filter(|&j| j < usable.len() && usable[j]) {
            let (near, far) = (depth(i).min(depth(j)), depth(i).max(depth(j)));
            let change: f32 = (0..3).map(|c| (color(i, c) - color(j, c)).abs()).sum();
            // Neighbours are less than two level sets apart.
            for line in near.ceil() as i64..far.ceil() as i64 {
                let sum = usize::try_from(line - first).ok().and_then(|line| sums.get_mut(line));
                if let Some(sum) = sum {
                    *sum = (sum.0 + f64::from(change), sum.1 + 1);
                }
            }
        }
    }
    sums
}

/// Width of the rim relative to the height of the mask, and least width, pixels.
const RIM: f32 = 0.025;
const LEAST_RIM: usize = 2;
/// Least distance between the mean colours of background and person beside a pixel.
const CONTRAST: f32 = 0.15;
/// Largest distance of a background pixel from the mean colour of the background, also relative to
/// that from the person's.
const ALIKE: f32 = 0.1;
const NEARER: f32 = 0.3;

/// Pixels of a mask with the mean colour of the background beside them, unlike the person's deeper
/// inside, that such pixels join to the background. `outside`: known background, beside pixels of
/// the mask.
fn background(pixels: &Pixels, photograph: &Image, mut outside: Vec<bool>) -> Vec<usize> {
    let (width, height) = (photograph.width as usize, photograph.height as usize);
    let inside: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
    let is_row = |y: &usize| inside[y * width..][..width].contains(&true);
    let rows = (0..height).rev().find(is_row).zip((0..height).find(is_row)).map_or(0, |(last, first)| last - first);
    let rim = ((rows as f32 * RIM).round() as usize).max(LEAST_RIM);
    outside.iter_mut().zip(&inside).for_each(|(outside, inside)| *outside &= !inside);
    let depth = squared_distance(&inside.iter().map(|i| !i).collect::<Vec<_>>(), width);
    let color = |i: usize| Vec3::from_slice(&photograph.pixels[3 * i..]);
    let around = Means::new([width, height], |i| outside[i].then(|| color(i)));
    let within = Means::new([width, height], |i| (depth[i] > (rim * rim) as f32).then(|| color(i)));
    let is_background = |i: usize| {
        let (Some(background), Some(person)) = (around.at(i, rim), within.at(i, 2 * rim)) else { return false };
        let away = color(i).distance(background);
        background.distance(person) > CONTRAST && away < ALIKE && away < NEARER * color(i).distance(person)
    };
    let mut open: Vec<usize> = (0..inside.len()).filter(|&i| outside[i]).collect();
    let mut reached = outside;
    let mut found = Vec::new();
    while let Some(i) = open.pop() {
        let (x, y) = (i % width, i / width);
        let near = [
            (x > 0, i.wrapping_sub(1)),
            (x + 1 < width, i + 1),
            (y > 0, i.wrapping_sub(width)),
            (y + 1 < height, i + width),
        ];
        for (_, j) in near.into_iter().filter(|near| near.0) {
            if inside[j] && !reached[j] && is_background(j) {
                reached[j] = true;
                found.push(j);
                open.push(j);
            }
        }
    }
    found
}

/// Mean colours of a set of pixels in squares, by a summed-area table (Crow 1984).
struct Means {
    width: usize,
    height: usize,
    /// Sums and counts above and to the left, (H + 1, W + 1).
    sums: Vec<(Vec3, f32)>,
}

impl Means {
    /// Of the pixels that have a `color`.
    fn new([width, height]: [usize; 2], color: impl Fn(usize) -> Option<Vec3>) -> Self {
        let mut sums = vec![(Vec3::ZERO, 0.0); (width + 1) * (height + 1)];
        for y in 0..height {
            let mut row = (Vec3::ZERO, 0.0);
            for x in 0..width {
                if let Some(color) = color(y * width + x) {
                    row = (row.0 + color, row.1 + 1.0);
                }
                let above: (Vec3, f32) = sums[y * (width + 1) + x + 1];
                sums[(y + 1) * (width + 1) + x + 1] = (above.0 + row.0, above.1 + row.1);
            }
        }
        Self { width, height, sums }
    }

    /// Mean in the square about a pixel; `None` where it has none of the set.
    fn at(&self, pixel: usize, radius: usize) -> Option<Vec3> {
        let (x, y) = (pixel % self.width, pixel / self.width);
        let (left, right) = (x.saturating_sub(radius), (x + radius + 1).min(self.width));
        let (top, bottom) = (y.saturating_sub(radius), (y + radius + 1).min(self.height));
        let [a, b, c, d] = [(left, top), (right, top), (left, bottom), (right, bottom)]
            .map(|(x, y)| self.sums[y * (self.width + 1) + x]);
        let count = d.1 - b.1 - c.1 + a.1;
        (count > 0.5).then(|| (d.0 - b.0 - c.0 + a.0) / count)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use synth::{DemoConfig, Perturbation, SynthConfig, demo, synthesise};
    use testkit::files::Directory;
    use volrender::RandomStream;

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
            let noise = Perturbation { mask_pixels, ragged_pixels, ..Perturbation::NONE };
            noise.apply(&mut capture, &body).unwrap();
            let found = excess(&capture.train).unwrap();
            let corrupted = area(&capture);
            resize(&mut capture, &body).unwrap();
            println!("{mask_pixels} {ragged_pixels}: {found}");
            if mask_pixels < 2 {
                // Those that are too small grow.
                let kept = mask_pixels < 0 || area(&capture) == corrupted;
                assert!(found == 0 && kept, "{mask_pixels} {ragged_pixels}: {found}");
            } else {
                assert!((found - mask_pixels).abs() <= 1, "{mask_pixels}: {found}");
                let (left, was) = ((area(&capture) - area(&given)).abs(), corrupted - area(&given));
                assert!(left < 0.4 * was, "{mask_pixels}: {left} of {was}");
            }
        }
        // Little of a person looks like the background.
        let background = leave_out_background(&mut given.clone(), &body).unwrap();
        assert!(background < 0.005, "{background}");
    }

    /// Separable binomial blur of variance `passes` / 2.
    fn blurred(mut image: crate::capture::Image, passes: usize) -> crate::capture::Image {
        let (width, height) = (image.width as usize, image.height as usize);
        for (step, count) in std::iter::repeat_n([(3, width), (3 * width, height)], passes).flatten() {
            let old = image.pixels.clone();
            for i in 0..old.len() {
                let at = i / step % count;
                let before = if at > 0 { old[i - step] } else { old[i] };
                let after = if at + 1 < count { old[i + step] } else { old[i] };
                image.pixels[i] = (before + 2.0 * old[i] + after) / 4.0;
            }
        }
        image
    }

    #[test]
    fn exact_masks_of_blurred_photographs_are_not_trimmed() {
        let body = BodyModel::embedded();
        let (_directory, given) = on_disk("masks-blurred", 192, Layout::Wild);
        for (passes, mask_pixels) in [(1, 0), (2, 0), (4, 0), (8, 0), (1, 3), (2, 4)] {
            let mut capture = given.clone();
            Perturbation { mask_pixels, ..Perturbation::NONE }.apply(&mut capture, &body).unwrap();
            for frame in &mut capture.train {
                let photograph = blurred(frame.source.photograph().unwrap().unwrap(), passes);
                frame.source.edit(move |pixels| {
                    pixels.image = photograph.clone();
                    pixels.image.multiply(&pixels.mask.clone());
                });
            }
            let found = excess(&capture.train).unwrap();
            println!("blurred {passes} times, {mask_pixels}: {found}");
            assert!((found - mask_pixels).abs() <= 1 && (mask_pixels > 0 || found == 0), "{passes}: {found}");
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
            let noise = Perturbation { mask_pixels, ragged_pixels, ..Perturbation::NONE };
            noise.apply(&mut capture, &body).unwrap();
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

    /// The photograph shows the person behind a simulated obstacle.
    #[test]
    fn what_is_hidden_is_no_background() {
        let body = BodyModel::embedded();
        let (_directory, mut capture) = on_disk("masks-hidden", 192, Layout::HumanNerf);
        for frame in &mut capture.train {
            frame.source.hide(crate::capture::Area { columns: 0..96, rows: 0..192 });
        }
        assert_eq!(leave_out_background(&mut capture, &body).unwrap(), 0.0);
    }

    #[test]
    fn masks_never_grow_into_what_is_known_to_stand_before_the_person() {
        let body = BodyModel::embedded();
        let (_directory, mut capture) = on_disk("masks-occluder", 192, Layout::Wild);
        Perturbation { mask_pixels: -2, ..Perturbation::NONE }.apply(&mut capture, &body).unwrap();
        let mut grown_capture = capture.clone();
        resize(&mut grown_capture, &body).unwrap();
        let mut grown = 0;
        for (frame, small) in grown_capture.train.iter().zip(&capture.train) {
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
        let Mended { capture, .. } = mend_masks(capture, &body).unwrap();
        assert_eq!(excess(&capture.train).unwrap(), 0);
        assert_eq!(excess(&[]).unwrap(), 0);
    }

    const SIDE: usize = 80;

    /// A light disc before a dark wall with noise of deviation `noise`, and a mask of it that has
    /// also the pixels of `wall`.
    fn scene(noise: f32, seed: u64, wall: impl Fn(usize, usize) -> bool) -> (Pixels, Image) {
        let mut stream = RandomStream::new(&[seed]);
        let is_person = |x: usize, y: usize| (x as f32 - 40.0).hypot(y as f32 - 40.0) < 25.0;
        let place = |i: usize| (i % SIDE, i / SIDE);
        let each = (0..SIDE * SIDE).map(place);
        let colors = each.clone().flat_map(|(x, y)| {
            let tone = if is_person(x, y) { 0.8 } else { 0.3 };
            [0; 3].map(|_| tone + noise * stream.normal())
        });
        let photograph = Image { width: SIDE as u32, height: SIDE as u32, pixels: colors.collect() };
        let mask: Vec<f32> = each.map(|(x, y)| if is_person(x, y) || wall(x, y) { 1.0 } else { 0.0 }).collect();
        let mut image = photograph.clone();
        image.multiply(&mask);
        (Pixels { image, mask, occluder: None }, photograph)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        #[test]
        fn means_are_those_of_a_loop_over_the_square(seed in any::<u64>(), pixel in 0usize..63, radius in 1usize..5) {
            let mut stream = RandomStream::new(&[seed]);
            let colors: Vec<Option<Vec3>> =
                (0..63).map(|_| (stream.uniform() < 0.4).then(|| Vec3::splat(stream.uniform()))).collect();
            let found = Means::new([9, 7], |i| colors[i]).at(pixel, radius);
            let is_near = |i: &usize| (i % 9).abs_diff(pixel % 9) <= radius && (i / 9).abs_diff(pixel / 9) <= radius;
            let near: Vec<Vec3> = (0..63).filter(is_near).filter_map(|i| colors[i]).collect();
            let expected = (!near.is_empty()).then(|| near.iter().sum::<Vec3>() / near.len() as f32);
            prop_assert_eq!(found.is_some(), expected.is_some());
            prop_assert!(found.zip(expected).is_none_or(|(a, b)| a.distance(b) < 1e-4));
        }

        /// A strip of the wall 3 pixels wide beside the person.
        #[test]
        fn wall_in_the_mask_is_found_and_nothing_else(seed in any::<u64>(), noise in 0.0f32..0.015) {
            let is_strip = |x: usize, y: usize| (62..68).contains(&x) && (30..50).contains(&y);
            let (pixels, photograph) = scene(noise, seed, is_strip);
            let found = background(&pixels, &photograph, vec![true; SIDE * SIDE]);
            let is_wall = |i: usize| (i % SIDE) as f32 - 40.0 > 0.0
                && is_strip(i % SIDE, i / SIDE)
                && ((i % SIDE) as f32 - 40.0).hypot((i / SIDE) as f32 - 40.0) >= 25.0;
            prop_assert!(found.iter().all(|&i| is_wall(i)));
            let strip = (0..SIDE * SIDE).filter(|&i| is_wall(i)).count();
            prop_assert!(found.len() > strip / 2, "{} of {strip}", found.len());
            prop_assert!(background(&scene(noise, seed, |_, _| false).0, &photograph, vec![true; SIDE * SIDE]).is_empty());
        }
    }

    #[test]
    fn without_known_background_and_without_a_mask_there_is_none() {
        let (mut pixels, photograph) = scene(0.0, 1, |x, y| (62..68).contains(&x) && (30..50).contains(&y));
        assert!(background(&pixels, &photograph, vec![false; SIDE * SIDE]).is_empty());
        pixels.mask.fill(0.0);
        assert!(background(&pixels, &photograph, vec![true; SIDE * SIDE]).is_empty());
    }
}
