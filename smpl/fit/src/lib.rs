//! Poses, place and shape of a body from 3-D points of every frame.
//!
//! [`fit`] takes any [`BodyModel`], measured points of T frames, and for each point its [`Anchor`]
//! on the body; [`joint_set`] has those of common sets of key points. [`ground`] stops the feet of
//! a motion from sliding.
//!
//! ```
//! use glam::Vec3;
//! use point_fit::{Anchor, fit};
//! use smpl::{BodyModel, Placement};
//!
//! let body = BodyModel::embedded();
//! let mut pose = vec![Vec3::ZERO; 24];
//! pose[18] = Vec3::new(0.0, -1.2, 0.0); // left elbow
//! let measured = body.pose(&body.shaped(&[]), &pose, Placement::default()).joints;
//!
//! let anchors: Vec<Anchor> = (0..24).map(Anchor::joint).collect();
//! let fitted = fit(&body, &anchors, &measured)?;
//! assert!(fitted.frames[0].distance.unwrap() < 0.005); // metres
//! assert!(fitted.frames[0].pose[18].y < -0.9);
//! # Ok::<(), point_fit::FitError>(())
//! ```
//!
//! # Method
//! Levenberg–Marquardt with analytic derivatives through the kinematic tree. Points have Cauchy's
//! loss at the noise measured from their second differences in time; rotations a weak prior at
//! rest, and limits where the tree is SMPL's; rotations and place small second differences in time.
//! Betas have unit variance and are found from at most 64 frames and the first 128, poses then in
//! windows of 128 frames, each by one block-pentadiagonal system, so that hidden joints follow
//! their neighbours in time. The first guess solves Procrustes' problem of one joint after the
//! other.
//!
//! # Conventions
//! Metres, radians; points and [`Placement::Pelvis`](smpl::Placement) in one right-handed space of
//! any axes. Arithmetic is `f64` and independent of the number of threads.

mod anchor;
mod band;
mod frame;
mod ground;
mod relax;
mod skeleton;
mod start;
mod swaps;

/// The README's example, compiled as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

pub use anchor::{Anchor, joint_set, joint_sets};
pub use ground::{Grounded, ground};

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use smpl::BodyModel;

use relax::{Problem, relax};
use skeleton::{Shape, Skeleton, State, log};
use start::{LEAST, start};

/// Betas at most.
const BETAS: usize = 10;
/// Frames from which the shape is found.
const SHAPE_FRAMES: usize = 64;
/// Frames of a window, and those on either side that its neighbours keep.
const WINDOW: usize = 128;
const MARGIN: usize = 24;
/// Noise where it cannot be measured, its least and its greatest, metres.
const NOISE: [f64; 3] = [0.01, 0.002, 0.1];
/// Largest coordinate, metres.
const FAR: f64 = 1e5;

/// The body in all frames, from [`fit`].
///
/// ```
/// use point_fit::{Anchor, fit};
///
/// let body = smpl::BodyModel::embedded();
/// let anchors: Vec<Anchor> = (0..24).map(Anchor::joint).collect();
/// // Two frames of a tall person at rest, whose thighs are found to within 5 mm.
/// let tall = body.shaped(&[1.5]).joints;
/// let fitted = fit(&body, &anchors, &tall.repeat(2))?;
/// let found = body.shaped(&fitted.betas).joints;
/// assert!((found[1].distance(found[4]) - tall[1].distance(tall[4])).abs() < 0.005 && fitted.frames.len() == 2);
/// # Ok::<(), point_fit::FitError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Fitted {
    /// Shape coefficients of all frames, at most 10.
    pub betas: Vec<f32>,
    /// One a frame.
    pub frames: Vec<FittedFrame>,
    /// Standard deviation of a coordinate of a point, metres, as measured between frames: 2 mm to
    /// 10 cm, and 1 cm where fewer than three frames are at hand.
    pub noise: f32,
}

/// The body in one frame.
///
/// ```
/// use glam::Vec3;
/// use point_fit::{Anchor, Fitted, fit};
/// use smpl::{BodyModel, Placement};
///
/// let (body, anchors): (_, Vec<Anchor>) = (BodyModel::embedded(), (0..24).map(Anchor::joint).collect());
/// let seen: Vec<Vec3> = body.shaped(&[]).joints.iter().map(|joint| *joint + Vec3::X).collect();
/// let Fitted { betas, frames, .. } = fit(&body, &anchors, &seen)?;
/// let placement = Placement::Pelvis { translation: frames[0].translation };
/// let posed = body.pose(&body.shaped(&betas), &frames[0].pose, placement);
/// assert!(posed.joints[20].distance(seen[20]) < 0.01); // left wrist, metres
/// # Ok::<(), point_fit::FitError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct FittedFrame {
    /// Axis-angle of each joint relative to its parent, (J). Joints that move no point are at rest.
    pub pose: Vec<Vec3>,
    /// Translation of [`smpl::Placement::Pelvis`].
    pub translation: Vec3,
    /// Root mean square distance of the frame's points from the body's; `None` without points.
    pub distance: Option<f32>,
    /// Whether left and right of the points were taken for each other's.
    pub swapped: bool,
}

/// Input of [`fit`] or [`ground`] that has no solution: what was expected, and found.
///
/// ```
/// use point_fit::{Anchor, fit};
///
/// let body = smpl::BodyModel::embedded();
/// let error = fit(&body, &[Anchor::joint(0)], &[glam::Vec3::ZERO; 2]).unwrap_err();
/// assert_eq!(error.to_string(), "expected a frame with 4 finite points or more, found at most 1");
/// ```
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct FitError(String);

/// Fits a body to `seen`, (T, P) points, P of each frame in the order of `anchors`. Points that are
/// not finite, or farther than 100 km, are missing.
///
/// The body's first ten betas are found; a rigged character gets some by
/// [`BodyModel::with_limb_lengths`].
///
/// # Errors
/// For an anchor without joints and vertices, beyond the body's, or with weights that do not sum to
/// 1; points that are no multiple of the anchors; frames of fewer than four points each.
pub fn fit(body: &BodyModel, anchors: &[Anchor], seen: &[Vec3]) -> Result<Fitted, FitError> {
    anchors.iter().enumerate().try_for_each(|(i, anchor)| check(body, i, anchor))?;
    let count = anchors.len();
    if count == 0 || !seen.len().is_multiple_of(count) {
        let found = seen.len();
        return Err(FitError(format!("expected points of whole frames, {count} each, found {found} points")));
    }
    let point = |p: &Vec3| Some(p.as_dvec3()).filter(|p| p.abs().cmple(DVec3::splat(FAR)).all()).unwrap_or(DVec3::NAN);
    let mut seen: Vec<Vec<DVec3>> = seen.chunks(count).map(|frame| frame.iter().map(point).collect()).collect();
    let most = seen.iter().map(|frame| visible(frame)).max().unwrap_or(0);
    if most < LEAST {
        return Err(FitError(format!("expected a frame with {LEAST} finite points or more, found at most {most}")));
    }
    let skeleton = Skeleton::new(body, anchors, body.num_betas().min(BETAS));
    let swapped = swaps::undo(&skeleton, &mut seen);
    let noise = noise(&seen);

    // The shape, from frames with most of the points, evenly over the video.
    let full: Vec<&Vec<DVec3>> = seen.iter().filter(|frame| 5 * visible(frame) >= 4 * most).collect();
    let chosen = full.len().min(SHAPE_FRAMES);
    let chosen: Vec<Vec<DVec3>> = (0..chosen).map(|i| full[i * full.len() / chosen].clone()).collect();
    let mut betas = vec![0.0; skeleton.directions.len()];
    let mut states: Vec<State> = chosen.par_iter().map(|frame| start(&skeleton, &skeleton.mean, frame)).collect();
    let problem = Problem { skeleton: &skeleton, seen: &chosen, noise, smooth: false };
    relax(problem, &mut states, &mut betas, true);
    // Again with smooth motion: noise of single frames lengthens the bones.
    let first = &seen[..seen.len().min(WINDOW)];
    let shape = skeleton.shape(&betas);
    let mut states = guesses(&skeleton, &shape, first);
    if states.len() > 1 {
        relax(Problem { skeleton: &skeleton, seen: first, noise, smooth: true }, &mut states, &mut betas, true);
    }

    let shape = skeleton.shape(&betas);
    let states = guesses(&skeleton, &shape, &seen);
    let window = |first: usize| {
        let (from, last) = (first.saturating_sub(MARGIN), (first + WINDOW).min(states.len()));
        let to = (last + MARGIN).min(states.len());
        let mut inner = states[from..to].to_vec();
        let problem = Problem { skeleton: &skeleton, seen: &seen[from..to], noise, smooth: true };
        relax(problem, &mut inner, &mut betas.clone(), false);
        inner.drain(first - from..last - from).collect::<Vec<State>>()
    };
    let starts: Vec<usize> = (0..states.len()).step_by(WINDOW).collect();
    let windows: Vec<Vec<State>> = starts.into_par_iter().map(window).collect();
    let frame = |((state, seen), swapped): ((&State, &Vec<DVec3>), bool)| {
        let points = skeleton.points(&shape, &skeleton.frames(&shape, state));
        let squares = points.iter().zip(seen).filter(|(_, seen)| seen.is_finite()).map(|(p, s)| p.distance_squared(*s));
        let mean = squares.sum::<f64>() / visible(seen).max(1) as f64;
        FittedFrame {
            pose: state.turns.iter().map(|turn| log(*turn).as_vec3()).collect(),
            translation: (state.place - shape.offsets[0]).as_vec3(),
            distance: (visible(seen) > 0).then_some(mean.sqrt() as f32),
            swapped,
        }
    };
    let frames = windows.iter().flatten().zip(&seen).zip(swapped).map(frame).collect();
    Ok(Fitted { betas: betas.iter().map(|b| *b as f32).collect(), frames, noise: noise as f32 })
}

fn visible(frame: &[DVec3]) -> usize {
    frame.iter().filter(|p| p.is_finite()).count()
}

/// First guesses of all frames; none if no frame has enough points.
fn guesses(skeleton: &Skeleton, shape: &Shape, seen: &[Vec<DVec3>]) -> Vec<State> {
    let guess = |frame: &Vec<DVec3>| (visible(frame) >= LEAST).then(|| start(skeleton, shape, frame));
    let mut states: Vec<Option<State>> = seen.par_iter().map(guess).collect();
    // Frames with few points begin as the last with more, those before the first as the first.
    let mut last = states.iter().flatten().next().cloned();
    for state in &mut states {
        *state = state.take().or_else(|| last.clone());
        last.clone_from(state);
    }
    states.into_iter().flatten().collect()
}

fn check(body: &BodyModel, i: usize, anchor: &Anchor) -> Result<(), FitError> {
    let expected = "weights of the body's joints and vertices that sum to 1";
    let fault = |found: String| Err(FitError(format!("anchor {i}: expected {expected}, found {found}")));
    for (what, parts, most) in
        [("joint", &anchor.joints, body.num_joints()), ("vertex", &anchor.vertices, body.num_vertices())]
    {
        if let Some((at, _)) = parts.iter().find(|(at, _)| *at >= most) {
            return fault(format!("{what} {at} of {most}"));
        }
    }
    let sum: f32 = anchor.joints.iter().chain(&anchor.vertices).map(|(_, weight)| weight).sum();
    // Also for NaN.
    if (sum - 1.0).abs() <= 1e-3 { Ok(()) } else { fault(format!("a sum of {}", sum + 0.0)) }
}

/// Standard deviation of coordinates, from the median of second differences in time.
fn noise(seen: &[Vec<DVec3>]) -> f64 {
    /// Standard deviations of a normal distribution in a median absolute value, and of a second
    /// difference in one of a value.
    const SCALE: f64 = 1.4826 / 2.449_489_742_783_178;
    let second = seen.windows(3).flat_map(|w| (0..w[0].len()).map(|i| w[0][i] - 2.0 * w[1][i] + w[2][i]));
    let mut second: Vec<f64> = second.filter(|d| d.is_finite()).flat_map(|d| d.abs().to_array()).collect();
    second.sort_by(f64::total_cmp);
    let [unknown, least, most] = NOISE;
    second.get(second.len() / 2).map_or(unknown, |median| (SCALE * median).clamp(least, most))
}
