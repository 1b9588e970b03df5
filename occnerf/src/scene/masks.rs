//! Masks that are too large: where they end, pictures should have an edge.
//!
//! A segmenter that errs by some pixels errs so all around and in every frame. Of all lines inside
//! the mask at an even distance from where it ends, the one across which colours change most is
//! then the person's outline, and not the mask's. Nothing is seen outside a mask, so one that is
//! too small cannot be told.

use rayon::prelude::*;

use crate::Error;
use crate::capture::{Capture, Frame, Pixels};
use crate::scene::labels::squared_distance;

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

/// Shrinks the masks of the training frames by as much as they are too large.
///
/// # Errors
/// Pictures that cannot be read.
pub(crate) fn trim(capture: &mut Capture) -> Result<(), Error> {
    let excess = excess(&capture.train)?;
    for frame in capture.train.iter_mut().filter(|_| excess > 0) {
        frame.shrink_mask(excess)?;
    }
    Ok(())
}

/// By how many pixels the masks are too large; 0 where no line stands out.
fn excess(frames: &[Frame]) -> Result<u32, Error> {
    let each: Vec<&Frame> = frames.iter().step_by(frames.len().div_ceil(FRAMES).max(1)).collect();
    let changes: Result<Vec<_>, Error> = each.par_iter().map(|frame| Ok(changes(&*frame.pixels()?))).collect();
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
    use smpl::BodyModel;

    use super::*;
    use crate::capture::{DemoConfig, Perturbation, demo};

    #[test]
    fn masks_that_are_too_large_are_found_and_trimmed_and_no_others() {
        let body = BodyModel::embedded();
        let config = DemoConfig { size: 192, frames: 12, eval_cameras: 1, ..DemoConfig::default() };
        let given = demo(&config, &body).unwrap();
        let area = |c: &Capture| c.train.iter().map(|f| f.shown().mask.iter().sum::<f32>()).sum::<f32>();
        for (mask_pixels, ragged_pixels) in [(0, 0.0), (-3, 0.0), (-1, 0.0), (0, 2.0), (2, 0.0), (3, 0.0), (5, 0.0)] {
            let mut capture = given.clone();
            let wrong = Perturbation { mask_pixels, ragged_pixels, ..Perturbation::NONE };
            wrong.apply(&mut capture, &body).unwrap();
            let found = excess(&capture.train).unwrap() as i32;
            let spoilt = area(&capture);
            trim(&mut capture).unwrap();
            println!("{mask_pixels} {ragged_pixels}: {found}");
            if mask_pixels < 2 {
                assert!(found == 0 && area(&capture) == spoilt, "{mask_pixels} {ragged_pixels}: {found}");
            } else {
                assert!((found - mask_pixels).abs() <= 1, "{mask_pixels}: {found}");
                let (left, was) = ((area(&capture) - area(&given)).abs(), spoilt - area(&given));
                assert!(left < 0.4 * was, "{mask_pixels}: {left} of {was}");
            }
        }
    }

    #[test]
    fn masks_that_show_nothing_stay_as_they_are() {
        let body = BodyModel::embedded();
        let config = DemoConfig { size: 32, frames: 2, eval_cameras: 1, ..DemoConfig::default() };
        let mut capture = demo(&config, &body).unwrap();
        Perturbation { mask_pixels: -40, ..Perturbation::NONE }.apply(&mut capture, &body).unwrap();
        trim(&mut capture).unwrap();
        assert_eq!(excess(&capture.train).unwrap(), 0);
        assert_eq!(excess(&[]).unwrap(), 0);
    }
}
