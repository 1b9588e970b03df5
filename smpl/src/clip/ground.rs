//! Motion on level ground, without sliding feet.

use std::ops::{Add, Mul, Range};

use glam::{DMat3, DVec3, Quat, Vec3, Vec4};

use super::bvh::shorter;
use super::retarget::{LEGS, Roles};
use super::{Joint, MotionClip, joint_transforms};

/// Fastest and highest smoothed place of a part of the sole that stands, in m/s and metres.
const STANDING_SPEED: f32 = 0.4;
const STANDING_HEIGHT: f32 = 0.05;
/// Farthest that a standing part may be from its place; contacts that drift farther are divided.
const DRIFT: f32 = 0.02;
/// Standard deviation of the smoothing of places, and shortest contact, in seconds.
const SMOOTH: f32 = 0.05;
const SHORTEST_CONTACT: f32 = 0.1;
/// Time over which corrections fade in and out, in seconds.
const FADE: f32 = 0.2;
/// Longest window of smoothing, in frames.
const MAX_WINDOW: f32 = 200.0;
/// Scale of the residuals of the floor, and spread that the places on it must exceed to tell its
/// slope, in metres.
const FLOOR_RESIDUAL: f64 = 0.02;
const FLOOR_SPREAD: f64 = 0.2;
/// Longest distance from hip to ankle, in lengths of a leg.
const REACH: f32 = 0.9995;

/// A motion after [`MotionClip::grounded`], and what became of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Grounded {
    /// The motion on the floor, y = 0.
    pub motion: MotionClip,
    /// Mean horizontal speed of the parts of the soles that stand, before and after, in m/s.
    pub sliding: [f32; 2],
    /// Share of the frames in which each foot stands, left and right.
    pub standing: [f32; 2],
    /// Angle by which the world was turned, in radians.
    pub tilt: f32,
    /// Farthest that a joint of a leg whose foot does not stand, or of the rest of the body, is from
    /// where it was on the floor, in metres.
    pub moved: f32,
}

/// A foot's correction in a frame: rotation, and translation of the ankle.
#[derive(Clone, Copy, Default)]
struct Correction {
    turn: Quat,
    by: Vec3,
}

/// Places of ankle, heel and ball of one foot, (T) each, and whether the latter stand.
struct Foot {
    ankles: Vec<Vec3>,
    places: [Vec<Vec3>; 2],
    stands: [Vec<bool>; 2],
}

impl MotionClip {
    /// Sets the motion on level ground, for a skeleton whose soles are at height `sole` at rest.
    ///
    /// The floor is a plane fitted to the lowest places of the feet; the world is turned until it is
    /// level. Heels and balls of the feet stand while they are slow and low; standing parts are held
    /// at their mean place by inverse kinematics of hip and knee, with corrections that fade within
    /// 0.2 s, and hips are lowered where a leg is too short. Feet are displaced by some 2 cm at most, a
    /// knee of a nearly straight leg by several.
    ///
    /// # Errors
    /// What the skeleton lacks by name: hips, legs, feet with toes; their lengths.
    ///
    /// # Panics
    /// If the motion is not of the skeleton's joints.
    pub fn grounded(&self, skeleton: &[Joint], sole: f32) -> Result<Grounded, String> {
        let roles = Roles::new(skeleton)?;
        let mut legs = [[0; 4]; 2];
        for (leg, of) in legs.iter_mut().zip(LEGS) {
            for (joint, role) in leg.iter_mut().zip(of) {
                *joint = roles.joints[role].ok_or("no joint by name for the ankles or toes")?;
            }
            if leg.windows(2).any(|bone| skeleton[bone[0]].rest.distance(skeleton[bone[1]].rest) < 1e-6) {
                return Err("a leg has a bone of zero length".to_owned());
            }
        }
        // Ankle, heel and ball move with the ankle's joint.
        let parts = legs.map(|[.., ankle, toe]| {
            let [ankle, toe] = [ankle, toe].map(|j| skeleton[j].rest);
            [ankle, ankle.with_y(sole), toe.with_y(sole)]
        });
        let places = |motion: &MotionClip| {
            let mut out = [const { [const { Vec::new() }; 3] }; 2];
            for t in 0..motion.num_frames() {
                let bones = motion.bones(skeleton, t);
                for ((out, leg), parts) in out.iter_mut().zip(legs).zip(parts) {
                    (0..3).for_each(|part| out[part].push(bones[leg[2]].transform_point3(parts[part])));
                }
            }
            out
        };
        let (normal, height) = floor(&places(self));
        let level = Quat::from_rotation_arc(normal, Vec3::Y);
        let mut motion = self.clone();
        let root = skeleton[0].rest;
        for (turn, at) in motion.poses.iter_mut().step_by(self.num_joints).zip(&mut motion.trans) {
            *turn = (level * Quat::from_scaled_axis(*turn)).normalize().to_scaled_axis();
            *at = level * (root + *at) - height * Vec3::Y - root;
        }
        let fitted = motion.clone();
        let feet = places(&motion).map(|places| Foot::new(places, self.fps));
        let corrections = feet.each_ref().map(|foot| foot.corrections(self.fps));

        let lengths = legs.map(|leg| [0, 1].map(|i| skeleton[leg[i]].rest.distance(skeleton[leg[i + 1]].rest)));
        let frames = motion.num_frames();
        let mut lowered = vec![0.0f32; frames];
        let mut targets = vec![[Vec3::ZERO; 2]; frames];
        for t in 0..frames {
            let bones = motion.bones(skeleton, t);
            for side in 0..2 {
                let [hip, knee, ankle] =
                    [0, 1, 2].map(|i| bones[legs[side][i]].transform_point3(skeleton[legs[side][i]].rest));
                // Stretching a leg moves the knee much farther than the foot.
                let bent = (knee - hip).reject_from(ankle - hip).length();
                let straighter = if bent.is_finite() { (bent - DRIFT).max(0.0) } else { 0.0 };
                let half = |bone: f32| (bone * bone - straighter * straighter).max(0.0).sqrt();
                let reach = REACH * (half(lengths[side][0]) + half(lengths[side][1]));
                let ankle = ankle + corrections[side][t].by;
                targets[t][side] = ankle;
                let away = (hip - ankle).with_y(0.0).length();
                let highest = ankle.y + (reach * reach - away * away).max(0.0).sqrt();
                lowered[t] = lowered[t].max(hip.y - highest);
            }
        }
        // Maxima of a window, averaged over one as wide, are nowhere below the values.
        let half = (FADE * self.fps).min(MAX_WINDOW).ceil() as usize;
        let window = |t: usize| t.saturating_sub(half)..(t + half + 1).min(frames);
        let maxima: Vec<f32> = (0..frames).map(|t| lowered[window(t)].iter().copied().fold(0.0, f32::max)).collect();
        for t in 0..frames {
            let lower = maxima[window(t)].iter().sum::<f32>() / window(t).len() as f32;
            motion.trans[t].y -= lower;
            for side in 0..2 {
                let turn = corrections[side][t].turn;
                motion.place_foot(skeleton, t, legs[side], lengths[side], targets[t][side], turn);
            }
        }
        let after = places(&motion);
        let mut moved = 0.0f32;
        for t in 0..frames {
            let (old, new) = (fitted.bones(skeleton, t), motion.bones(skeleton, t));
            for (j, joint) in skeleton.iter().enumerate() {
                let stands = (0..2).any(|side| legs[side].contains(&j) && feet[side].stands_at(t));
                if !stands {
                    let [a, b] = [&old, &new].map(|bones| bones[j].transform_point3(joint.rest));
                    moved = moved.max(a.distance(b));
                }
            }
        }
        let before = feet.each_ref().map(|foot| foot.places.each_ref().map(Vec::as_slice));
        let after = after.each_ref().map(|[_, heels, balls]| [heels.as_slice(), balls]);
        let sliding = [before, after].map(|places| sliding(places, &feet, self.fps));
        let share = |foot: &Foot| (0..frames).filter(|&t| foot.stands_at(t)).count() as f32 / frames.max(1) as f32;
        let standing = feet.each_ref().map(share);
        Ok(Grounded { motion, sliding, standing, tilt: normal.angle_between(Vec3::Y), moved })
    }

    fn bones(&self, skeleton: &[Joint], frame: usize) -> Vec<glam::Affine3A> {
        let pose = &self.poses[frame * self.num_joints..][..self.num_joints];
        joint_transforms(skeleton, pose, self.trans[frame])
    }

    /// Brings an ankle to `target`, as far as the leg reaches, by hip and knee, and turns the foot by
    /// `turn`.
    fn place_foot(
        &mut self,
        skeleton: &[Joint],
        frame: usize,
        [hip, knee, ankle, _]: [usize; 4],
        [thigh, shin]: [f32; 2],
        target: Vec3,
        turn: Quat,
    ) {
        let bones = self.bones(skeleton, frame);
        let [at_hip, at_knee, at_ankle] = [hip, knee, ankle].map(|j| bones[j].transform_point3(skeleton[j].rest));
        let rotation = |joint: usize| Quat::from_mat3a(&bones[joint].matrix3).normalize();
        if target.distance(at_ankle) < 1e-6 && turn == Quat::IDENTITY {
            return;
        }
        let (way, ahead) = (target - at_hip, rotation(hip) * Vec3::Z);
        let distance = way.length().clamp((thigh - shin).abs() + 1e-4, REACH * (thigh + shin));
        let along = way.normalize_or(Vec3::NEG_Y);
        let cosine = (thigh * thigh + distance * distance - shin * shin) / (2.0 * thigh * distance);
        let cosine = cosine.clamp(-1.0, 1.0);
        // The knee stays in the plane in which it was; that of a straight leg is the thigh's own.
        let straight = Quat::from_rotation_arc((at_ankle - at_hip).normalize_or(along), along);
        let bent = (straight * (at_knee - at_hip)).reject_from_normalized(along);
        let aside = (bent + 1e-3 * ahead.reject_from_normalized(along)).normalize_or(along.any_orthonormal_vector());
        let knee_to = at_hip + thigh * (cosine * along + (1.0 - cosine * cosine).sqrt() * aside);
        let arc = |from: Vec3, to: Vec3| Quat::from_rotation_arc(from.normalize_or(Vec3::Y), to.normalize_or(Vec3::Y));
        let ankle_to = at_hip + distance * along;
        let globals = [
            arc(at_knee - at_hip, knee_to - at_hip) * rotation(hip),
            arc(at_ankle - at_knee, ankle_to - knee_to) * rotation(knee),
            turn * rotation(ankle),
        ];
        for (i, joint) in [hip, knee, ankle].into_iter().enumerate() {
            let parent = skeleton[joint].parent.map(usize::from);
            let above = if i == 0 { parent.map_or(Quat::IDENTITY, rotation) } else { globals[i - 1] };
            let local = (above.inverse() * globals[i]).normalize();
            self.poses[frame * self.num_joints + joint] = shorter(local).to_scaled_axis();
        }
    }
}

impl Foot {
    fn new([ankles, heels, balls]: [Vec<Vec3>; 3], fps: f32) -> Self {
        let places = [heels, balls];
        let stands = places.each_ref().map(|places| {
            let smooth = smoothed(places, (SMOOTH * fps).min(MAX_WINDOW));
            let last = smooth.len().saturating_sub(1);
            let slow = |t: usize| {
                let (a, b) = (t.saturating_sub(1), (t + 1).min(last));
                let speed = (smooth[b] - smooth[a]).with_y(0.0).length() * fps / (b - a).max(1) as f32;
                speed < STANDING_SPEED && smooth[t].y < STANDING_HEIGHT
            };
            let slow: Vec<bool> = (0..smooth.len()).map(slow).collect();
            let mut stands = vec![false; slow.len()];
            let mut todo = runs(&slow);
            while let Some(run) = todo.pop() {
                let core = steady(places, run.clone());
                if core.len() as f32 >= SHORTEST_CONTACT * fps {
                    stands[core.clone()].fill(true);
                    // Parts of the run, with time to move the foot between.
                    let gap = (FADE * fps).ceil() as usize;
                    let parts = [run.start..core.start.saturating_sub(gap), core.end + gap..run.end];
                    todo.extend(parts.into_iter().filter(|part| !part.is_empty()));
                }
            }
            stands
        });
        Self { ankles, places, stands }
    }

    fn stands_at(&self, t: usize) -> bool {
        self.stands[0][t] || self.stands[1][t]
    }

    /// Corrections that hold the standing parts where they are in the mean.
    fn corrections(&self, fps: f32) -> Vec<Correction> {
        let frames = self.places[0].len();
        let mut held: [Vec<Option<Vec3>>; 2] = [vec![None; frames], vec![None; frames]];
        let mut contacts: Vec<(usize, Range<usize>)> =
            (0..2).flat_map(|part| runs(&self.stands[part]).into_iter().map(move |run| (part, run))).collect();
        contacts.sort_by_key(|(part, run)| (run.start, *part));
        let length = |t: usize| self.places[0][t].distance(self.places[1][t]);
        for (part, run) in contacts {
            let mean = self.places[part][run.clone()].iter().sum::<Vec3>() / run.len() as f32;
            // Half of what is allowed is used to bring it to the floor.
            let mut at = mean.with_y(mean.y - mean.y.clamp(-0.5 * DRIFT, 0.5 * DRIFT));
            // As far from the other part, where that stands, as the foot is long.
            if let Some(other) = held[1 - part][run.start] {
                at = other + length(run.start) * (at - other).normalize_or(Vec3::Z);
            }
            held[part][run].fill(Some(at));
        }
        let turns: Vec<Option<Vec4>> = (0..frames)
            .map(|t| {
                let (heel, ball) = (held[0][t]?, held[1][t]?);
                let sole = self.places[1][t] - self.places[0][t];
                Some(Quat::from_rotation_arc(sole.try_normalize()?, (ball - heel).try_normalize()?).into())
            })
            .collect();
        let fade = FADE * fps;
        let faded_turn = |(sum, weight): (Vec4, f32)| Quat::from_vec4(sum + (1.0 - weight) * Vec4::W).normalize();
        let turns: Vec<Quat> = faded(&turns, fade).into_iter().map(faded_turn).collect();
        let by: Vec<Option<Vec3>> = (0..frames)
            .map(|t| {
                let ankle = self.ankles[t];
                let part = |part: usize| held[part][t].map(|at| at - ankle - turns[t] * (self.places[part][t] - ankle));
                match (part(0), part(1)) {
                    (Some(a), Some(b)) => Some(a.midpoint(b)),
                    (a, b) => a.or(b),
                }
            })
            .collect();
        turns.into_iter().zip(faded(&by, fade)).map(|(turn, (by, _))| Correction { turn, by }).collect()
    }
}

/// The part of a run of frames in which places keep near their mean: the farther end goes first.
fn steady(places: &[Vec3], mut run: Range<usize>) -> Range<usize> {
    let mut sum: Vec3 = places[run.clone()].iter().sum();
    while !run.is_empty() {
        let mean = sum / run.len() as f32;
        let [first, last] = [places[run.start], places[run.end - 1]];
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

/// Known values, and between them those before and after, whose weights, 1 at their own frames, go
/// to 0 within `fade` frames: sums and weights.
fn faded<T: Copy + Default + Add<Output = T> + Mul<f32, Output = T>>(known: &[Option<T>], fade: f32) -> Vec<(T, f32)> {
    let weights = |order: &mut dyn Iterator<Item = usize>| {
        let (mut last, mut out) = (None, vec![(T::default(), 0.0f32); known.len()]);
        for t in order {
            last = known[t].map(|value| (value, t)).or(last);
            if let Some((value, from)) = last {
                let x = (1.0 - from.abs_diff(t) as f32 / fade).max(0.0);
                out[t] = (value, x * x * (3.0 - 2.0 * x));
            }
        }
        out
    };
    let (before, after) = (weights(&mut (0..known.len())), weights(&mut (0..known.len()).rev()));
    let both = before.into_iter().zip(after).map(|((a, u), (b, v))| {
        let share = 1.0 / (u + v).max(1.0);
        (a * (u * share) + b * (v * share), (u + v) * share)
    });
    both.collect()
}

/// Unit normal and distance from the origin of the plane through the lowest places of all frames,
/// robust, and no steeper than their spread tells.
fn floor(feet: &[[Vec<Vec3>; 3]; 2]) -> (Vec3, f32) {
    let all: Vec<&Vec<Vec3>> = feet.iter().flat_map(|[_, soles @ ..]| soles).collect();
    let lowest = |t: usize| all.iter().map(|places| places[t]).min_by(|a, b| a.y.total_cmp(&b.y)).unwrap_or_default();
    let lowest: Vec<Vec3> = (0..all[0].len()).map(lowest).collect();
    let mut heights: Vec<f32> = lowest.iter().map(|at| at.y).collect();
    heights.sort_by(f32::total_cmp);
    let median = heights.get(heights.len() / 2).copied().unwrap_or(0.0);
    let centre = (lowest.iter().sum::<Vec3>() / lowest.len().max(1) as f32).with_y(median);
    let mut plane = DVec3::ZERO;
    for _ in 0..30 {
        let (mut matrix, mut right, mut total) = (DMat3::ZERO, DVec3::ZERO, 0.0);
        for at in &lowest {
            let at = (*at - centre).as_dvec3();
            let row = at.with_y(1.0);
            let residual = (at.y - plane.dot(row)) / FLOOR_RESIDUAL;
            let weight = 1.0 / (1.0 + residual * residual);
            matrix += DMat3::from_cols(row * row.x, row, row * row.z) * weight;
            right += weight * at.y * row;
            total += weight;
        }
        let ridge = total * FLOOR_SPREAD * FLOOR_SPREAD;
        matrix += DMat3::from_diagonal(DVec3::new(ridge, 0.0, ridge));
        plane = Some(matrix.inverse() * right).filter(|plane| plane.is_finite()).unwrap_or(plane);
    }
    let plane = plane.as_vec3();
    let normal = Vec3::new(-plane.x, 1.0, -plane.z).normalize_or(Vec3::Y);
    (normal, normal.dot(centre + plane.y * Vec3::Y))
}

/// Mean horizontal speed of the parts that stand from one frame to the next.
fn sliding(places: [[&[Vec3]; 2]; 2], feet: &[Foot; 2], fps: f32) -> f32 {
    let (mut sum, mut count) = (0.0f64, 0);
    for (places, foot) in places.into_iter().zip(feet) {
        for (places, stands) in places.into_iter().zip(&foot.stands) {
            for (at, stands) in places.windows(2).zip(stands.windows(2)) {
                if stands[0] && stands[1] {
                    sum += f64::from((at[1] - at[0]).with_y(0.0).length() * fps);
                    count += 1;
                }
            }
        }
    }
    (sum / f64::from(count.max(1))) as f32
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
fn smoothed(places: &[Vec3], sigma: f32) -> Vec<Vec3> {
    let half = (3.0 * sigma).ceil() as usize;
    let mean = |t: usize| {
        let (mut sum, mut total) = (Vec3::ZERO, 0.0);
        for i in t.saturating_sub(half)..(t + half + 1).min(places.len()) {
            let weight = (-0.5 * (i.abs_diff(t) as f32 / sigma).powi(2)).exp();
            (sum, total) = (sum + weight * places[i], total + weight);
        }
        sum / total
    };
    (0..places.len()).map(mean).collect()
}
