//! Registration: the prior's poses, place and shape, corrected by what all frames together show,
//! before anything is learnt.
//!
//! Along the outline of the posed prior the mask's is searched (Kass, Witkin and Terzopoulos 1988),
//! where nothing stands in front. Clothes are taken to be as thick in all frames: how far they
//! stand off a vertex is the mean over the frames that show it on an outline. Once outlines agree,
//! so do colours: each vertex has one, under a light that all frames share (Lucas and Kanade 1981).
//! How bright a surface is tells how it is turned, also out of the picture's plane (Horn 1970).
//! Poses, place and shape take Gauss-Newton steps on all frames at once, in which errors of a
//! tracker are expected to change slowly: what a frame hides follows the frames around it. How
//! large they are is learnt on the way ([`Tracker`]), as is what limbs do together ([`habits`]).

mod colors;
mod equations;
mod habits;
mod picture;
mod sight;
mod system;
#[cfg(test)]
mod tests;
mod tracker;
mod unknowns;

use glam::{Quat, Vec3};
use nalgebra::DVector;
use rayon::prelude::*;
use smpl::{BodyModel, Placement, Posed, Shaped};
use surface_query::vertex_normals;
use volrender::{Aabb, Camera};

use self::colors::Colors;
use self::equations::{BETA_STEP, Equations, Perspective};
use self::picture::Picture;
use self::sight::{Looking, Ridge, Sight, look, ridges};
use self::system::{Expected, Normal, Solution, solve};
use self::tracker::Tracker;
use self::unknowns::{Change, changed};
use crate::Error;
use crate::capture::{Capture, Frame};
use crate::scene::seen::dressed;

/// Standard deviation of shape coefficients.
const SHAPE: f64 = 0.5;
/// Part of the rounds that look at outlines alone.
const OUTLINES: f32 = 1.0 / 3.0;
/// Standard deviation of the inverse depth of the whole, where the focal length is somebody's guess,
/// per metre of a body 1.7 high, and the least depth.
const NEARNESS: f32 = 0.3;
const NEAREST: f32 = 0.8;
/// Shape coefficients that are corrected: what follows hardly changes the body.
const BETAS: usize = 10;
/// How far from the prior's outline the mask's is searched in the first and in the last round,
/// pixels.
const REACH: [f32; 2] = [12.0, 5.0];
/// Blur of the colours in the first round that looks at them, halfway, and in the last, pixels.
const BLUR: [f32; 2] = [3.0, 0.5];
/// Frames that a vertex has to be on an outline in before half of what they say of its clothes is
/// believed, and the farthest that clothes stand off, metres.
const DOUBT: f32 = 1.0;
const CLOTHES: f32 = 0.05;
/// Rounds in which what is known of clothes spreads along the surface.
const SPREAD: usize = 10;
/// Most frames that are corrected on their own, and most numbers in their equations: those between
/// are interpolated.
const MOST_FRAMES: usize = 400;
const MOST_NUMBERS: usize = 4_000_000;
/// Most joints of a body: time grows with their cube.
const MOST_JOINTS: usize = 512;

/// A body in one of the frames.
struct Moment {
    shape: Shaped,
    posed: Posed,
    /// The posed vertices with their clothes.
    dressed: Vec<Vec3>,
}

/// What is corrected, and what it is corrected by.
struct Registration<'a> {
    capture: &'a Capture,
    model: &'a BodyModel,
    ridges: Vec<Ridge>,
    /// Length of a metre of a body 1.7 high, in the units of the capture.
    unit: f32,
    /// Indices of the frames that are corrected on their own.
    frames: Vec<usize>,
    pictures: Vec<Option<Picture>>,
    changes: Vec<Change>,
    tracker: Tracker,
    betas: Vec<f32>,
    /// The way from the plane of the camera to the root in each frame as it is given; none where
    /// the focal length is known.
    away: Option<Vec<Vec3>>,
    /// Part of the given inverse depths, and of focal lengths, by which both are divided.
    nearness: f32,
    /// How far clothes stand off each vertex, in the units of the capture.
    clothes: Vec<f32>,
}

/// Corrects the poses, the places and the shape that `capture` gives for its frames, and with them
/// those of the views kept back, and without such views the focal length, in `rounds` Gauss-Newton
/// steps. The result does not depend on the number of threads.
///
/// # Errors
/// [`Error::Scene`] for a body of more than 512 joints; pictures that cannot be read.
pub fn register(capture: &mut Capture, model: &BodyModel, rounds: usize) -> Result<(), Error> {
    let joints = model.num_joints();
    if joints > MOST_JOINTS {
        let other = "`registration.rounds` of 0 leaves the prior as it is";
        return Err(Error::Scene(format!("registration: {joints} joints, at most {MOST_JOINTS}; {other}")));
    }
    let mut registration = Registration::new(capture, model)?;
    let outlines = (OUTLINES * rounds as f32) as usize;
    for round in 0..rounds {
        if round == outlines {
            registration.tracker.turn = Tracker::TURN;
        }
        let late = round as f32 / (rounds - 1).max(1) as f32;
        let between = |ends: [f32; 2], share: f32| ends[0] + share * (ends[1] - ends[0]);
        let blur = if round < outlines { 0.0 } else { between(BLUR, (2.0 * late - 1.0).max(0.0)) };
        let looking = Looking { reach: between(REACH, late), blur, unit: registration.unit };
        if !registration.improve(looking)? {
            break;
        }
    }
    let Registration { frames, changes, betas, nearness, clothes, .. } = registration;
    capture.clothes = clothes;
    capture.mean_betas = sum(&capture.mean_betas, &betas);
    for (index, frame) in capture.train.iter_mut().enumerate() {
        let after = frames.partition_point(|&f| f <= index);
        let (a, b) = (after - 1, after.min(frames.len() - 1));
        let share = if a == b { 0.0 } else { (index - frames[a]) as f32 / (frames[b] - frames[a]) as f32 };
        let change: Change = changes[a].iter().zip(&changes[b]).map(|(a, b)| a.lerp(*b, share)).collect();
        let away = if nearness == 1.0 { None } else { away(frame, model) };
        frame.betas = sum(&frame.betas, &betas);
        (frame.pose, frame.placement) = changed(frame, model, &model.shaped(&frame.betas), &change);
        frame.placement = shifted(frame.placement, away.unwrap_or_default(), nearness);
        frame.camera.focal /= nearness;
    }
    for view in &mut capture.eval {
        if let Some(Frame { pose, placement, betas, .. }) = capture.train.get(view.train_index) {
            (view.frame.pose, view.frame.placement) = (pose.clone(), *placement);
            view.frame.betas.clone_from(betas);
        }
    }
    capture.registered = true;
    Ok(())
}

impl<'a> Registration<'a> {
    fn new(capture: &'a Capture, model: &'a BodyModel) -> Result<Self, Error> {
        let own = 3 * (model.num_joints() + 1);
        let most = (MOST_NUMBERS / (own * own)).clamp(2, MOST_FRAMES);
        let frames: Vec<usize> = (0..capture.train.len()).step_by(capture.train.len().div_ceil(most).max(1)).collect();
        let picture = |&frame: &usize| {
            let frame = &capture.train[frame];
            let posed = model.pose(&model.shaped(&frame.betas), &frame.pose, frame.placement);
            Ok(Picture::new(frame, &posed)?)
        };
        let pictures = frames.par_iter().map(picture).collect::<Result<_, Error>>()?;
        let bounds = Aabb::from_points(&model.shaped(&capture.mean_betas).vertices);
        let unit = (bounds.max.y - bounds.min.y) / 1.7;
        // A rig that has other cameras is calibrated.
        let away = |&f: &usize| away(&capture.train[f], model).filter(|away| away.length() > NEAREST * unit);
        let away = if capture.eval.is_empty() { frames.iter().map(away).collect() } else { None };
        Ok(Self {
            ridges: ridges(&model.faces),
            unit,
            changes: vec![vec![Vec3::ZERO; model.num_joints() + 1]; frames.len()],
            tracker: Tracker::OUTLINES,
            betas: vec![0.0; model.num_betas().min(BETAS)],
            away,
            nearness: 1.0,
            clothes: vec![0.0; model.num_vertices()],
            capture,
            model,
            frames,
            pictures,
        })
    }

    /// Takes one step; false where the equations have no solution.
    fn improve(&mut self, looking: Looking) -> Result<bool, Error> {
        let this = &*self;
        let moments: Vec<Moment> = (0..this.frames.len()).into_par_iter().map(|f| this.moment(f)).collect();
        let look = |(picture, moment): (&Option<Picture>, &Moment)| match picture {
            Some(picture) => look(picture, &moment.dressed, (&this.model.faces, &this.ridges), looking),
            None => Ok(Sight::default()),
        };
        let sights: Result<Vec<Sight>, Error> = this.pictures.par_iter().zip(&moments).map(look).collect();
        let sights = sights?;
        let clothes = this.measure_clothes(&sights);
        let thicker: Vec<f32> = clothes.iter().zip(&this.clothes).map(|(after, before)| after - before).collect();
        let colors = Colors::measure(&sights, this.model.num_vertices());
        let mut normals: Vec<Normal> = (0..this.frames.len())
            .into_par_iter()
            .map(|f| {
                let Moment { shape, posed, .. } = &moments[f];
                let camera = &this.capture.train[this.frames[f]].camera;
                let perspective = this.perspective(f);
                let mut equations = Equations::new(this.model, (shape, posed), this.reshaped(f), camera, perspective);
                equations.align_outline(&sights[f], &thicker, this.unit);
                equations.align_colors(&sights[f], &colors, looking.blur);
                equations.normal
            })
            .collect();
        let poses: Vec<&Posed> = moments.iter().map(|moment| &moment.posed).collect();
        habits::keep(this.model, &poses, &mut normals);
        let own = 3 * (this.model.num_joints() + 1);
        let gap = this.frames.get(1).map_or(1, |second| second - this.frames[0]);
        let (expected, kept) = this.tracker.expected(this.unit, own, gap);
        let mut common = vec![(SHAPE * SHAPE).recip(); this.betas.len()];
        let flat = |change: &Change| DVector::from_iterator(own, change.iter().flat_map(|v| v.as_dvec3().to_array()));
        let now: Vec<DVector<f64>> = this.changes.iter().map(flat).collect();
        let mut shared: Vec<f64> = this.betas.iter().map(|&b| f64::from(b)).collect();
        if let Some(away) = &this.away {
            let mean = away.iter().map(|away| away.length()).sum::<f32>() / (away.len() as f32 * this.unit);
            common.push(f64::from(NEARNESS * mean).powi(-2));
            shared.push(f64::from(this.nearness) - 1.0);
        }
        let shared = DVector::from_vec(shared);
        let expected = Expected { own: &expected, kept: &kept, shared: &common };
        let Some(solution) = solve(&normals, &expected, &now, &shared) else { return Ok(false) };
        let Solution { own: steps, shared: step, variances } = solution;
        if !steps.iter().chain([&step]).all(|s| s.iter().all(|v| v.is_finite())) {
            return Ok(false);
        }
        self.clothes = clothes;
        for (change, step) in self.changes.iter_mut().zip(&steps) {
            let each = step.as_slice().chunks_exact(3);
            change.iter_mut().zip(each).for_each(|(c, s)| *c += glam::DVec3::from_slice(s).as_vec3());
        }
        let learnt = self.tracker.learnt(&self.changes, &variances, self.unit);
        self.tracker = if looking.blur > 0.0 { learnt } else { Tracker { turn: self.tracker.turn, ..learnt } };
        self.betas.iter_mut().zip(step.iter()).for_each(|(beta, step)| *beta += *step as f32);
        if let (Some(away), Some(step)) = (&self.away, step.get(self.betas.len())) {
            let nearest = away.iter().map(|away| away.length()).fold(f32::INFINITY, f32::min);
            let (before, most) = (self.nearness, nearest / (NEAREST * self.unit));
            self.nearness = (before + *step as f32).clamp(0.5 * before, (2.0 * before).min(most));
            for picture in self.pictures.iter_mut().flatten() {
                picture.camera.focal *= before / self.nearness;
            }
        }
        Ok(true)
    }

    /// The body of a frame, in a shape that is `betas` off the given one, as it is posed by now.
    fn posed(&self, f: usize, betas: &[f32]) -> (Shaped, Posed) {
        let frame = &self.capture.train[self.frames[f]];
        let shape = self.model.shaped(&sum(&frame.betas, betas));
        let (pose, placement) = changed(frame, self.model, &shape, &self.changes[f]);
        let away = self.away.as_ref().map_or(Vec3::ZERO, |away| away[f]);
        let posed = self.model.pose(&shape, &pose, shifted(placement, away, self.nearness));
        (shape, posed)
    }

    /// What is not known of a frame's perspective, and the camera as it is by now.
    fn perspective(&self, f: usize) -> Option<(Perspective, Camera)> {
        let away = self.away.as_ref()?;
        // Every frame has the unknown, also one that the body is not in.
        let camera = self.pictures[f].as_ref().map_or(self.capture.train[self.frames[f]].camera, |p| p.camera);
        Some((Perspective { nearness: self.nearness, depth: away[f].length() }, camera))
    }

    fn moment(&self, f: usize) -> Moment {
        let (shape, posed) = self.posed(f, &self.betas);
        let normals = vertex_normals(&posed.vertices, &self.model.faces);
        let dressed = dressed(&posed.vertices, &normals, &self.clothes);
        Moment { shape, posed, dressed }
    }

    /// The body of a frame with a little more of each shape coefficient.
    fn reshaped(&self, f: usize) -> Vec<Posed> {
        let more = |k: usize| {
            let mut betas = self.betas.clone();
            betas[k] += BETA_STEP;
            self.posed(f, &betas).1
        };
        (0..self.betas.len()).map(more).collect()
    }

    /// How far clothes stand off each vertex: the mean over frames and over the vertices around,
    /// towards 0 where few saw it.
    fn measure_clothes(&self, sights: &[Sight]) -> Vec<f32> {
        let most = CLOTHES * self.unit;
        let mut sums = vec![(0.0f32, 0.0f32); self.clothes.len()];
        for edge in sights.iter().flat_map(|sight| &sight.edges) {
            let v = edge.vertex as usize;
            sums[v].0 += (self.clothes[v] + edge.distance / edge.scale).clamp(-most, most);
            sums[v].1 += 1.0;
        }
        for _ in 0..SPREAD {
            let mut next = sums.clone();
            for corners in &self.model.faces {
                for i in 0..3 {
                    let (to, from) = (corners[i] as usize, sums[corners[(i + 1) % 3] as usize]);
                    next[to].0 += 0.15 * from.0;
                    next[to].1 += 0.15 * from.1;
                }
            }
            // About as much as a vertex with six neighbours gets.
            sums = next.into_iter().map(|(sum, weight)| (sum / 1.9, weight / 1.9)).collect();
        }
        sums.into_iter().map(|(sum, weight)| sum / (weight + DOUBT)).collect()
    }
}

/// The way from the plane of the camera to the root of the body in a frame as it is given; `None`
/// where that lies behind.
fn away(frame: &Frame, model: &BodyModel) -> Option<Vec3> {
    let root = model.shaped(&frame.betas).joints.first().copied()?;
    let root = match frame.placement {
        Placement::Pelvis { translation } => root + translation,
        Placement::Origin { rotation, translation } => Quat::from_scaled_axis(rotation) * root + translation,
    };
    let to_camera = frame.camera.world_to_camera;
    let depth = to_camera.transform_point3(root).z;
    (depth > 0.0).then(|| to_camera.matrix3.transpose() * Vec3::new(0.0, 0.0, depth))
}

/// A placement whose inverse depth is `nearness` times as large.
fn shifted(placement: Placement, away: Vec3, nearness: f32) -> Placement {
    let by = (nearness.recip() - 1.0) * away;
    match placement {
        Placement::Pelvis { translation } => Placement::Pelvis { translation: translation + by },
        Placement::Origin { rotation, translation } => Placement::Origin { rotation, translation: translation + by },
    }
}

/// Shape coefficients, those that are not given taken for 0.
fn sum(a: &[f32], b: &[f32]) -> Vec<f32> {
    let at = |v: &[f32], i: usize| v.get(i).copied().unwrap_or(0.0);
    (0..a.len().max(b.len())).map(|i| at(a, i) + at(b, i)).collect()
}
