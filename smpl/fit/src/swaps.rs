//! Frames in which left and right were taken for each other.

use glam::DVec3;
use rayon::prelude::*;

use crate::relax::{Problem, relax};
use crate::skeleton::Skeleton;
use crate::start::{LEAST, start};
use crate::visible;

/// Part of a distance, or of a cost, below which the exchange is believed.
const STRONG: f64 = 0.5;
/// Frames that decide which of the two is right, and their noise, metres.
const SAMPLE: usize = 32;
const NOISE: f64 = 0.05;

/// Exchanges left and right where they jump between frames, and in all frames where the body then
/// fits much better; says in which.
pub(crate) fn undo(skeleton: &Skeleton, seen: &mut [Vec<DVec3>]) -> Vec<bool> {
    let exchanged = |frame: &[DVec3]| -> Vec<DVec3> { skeleton.opposite.iter().map(|&i| frame[i]).collect() };
    let mut swapped = vec![false; seen.len()];
    let mut last: Option<usize> = None;
    for f in 0..seen.len() {
        if visible(&seen[f]) < LEAST {
            continue;
        }
        if let Some(before) = last {
            let jumps = moved(skeleton, &seen[before], &exchanged(&seen[f]))
                .zip(moved(skeleton, &seen[before], &seen[f]))
                .is_some_and(|(exchanged, same)| exchanged < STRONG * same);
            swapped[f] = swapped[before] != jumps;
        }
        last = Some(f);
    }
    let known: Vec<usize> = (0..seen.len()).filter(|&f| visible(&seen[f]) >= LEAST).collect();
    let flip = 2 * known.iter().filter(|&&f| swapped[f]).count() > known.len();
    swapped.iter_mut().for_each(|s| *s ^= flip);
    let chosen = known.len().min(SAMPLE);
    let sample: Vec<usize> = (0..chosen).map(|i| known[i * known.len() / chosen]).collect();
    let misfit = |right: bool| {
        let frame = |&f: &usize| if swapped[f] == right { exchanged(&seen[f]) } else { seen[f].clone() };
        let points: Vec<Vec<DVec3>> = sample.iter().map(frame).collect();
        let mut states = points.par_iter().map(|frame| start(skeleton, &skeleton.mean, frame)).collect();
        let mut betas = vec![0.0; skeleton.directions.len()];
        relax(Problem { skeleton, seen: &points, noise: NOISE, smooth: false }, &mut states, &mut betas, true)
    };
    let flip = misfit(false) < STRONG * misfit(true);
    for (frame, swapped) in seen.iter_mut().zip(&mut swapped) {
        *swapped = *swapped != (flip && frame.iter().any(|p| p.is_finite()));
        if *swapped {
            *frame = exchanged(frame);
        }
    }
    swapped
}

/// Mean distance of points with an opposite between two frames, about their centres.
fn moved(skeleton: &Skeleton, a: &[DVec3], b: &[DVec3]) -> Option<f64> {
    let paired = |i: &usize| skeleton.opposite[*i] != *i && a[*i].is_finite() && b[*i].is_finite();
    let both: Vec<usize> = (0..a.len()).filter(paired).collect();
    let shift = both.iter().map(|&i| b[i] - a[i]).sum::<DVec3>() / both.len().max(1) as f64;
    let sum: f64 = both.iter().map(|&i| (b[i] - a[i]).distance(shift)).sum();
    (both.len() >= 2).then(|| sum / both.len() as f64)
}
