//! Motion on level ground, without sliding feet.

use std::ops::Range;

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use smpl::{BoneNames, Joint, MotionClip};

use crate::FitError;
use crate::band::{Band, Beside};
use crate::frame::{Normal, add, add_block, between, jacobian, stepped};
use crate::relax::couple;
use crate::skeleton::{Part, Shape, Skeleton, State, log};

/// Fastest and highest smoothed place of a part of the sole that stands, in m/s and metres.
const SPEED: f64 = 0.4;
const HEIGHT: f64 = 0.05;
/// Farthest that a standing part is from its mean place; longer contacts are cut.
const DRIFT: f64 = 0.04;
/// Farthest that a contact is lowered to the floor, in metres.
const LANDS: f64 = 0.015;
/// Standard deviation of the smoothing of places, and shortest contact, in seconds.
const SMOOTH: f64 = 0.05;
const SHORTEST: f64 = 0.1;
/// Time before and after a contact in which its leg moves towards it, in seconds.
const FADE: f64 = 0.25;
/// Longest window of smoothing, in frames.
const WINDOW: f64 = 200.0;
/// Scale of the residuals of the floor, and spread that the places on it must exceed to tell its
/// slope, in metres.
const FLOOR: f64 = 0.02;
const SPREAD: f64 = 0.1;
/// Standard deviation of a standing part along the floor, in m/s: metres at one frame per second.
const HELD: f64 = 0.008;
/// Standard deviations in metres: of a standing part's height, of the root, of other points of the
/// legs, of depth below the floor.
const LEVEL: f64 = 0.01;
const ROOT: f64 = 0.005;
const STAYS: f64 = 0.02;
const BELOW: f64 = 0.005;
/// Standard deviation of a correction of a joint, radians.
const TURN: f64 = 0.1;
/// Standard deviations of accelerations of corrections: m/s² and rad/s².
const ACCELERATIONS: [f64; 2] = [2.0, 10.0];
/// Frames at most: 11 kB each.
const FRAMES: usize = 100_000;
/// Gauss–Newton steps at most, and the relative gain of the cost below which they end.
const STEPS: usize = 20;
const GAIN: f64 = 1e-6;

/// Points of a leg: knee, ankle, heel and ball.
const POINTS: usize = 4;
const SOLE: [usize; 2] = [2, 3];

/// A motion on the floor, from [`ground`], and its distance from the given one.
///
/// ```
/// # use glam::Vec3;
/// # use smpl::{BodyModel, BoneNames, MotionClip, skeleton};
/// # let body = BodyModel::embedded();
/// # let rest = body.shaped(&[]);
/// # let sole = rest.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
/// # let skeleton = skeleton(BoneNames::Smpl, &body.parents, &rest.joints);
/// // A person who stands in the air; skeleton and soles are those of `ground`'s example.
/// let (poses, trans) = (vec![Vec3::ZERO; 30 * 24], vec![5.0 * Vec3::Y; 30]);
/// let motion = MotionClip { poses, num_joints: 24, trans, fps: 30.0 };
/// let grounded = point_fit::ground(&skeleton, &motion, sole)?;
/// let height = grounded.motion.trans[0].y + sole;
/// assert!(height.abs() < 1e-3 && grounded.standing == [1.0; 2] && grounded.tilt < 1e-3);
/// # Ok::<(), point_fit::FitError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Grounded {
    /// The motion on the floor, y = 0.
    pub motion: MotionClip,
    /// Mean horizontal speed of the standing parts of the soles, before and after, in m/s.
    pub sliding: [f32; 2],
    /// Share of the frames in which each foot stands, left and right.
    pub standing: [f32; 2],
    /// Angle by which the world was turned, in radians.
    pub tilt: f32,
    /// Farthest that a joint moved, once levelled, in metres: first the root, and with it the body
    /// but for the legs; then legs whose foot does not stand within a quarter of a second.
    pub moved: [f32; 2],
}

/// Sets a motion on level ground, for a skeleton whose soles are at height `sole` at rest, y up.
///
/// The floor is a plane fitted to the lowest places of the feet; the world is turned until it is
/// level. Heels and balls of the feet stand while they are slow and low. Place and legs are then
/// corrected by least squares over all frames: standing parts stay at their mean place on the
/// floor, everything else where it was, nothing is below the floor, and corrections are smooth in
/// time.
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, BoneNames, MotionClip, skeleton};
///
/// let body = BodyModel::embedded();
/// let rest = body.shaped(&[]);
/// let skeleton = skeleton(BoneNames::Smpl, &body.parents, &rest.joints);
/// let sole = rest.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
///
/// // A person who stands still while the camera's drift moves them.
/// let trans = (0..30).map(|t| Vec3::X * 0.003 * t as f32).collect();
/// let motion = MotionClip { poses: vec![Vec3::ZERO; 30 * 24], num_joints: 24, trans, fps: 30.0 };
/// let found = point_fit::ground(&skeleton, &motion, sole)?;
/// assert!(found.sliding[0] > 0.08 && found.sliding[1] < 0.002); // m/s
/// # Ok::<(), point_fit::FitError>(())
/// ```
///
/// # Errors
/// Names joints that the skeleton lacks by name, and bones without length; for more than 100 000
/// frames.
///
/// # Panics
/// If the motion is not of the skeleton's joints.
pub fn ground(skeleton: &[Joint], motion: &MotionClip, sole: f32) -> Result<Grounded, FitError> {
    assert_eq!(motion.poses.len(), skeleton.len() * motion.num_frames(), "ground: rotations of joints");
    if motion.num_frames() > FRAMES {
        return Err(FitError(format!("expected at most {FRAMES} frames, found {}", motion.num_frames())));
    }
    let legs = Legs::new(skeleton, sole)?;
    let root = skeleton[0].rest.as_dvec3();
    let state = |(pose, place): (&[glam::Vec3], &glam::Vec3)| State {
        place: root + place.as_dvec3(),
        turns: pose.iter().map(|turn| DQuat::from_scaled_axis(turn.as_dvec3())).collect(),
    };
    let mut states: Vec<State> = motion.poses.chunks(skeleton.len().max(1)).zip(&motion.trans).map(state).collect();
    let places = |states: &[State]| -> Vec<Vec<DVec3>> { states.iter().map(|state| legs.points(state)).collect() };

    let (normal, height) = floor(&places(&states));
    let level = DQuat::from_rotation_arc(normal, DVec3::Y);
    for state in &mut states {
        state.place = level * state.place - height * DVec3::Y;
        state.turns[0] = (level * state.turns[0]).normalize();
    }
    let before = places(&states);
    let fps = f64::from(motion.fps);
    let held = anchors(&before, fps);
    let levelled = states.clone();
    relax(&legs, &before, &held, &mut states, fps);

    let after = places(&states);
    let stands = |side: usize, t: usize| SOLE.iter().any(|part| held[t][side * POINTS + part].is_some());
    let fade = (FADE * fps).min(WINDOW).ceil() as usize;
    let mut moved = [0.0f64; 2];
    for (t, (old, new)) in levelled.iter().zip(&states).enumerate() {
        moved[0] = moved[0].max(old.place.distance(new.place));
        let window = t.saturating_sub(fade)..(t + fade + 1).min(states.len());
        for side in (0..2).filter(|side| !window.clone().any(|t| stands(*side, t))) {
            let points = (side * POINTS..(side + 1) * POINTS).map(|i| before[t][i].distance(after[t][i]));
            moved[1] = points.fold(moved[1], f64::max);
        }
    }
    let frames = states.len().max(1) as f32;
    let share = |side| (0..states.len()).filter(|t| stands(side, *t)).count() as f32 / frames;
    let motion = MotionClip {
        poses: states.iter().flat_map(|state| state.turns.iter().map(|turn| log(*turn).as_vec3())).collect(),
        trans: states.iter().map(|state| (state.place - root).as_vec3()).collect(),
        ..motion.clone()
    };
    Ok(Grounded {
        motion,
        sliding: [&before, &after].map(|places| sliding(places, &held, fps) as f32),
        standing: [0, 1].map(share),
        tilt: normal.angle_between(DVec3::Y) as f32,
        moved: moved.map(|m| m as f32),
    })
}

/// A skeleton whose unknowns are the place of its root and the rotations of hips, knees and ankles.
struct Legs(Skeleton);

impl Legs {
    fn new(joints: &[Joint], sole: f32) -> Result<Self, FitError> {
        let names: Vec<&str> = joints.iter().map(|joint| joint.name.as_str()).collect();
        let names = BoneNames::Smpl.translate(&names);
        let parents: Vec<Option<usize>> = joints.iter().map(|joint| joint.parent.map(usize::from)).collect();
        let rest = |j: usize| joints[j].rest.as_dvec3();
        let mut columns = vec![None; joints.len()];
        let (mut points, mut unknowns) = (Vec::new(), 3);
        for side in ["left", "right"] {
            let find = |part: &str| {
                let name = format!("{side}_{part}");
                let found = names.iter().position(|at| at.as_deref() == Some(&name));
                found.ok_or_else(|| FitError(format!("no joint by name for {}", name.replace('_', " "))))
            };
            let [hip, knee, ankle, toe] = [find("hip")?, find("knee")?, find("ankle")?, find("foot")?];
            for (upper, lower) in [(hip, knee), (knee, ankle), (ankle, toe)] {
                let length = rest(upper).distance(rest(lower));
                // Also for NaN.
                if !(1e-3..=1e3).contains(&length) || parents[lower] != Some(upper) {
                    let [upper, lower] = [upper, lower].map(|j| &joints[j].name);
                    return Err(FitError(format!("expected a bone from {upper} to {lower}, {length} m long")));
                }
            }
            for joint in [hip, knee, ankle] {
                columns[joint] = Some(unknowns);
                unknowns += 3;
            }
            let on = |bone: usize, at: DVec3| vec![Part { bone, share: 1.0, arm: at - rest(bone) }];
            let low = |at: DVec3| at.with_y(sole.into());
            points.extend([on(hip, rest(knee)), on(knee, rest(ankle))]);
            points.extend([on(ankle, low(rest(ankle))), on(ankle, low(rest(toe)))]);
        }
        let offsets = (0..joints.len()).map(|j| rest(j) - parents[j].map_or(DVec3::ZERO, rest)).collect();
        Ok(Self(Skeleton {
            ranges: Vec::new(),
            mean: Shape { offsets, points },
            directions: Vec::new(),
            columns,
            unknowns,
            opposite: Vec::new(),
            parents,
        }))
    }

    fn points(&self, state: &State) -> Vec<DVec3> {
        self.0.points(&self.0.mean, &self.0.frames(&self.0.mean, state))
    }
}

/// Gauss–Newton over all frames.
fn relax(legs: &Legs, before: &[Vec<DVec3>], held: &[Vec<Option<DVec3>>], states: &mut Vec<State>, fps: f64) {
    let n = legs.0.unknowns;
    let start = states.clone();
    let precision = |place: f64, turn: f64| DVector::from_fn(n, |i, _| if i < 3 { place } else { turn }.powi(-2));
    let (still, smooth) = (precision(ROOT, TURN), precision(ACCELERATIONS[0], ACCELERATIONS[1]) * fps.powi(4));
    let square = |v: &DVector<f64>, k: &DVector<f64>| 0.5 * v.component_mul(v).dot(k);
    let rows: [&[f64]; 2] = [&[1.0], &[1.0, -2.0, 1.0]];
    let value = |corrections: &[DVector<f64>], row: &[f64]| {
        row.iter().zip(corrections).fold(DVector::zeros(n), |sum, (a, c)| sum + *a * c)
    };
    // Residual and weights, by component, of a point.
    let residual = |t: usize, i: usize, at: DVec3| {
        let (target, deviation) = held[t][i].map_or((before[t][i], STAYS), |anchor| (anchor, HELD / fps));
        let (mut residual, mut weight) = (at - target, DVec3::splat(deviation.powi(-2)));
        if held[t][i].is_some() {
            weight.y = LEVEL.powi(-2);
        } else if SOLE.contains(&(i % POINTS)) && at.y < 0.0 {
            (residual.y, weight.y) = (at.y, BELOW.powi(-2));
        }
        (residual, weight)
    };
    let cost = |states: &[State]| {
        let corrections: Vec<_> = start.iter().zip(states).map(|(a, b)| between(&legs.0, a, b)).collect();
        let mut sum = 0.0;
        for (t, state) in states.iter().enumerate() {
            for (i, at) in legs.points(state).into_iter().enumerate() {
                let (residual, weight) = residual(t, i, at);
                sum += 0.5 * weight.dot(residual * residual);
            }
        }
        for (row, weight) in rows.into_iter().zip([&still, &smooth]) {
            sum += corrections.windows(row.len()).map(|window| square(&value(window, row), weight)).sum::<f64>();
        }
        sum
    };
    let mut now = cost(states);
    for _ in 0..STEPS {
        let corrections: Vec<_> = start.iter().zip(&*states).map(|(a, b)| between(&legs.0, a, b)).collect();
        let mut beside = Beside::zeros(n, states.len());
        let mut normals: Vec<Normal> = states.iter().map(|_| Normal::zeros(n, 0)).collect();
        for (t, (state, normal)) in states.iter().zip(&mut normals).enumerate() {
            let (points, by_pose, _) = jacobian(&legs.0, &legs.0.mean, state, 0);
            for (i, (at, blocks)) in points.into_iter().zip(by_pose).enumerate() {
                let (residual, weight) = residual(t, i, at);
                for (a, block) in &blocks {
                    let weighted = block.transpose() * DMat3::from_diagonal(weight);
                    add(&mut normal.gradient, *a, weighted * residual);
                    blocks.iter().for_each(|(b, other)| add_block(&mut normal.hessian, *a, *b, weighted * *other));
                }
            }
        }
        // The derivative of a correction is taken as 1: corrections are small.
        for (row, weight) in rows.into_iter().zip([&still, &smooth]) {
            for (f, window) in corrections.windows(row.len()).enumerate() {
                couple(&mut normals[f..], &mut beside, f, row, &value(window, row), weight);
            }
        }
        let column = |normal: &Normal| DMatrix::from_column_slice(n, 1, normal.gradient.as_slice());
        let mut sides: Vec<DMatrix<f64>> = normals.iter().map(column).collect();
        let diagonal = normals.into_iter().map(|normal| normal.hessian).collect();
        // Not definite only where coordinates or rates are beyond what f64 resolves.
        let Some(band) = Band::factor(diagonal, Some(beside)) else { return };
        band.solve(&mut sides);
        let better = (0..6).find_map(|halving| {
            let part = -(0.5f64.powi(halving));
            let step = |(state, side): (&State, &DMatrix<f64>)| stepped(&legs.0, state, &(part * side.column(0)));
            let next: Vec<State> = states.iter().zip(&sides).map(step).collect();
            let after = cost(&next);
            (after < now).then_some((next, after))
        });
        let Some((next, after)) = better else { return };
        let ends = after > (1.0 - GAIN) * now;
        (*states, now) = (next, after);
        if ends {
            return;
        }
    }
}

/// Places at which parts of the soles stand, by frame and point.
fn anchors(places: &[Vec<DVec3>], fps: f64) -> Vec<Vec<Option<DVec3>>> {
    let mut held: Vec<Vec<Option<DVec3>>> = vec![vec![None; 2 * POINTS]; places.len()];
    for side in [0, POINTS] {
        let mut contacts: Vec<(usize, Range<usize>)> = Vec::new();
        for part in SOLE {
            let track: Vec<DVec3> = places.iter().map(|points| points[side + part]).collect();
            contacts.extend(contacts_of(&track, fps).into_iter().map(|run| (part, run)));
        }
        contacts.sort_by_key(|(part, run)| (run.start, *part));
        for (part, run) in contacts {
            let mean = places[run.clone()].iter().map(|points| points[side + part]).sum::<DVec3>() / run.len() as f64;
            let mut at = mean.with_y((mean.y - LANDS).max(0.0));
            // As far from the other part, where that stands, as the foot is long.
            let other = side + SOLE[0] + SOLE[1] - part;
            if let Some(other_at) = run.clone().find_map(|t| held[t][other]) {
                let length = places[run.start][side + part].distance(places[run.start][other]);
                at = other_at + length * (at - other_at).normalize_or(DVec3::Z);
            }
            held[run].iter_mut().for_each(|points| points[side + part] = Some(at));
        }
    }
    held
}

/// Runs of frames in which a part of a sole is slow and low, without drift.
fn contacts_of(track: &[DVec3], fps: f64) -> Vec<Range<usize>> {
    let smooth = smoothed(track, (SMOOTH * fps).min(WINDOW));
    let last = track.len().saturating_sub(1);
    let slow = |t: usize| {
        let (a, b) = (t.saturating_sub(1), (t + 1).min(last));
        let speed = (smooth[b] - smooth[a]).with_y(0.0).length() * fps / (b - a).max(1) as f64;
        speed < SPEED && smooth[t].y < HEIGHT
    };
    let slow: Vec<bool> = (0..track.len()).map(slow).collect();
    let mut todo = runs(&slow);
    let mut out = Vec::new();
    while let Some(run) = todo.pop() {
        let core = steady(track, run.clone());
        if core.len() as f64 >= SHORTEST * fps {
            // Parts of the run, with time to move the foot between.
            let gap = (FADE * fps).ceil() as usize;
            let parts = [run.start..core.start.saturating_sub(gap), core.end + gap..run.end];
            todo.extend(parts.into_iter().filter(|part| !part.is_empty()));
            out.push(core);
        }
    }
    out
}

/// The part of a run of frames in which places keep near their mean: the farther end goes first.
fn steady(track: &[DVec3], mut run: Range<usize>) -> Range<usize> {
    let mut sum: DVec3 = track[run.clone()].iter().sum();
    while !run.is_empty() {
        let mean = sum / run.len() as f64;
        let [first, last] = [track[run.start], track[run.end - 1]];
        let (from_first, from_last) = (first.distance(mean), last.distance(mean));
        if from_first.max(from_last) <= DRIFT {
            break;
        }
        if from_first > from_last {
            (sum, run.start) = (sum - first, run.start + 1);
        } else {
            (sum, run.end) = (sum - last, run.end - 1);
        }
    }
    run
}

/// Unit normal and distance from the origin of the plane through the lowest places of all frames,
/// robust, and no steeper than their spread tells.
fn floor(places: &[Vec<DVec3>]) -> (DVec3, f64) {
    let soles = |points: &Vec<DVec3>| [0, POINTS].map(|side| SOLE.map(|part| points[side + part]));
    let lower = |a: DVec3, b: DVec3| if b.y < a.y { b } else { a };
    let lowest = |points: &Vec<DVec3>| soles(points).into_iter().flatten().reduce(lower);
    let lowest: Vec<DVec3> = places.iter().filter_map(lowest).collect();
    let mut heights: Vec<f64> = lowest.iter().map(|at| at.y).collect();
    heights.sort_by(f64::total_cmp);
    let median = heights.get(heights.len() / 2).copied().unwrap_or(0.0);
    let centre = (lowest.iter().sum::<DVec3>() / lowest.len().max(1) as f64).with_y(median);
    let mut plane = DVec3::ZERO;
    for _ in 0..30 {
        let (mut matrix, mut right, mut total) = (DMat3::ZERO, DVec3::ZERO, 0.0);
        for at in &lowest {
            let at = *at - centre;
            let row = at.with_y(1.0);
            let weight = 1.0 / (1.0 + ((at.y - plane.dot(row)) / FLOOR).powi(2));
            matrix += DMat3::from_cols(row * row.x, row, row * row.z) * weight;
            right += weight * at.y * row;
            total += weight;
        }
        let ridge = total * SPREAD * SPREAD;
        matrix += DMat3::from_diagonal(DVec3::new(ridge, 0.0, ridge));
        plane = Some(matrix.inverse() * right).filter(|plane| plane.is_finite()).unwrap_or(plane);
    }
    let normal = DVec3::new(-plane.x, 1.0, -plane.z).normalize_or(DVec3::Y);
    (normal, normal.dot(centre + plane.y * DVec3::Y))
}

/// Mean horizontal speed of the parts that stand from one frame to the next.
fn sliding(places: &[Vec<DVec3>], held: &[Vec<Option<DVec3>>], fps: f64) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for (at, held) in places.windows(2).zip(held.windows(2)) {
        for i in (0..2 * POINTS).filter(|i| held[0][*i].is_some() && held[0][*i] == held[1][*i]) {
            sum += (at[1][i] - at[0][i]).with_y(0.0).length() * fps;
            count += 1;
        }
    }
    sum / f64::from(count.max(1))
}

/// Runs of frames in which something holds.
fn runs(holds: &[bool]) -> Vec<Range<usize>> {
    let mut start = 0;
    let mut out = Vec::new();
    for run in holds.chunk_by(|a, b| a == b) {
        if run[0] {
            out.push(start..start + run.len());
        }
        start += run.len();
    }
    out
}

/// Gaussian means with a standard deviation of `sigma` frames.
fn smoothed(track: &[DVec3], sigma: f64) -> Vec<DVec3> {
    let half = (3.0 * sigma).ceil() as usize;
    let mean = |t: usize| {
        let (mut sum, mut total) = (DVec3::ZERO, 0.0);
        for i in t.saturating_sub(half)..(t + half + 1).min(track.len()) {
            let weight = (-0.5 * (i.abs_diff(t) as f64 / sigma).powi(2)).exp();
            (sum, total) = (sum + weight * track[i], total + weight);
        }
        sum / total
    };
    (0..track.len()).map(mean).collect()
}
