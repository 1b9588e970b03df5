//! Registration: corrects poses, placement and shape of the prior on all frames before training.
//!
//! Outline residuals are distances from the outline of the posed prior to the mask's along the
//! image normal (Kass, Witkin and Terzopoulos 1988), where no occluder is in front. Clothes are an
//! offset a vertex, constant over the frames: its mean over the frames with that vertex on the
//! outline. Colour residuals follow (Lucas and Kanade 1981): one albedo a vertex under one light,
//! whose shading tells rotations out of the image plane (Horn 1970). Gauss-Newton steps solve for
//! all frames at once, under a stationary autoregressive model of the pose errors
//! ([`PoseErrorModel`]) and a Gaussian pose prior ([`pose_prior`]), both estimated from the video;
//! so occluded frames follow their neighbours.

mod colors;
mod corrections;
mod equations;
mod hands;
mod observations;
mod pose_prior;
mod system;
#[cfg(test)]
mod tests;

use std::cell::OnceCell;

use glam::{Quat, Vec3};
use nalgebra::DVector;
use rayon::prelude::*;
use smpl::{BodyModel, Placement, Posed, Shaped};
use volrender::{Aabb, Camera};

use self::colors::Colors;
pub(crate) use self::colors::{deviation, robust};
use self::corrections::{Correction, corrected};
use self::equations::{BETA_STEP, DetectorModel, Equations, FramePoints, Perspective};
use self::observations::SharedEdge;
pub(crate) use self::observations::{Crop, Edge, ObservationOptions, Observations, observe, shared_edges};
use self::pose_prior::PoseErrorModel;
use self::system::{NormalEquations, Prior, Solution, solve};
use crate::Error;
use crate::capture::{Capture, Frame, Keypoint, Mended, Registered};
use crate::model::subdivide::normals;
use crate::scene::seen::dressed;

/// Standard deviation of shape coefficients.
const SHAPE: f64 = 0.5;
/// Share of the rounds with outline residuals alone.
const OUTLINES: f32 = 1.0 / 3.0;
/// Standard deviation of the root's inverse depth under a guessed focal length, per metre of a body
/// 1.7 high, and the least depth.
const INVERSE_DEPTH: f32 = 0.3;
const LEAST_DEPTH: f32 = 0.8;
/// Number of corrected shape coefficients; later ones change the body little.
const BETAS: usize = 10;
/// Search distance from the prior's outline to the mask's in the first and in the last round,
/// pixels.
const REACH: [f32; 2] = [12.0, 5.0];
/// Least rounds of outlines before hands are told to be fists: fingers of a body that is not
/// registered lie outside masks too.
const FIST_ROUNDS: usize = 4;
/// [`DetectorModel::width`] in the first round; 1 in the last.
const WIDTH: f32 = 6.0;
/// Blur of the colours in their first round, halfway, and in the last, pixels.
const BLUR: [f32; 2] = [3.0, 0.5];
/// Shrinkage of clothes, in frames with the vertex on an outline, and largest offset, metres.
const DOUBT: f32 = 1.0;
const CLOTHES: f32 = 0.05;
/// Smoothing passes of the clothes over the surface.
const SPREAD: usize = 10;
/// Most frames with their own unknowns, and most entries of their normal equations; corrections of
/// other frames are interpolated.
const MOST_FRAMES: usize = 400;
const MOST_NUMBERS: usize = 4_000_000;
/// Most joints of a body: time grows with their cube.
const MOST_JOINTS: usize = 512;

/// A body in one of the frames.
struct ClothedBody {
    shape: Shaped,
    posed: Posed,
    /// Posed vertices with their clothes.
    dressed: Vec<Vec3>,
}

/// State of the optimisation.
struct Registration<'a> {
    capture: &'a Capture,
    model: &'a BodyModel,
    shared_edges: Vec<SharedEdge>,
    /// Length of a metre of a body 1.7 high, in the units of the capture.
    unit: f32,
    /// Indices of the frames with their own unknowns.
    frames: Vec<usize>,
    crops: Vec<Option<Crop>>,
    /// Key points of each frame, in pixels of its crop.
    keypoints: Vec<Vec<Keypoint>>,
    corrections: Vec<Correction>,
    pose_error: PoseErrorModel,
    betas: Vec<f32>,
    /// Vector from the camera plane to the given root of each frame; `None` for a known focal
    /// length.
    root_depths: Option<Vec<Vec3>>,
    /// Inverse depth and focal length are the given ones divided by this.
    inverse_depth: f32,
    /// Offset of the clothes at each vertex, in the units of the capture.
    clothes: Vec<f32>,
}

/// Corrects poses, placement and shape of the training frames and of the evaluation views in
/// `rounds` Gauss-Newton steps, and, for a capture without such views, the focal length. The result
/// does not depend on the number of threads.
///
/// # Errors
/// [`Error::Scene`] for a body of more than 512 joints; pictures that cannot be read.
pub fn register(mended: Mended, model: &BodyModel, rounds: usize) -> Result<Registered, Error> {
    let Mended { mut capture, mending } = mended;
    let joints = model.num_joints();
    if joints > MOST_JOINTS {
        let other = "`registration.rounds` of 0 leaves the prior as it is";
        return Err(Error::Scene(format!("registration: {joints} joints, at most {MOST_JOINTS}; {other}")));
    }
    let (mut fists, clenched) = ([0.0; 2], OnceCell::new());
    let mut registration = Registration::new(&capture, model)?;
    let outlines = (OUTLINES * rounds as f32) as usize;
    for round in 0..rounds {
        if round == outlines {
            registration.pose_error.rotation = PoseErrorModel::ROTATION;
            if outlines >= FIST_ROUNDS {
                // Wrists as given: those of flat fingers have turned them into the mask of a fist.
                let posed = |body: &BodyModel, f: usize| {
                    let mut correction = registration.corrections[f].clone();
                    body.wrists().into_iter().flatten().for_each(|wrist| correction[1 + wrist] = Vec3::ZERO);
                    registration.posed_as(body, f, &registration.betas, &correction).1.vertices
                };
                fists = hands::curls(model, &registration.crops, posed);
                registration.model = clenched.get_or_init(|| model.with_fists(fists));
            }
        }
        let late = round as f32 / (rounds - 1).max(1) as f32;
        let between = |ends: [f32; 2], share: f32| ends[0] + share * (ends[1] - ends[0]);
        let blur = if round < outlines { 0.0 } else { between(BLUR, (2.0 * late - 1.0).max(0.0)) };
        let options = ObservationOptions { reach: between(REACH, late), blur, unit: registration.unit };
        if !registration.step(options)? {
            break;
        }
    }
    let Registration { frames, corrections, betas, inverse_depth, clothes, .. } = registration;
    capture.mean_betas = sum(&capture.mean_betas, &betas);
    for (index, frame) in capture.train.iter_mut().enumerate() {
        let after = frames.partition_point(|&f| f <= index);
        let (a, b) = (after - 1, after.min(frames.len() - 1));
        let share = if a == b { 0.0 } else { (index - frames[a]) as f32 / (frames[b] - frames[a]) as f32 };
        let correction: Correction =
            corrections[a].iter().zip(&corrections[b]).map(|(a, b)| a.lerp(*b, share)).collect();
        let root_depth = if inverse_depth == 1.0 { None } else { root_depth(frame, model) };
        frame.betas = sum(&frame.betas, &betas);
        (frame.pose, frame.placement) = corrected(frame, model, &model.shaped(&frame.betas), &correction);
        frame.placement = rescaled(frame.placement, root_depth.unwrap_or_default(), inverse_depth);
        frame.camera.focal /= inverse_depth;
    }
    for view in &mut capture.eval {
        if let Some(Frame { pose, placement, betas, .. }) = capture.train.get(view.train_index) {
            (view.frame.pose, view.frame.placement) = (pose.clone(), *placement);
            view.frame.betas.clone_from(betas);
        }
    }
    Ok(Registered { capture, clothes, mending, fists })
}

impl<'a> Registration<'a> {
    fn new(capture: &'a Capture, model: &'a BodyModel) -> Result<Self, Error> {
        let per_frame = 3 * (model.num_joints() + 1);
        let most = (MOST_NUMBERS / (per_frame * per_frame)).clamp(2, MOST_FRAMES);
        let frames: Vec<usize> = (0..capture.train.len()).step_by(capture.train.len().div_ceil(most).max(1)).collect();
        let crop = |&frame: &usize| {
            let frame = &capture.train[frame];
            let posed = model.pose(&model.shaped(&frame.betas), &frame.pose, frame.placement);
            Ok(Crop::new(&frame.camera, &frame.pixels()?, &posed.vertices))
        };
        let crops = frames.par_iter().map(crop).collect::<Result<Vec<_>, Error>>()?;
        let keypoints = frames.iter().zip(&crops).map(|(&frame, crop): (_, &Option<Crop>)| {
            let (Some(crop), frame) = (crop, &capture.train[frame]) else { return Vec::new() };
            let scale = crop.camera.focal / frame.camera.focal;
            let cropped = |p: &Keypoint| {
                let place = (p.place - frame.camera.centre) * scale + crop.camera.centre;
                Keypoint { place, ..*p }
            };
            frame.keypoints.iter().map(cropped).collect()
        });
        let keypoints: Vec<Vec<Keypoint>> = keypoints.collect();
        // Key points tell of each frame by itself.
        let pose_error = match keypoints.iter().all(Vec::is_empty) {
            true => PoseErrorModel::OUTLINES,
            false => PoseErrorModel::of_motion(rate(capture, &frames)),
        };
        let bounds = Aabb::from_points(&model.shaped(&capture.mean_betas).vertices);
        let unit = (bounds.max.y - bounds.min.y) / 1.7;
        // A capture with evaluation cameras is calibrated.
        let depth = |&f: &usize| root_depth(&capture.train[f], model).filter(|way| way.length() > LEAST_DEPTH * unit);
        let root_depths = if capture.eval.is_empty() { frames.iter().map(depth).collect() } else { None };
        Ok(Self {
            shared_edges: shared_edges(&model.faces),
            unit,
            corrections: vec![vec![Vec3::ZERO; model.num_joints() + 1]; frames.len()],
            pose_error,
            betas: vec![0.0; model.num_betas().min(BETAS)],
            root_depths,
            inverse_depth: 1.0,
            clothes: vec![0.0; model.num_vertices()],
            capture,
            model,
            frames,
            crops,
            keypoints,
        })
    }

    /// Takes one Gauss-Newton step; false for a singular system.
    fn step(&mut self, options: ObservationOptions) -> Result<bool, Error> {
        let this = &*self;
        let bodies: Vec<ClothedBody> = (0..this.frames.len()).into_par_iter().map(|f| this.clothed_body(f)).collect();
        let observe = |(crop, body): (&Option<Crop>, &ClothedBody)| match crop {
            Some(crop) => observe(crop, &body.dressed, (&this.model.faces, &this.shared_edges), options),
            None => Ok(Observations::default()),
        };
        let observations: Result<Vec<Observations>, Error> = this.crops.par_iter().zip(&bodies).map(observe).collect();
        let observations = observations?;
        let clothes = this.measure_clothes(&observations);
        let thicker: Vec<f32> = clothes.iter().zip(&this.clothes).map(|(next, now)| next - now).collect();
        let colors = Colors::measure(&observations, this.model.num_vertices());
        let points = |f: usize| {
            let camera = &this.crops[f].as_ref()?.camera;
            Some(FramePoints { camera, points: &this.keypoints[f], posed: &bodies[f].posed })
        };
        let all: Vec<FramePoints<'_>> = (0..bodies.len()).filter_map(points).collect();
        let mut detector = DetectorModel::measure(&all);
        detector.width = 1.0 + (WIDTH - 1.0) * (options.reach - REACH[1]) / (REACH[0] - REACH[1]);
        let mut normals: Vec<NormalEquations> = (0..this.frames.len())
            .into_par_iter()
            .map(|f| {
                let ClothedBody { shape, posed, .. } = &bodies[f];
                let camera = &this.capture.train[this.frames[f]].camera;
                let perspective = this.perspective(f);
                let mut equations = Equations::new(this.model, (shape, posed), this.reshaped(f), camera, perspective);
                equations.add_outline(&observations[f], &thicker, this.unit);
                if let Some(points) = points(f) {
                    equations.add_keypoints(&points, &detector);
                }
                equations.add_colors(&observations[f], &colors, options.blur);
                equations.normal
            })
            .collect();
        let poses: Vec<&Posed> = bodies.iter().map(|body| &body.posed).collect();
        pose_prior::add(this.model, &poses, &mut normals);
        let size = 3 * (this.model.num_joints() + 1);
        let gap = this.frames.get(1).map_or(1, |second| second - this.frames[0]);
        let (variances, ar_coefficients) = this.pose_error.prior(this.unit, size, gap);
        let flat = |c: &Correction| DVector::from_iterator(size, c.iter().flat_map(|v| v.as_dvec3().to_array()));
        let per_frame: Vec<DVector<f64>> = this.corrections.iter().map(flat).collect();
        let mut precisions = vec![(SHAPE * SHAPE).recip(); this.betas.len()];
        let mut global: Vec<f64> = this.betas.iter().map(|&b| f64::from(b)).collect();
        if let Some(depths) = &this.root_depths {
            let mean = depths.iter().map(|depth| depth.length()).sum::<f32>() / (depths.len() as f32 * this.unit);
            precisions.push(f64::from(INVERSE_DEPTH * mean).powi(-2));
            global.push(f64::from(this.inverse_depth) - 1.0);
        }
        let prior = Prior { per_frame: &variances, ar_coefficients: &ar_coefficients, global: &precisions };
        let Some(solution) = solve(&normals, &prior, &per_frame, &DVector::from_vec(global)) else { return Ok(false) };
        let Solution { per_frame: steps, global: step, variances } = solution;
        if !steps.iter().chain([&step]).all(|s| s.iter().all(|v| v.is_finite())) {
            return Ok(false);
        }
        self.clothes = clothes;
        for (correction, step) in self.corrections.iter_mut().zip(&steps) {
            let each = step.as_slice().chunks_exact(3);
            correction.iter_mut().zip(each).for_each(|(c, s)| *c += glam::DVec3::from_slice(s).as_vec3());
        }
        let estimate = self.pose_error.reestimated(&self.corrections, &variances, self.unit);
        let rotation = if options.blur > 0.0 { estimate.rotation } else { self.pose_error.rotation };
        self.pose_error = PoseErrorModel { rotation, ..estimate };
        self.betas.iter_mut().zip(step.iter()).for_each(|(beta, step)| *beta += *step as f32);
        if let (Some(depths), Some(step)) = (&self.root_depths, step.get(self.betas.len())) {
            let nearest = depths.iter().map(|depth| depth.length()).fold(f32::INFINITY, f32::min);
            let (previous, most) = (self.inverse_depth, nearest / (LEAST_DEPTH * self.unit));
            self.inverse_depth = (previous + *step as f32).clamp(0.5 * previous, (2.0 * previous).min(most));
            for crop in self.crops.iter_mut().flatten() {
                crop.camera.focal *= previous / self.inverse_depth;
            }
        }
        Ok(true)
    }

    /// Corrected body of a frame, with `betas` added to its shape coefficients.
    fn posed(&self, f: usize, betas: &[f32]) -> (Shaped, Posed) {
        self.posed_as(self.model, f, betas, &self.corrections[f])
    }

    /// [`Registration::posed`] of another body with the same joints.
    fn posed_as(&self, model: &BodyModel, f: usize, betas: &[f32], correction: &Correction) -> (Shaped, Posed) {
        let frame = &self.capture.train[self.frames[f]];
        let shape = model.shaped(&sum(&frame.betas, betas));
        let (pose, placement) = corrected(frame, model, &shape, correction);
        let depth = self.root_depths.as_ref().map_or(Vec3::ZERO, |depths| depths[f]);
        let posed = model.pose(&shape, &pose, rescaled(placement, depth, self.inverse_depth));
        (shape, posed)
    }

    /// Perspective of a frame and its current camera; `None` for a known focal length.
    fn perspective(&self, f: usize) -> Option<(Perspective, Camera)> {
        let depths = self.root_depths.as_ref()?;
        // Every frame has the unknown, also one without the body.
        let camera = self.crops[f].as_ref().map_or(self.capture.train[self.frames[f]].camera, |crop| crop.camera);
        Some((Perspective { inverse_depth: self.inverse_depth, depth: depths[f].length() }, camera))
    }

    fn clothed_body(&self, f: usize) -> ClothedBody {
        let (shape, posed) = self.posed(f, &self.betas);
        let normals = normals(&posed.vertices, &self.model.faces);
        let dressed = dressed(&posed.vertices, &normals, &self.clothes);
        ClothedBody { shape, posed, dressed }
    }

    /// Bodies of a frame with [`BETA_STEP`] added to each shape coefficient.
    fn reshaped(&self, f: usize) -> Vec<Posed> {
        let more = |k: usize| {
            let mut betas = self.betas.clone();
            betas[k] += BETA_STEP;
            self.posed(f, &betas).1
        };
        (0..self.betas.len()).map(more).collect()
    }

    /// Offset of the clothes at each vertex: the mean over frames and neighbours, shrunk towards 0
    /// by [`DOUBT`].
    fn measure_clothes(&self, observations: &[Observations]) -> Vec<f32> {
        let most = CLOTHES * self.unit;
        let mut sums = vec![(0.0f32, 0.0f32); self.clothes.len()];
        for edge in observations.iter().flat_map(|observed| &observed.edges) {
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
            // Total weight of a vertex with six neighbours.
            sums = next.into_iter().map(|(sum, weight)| (sum / 1.9, weight / 1.9)).collect();
        }
        sums.into_iter().map(|(sum, weight)| sum / (weight + DOUBT)).collect()
    }
}

/// Root mean square turn of a joint against its parent a frame, between neighbours among
/// `frames`, radians.
fn rate(capture: &Capture, frames: &[usize]) -> f64 {
    let turns = frames.windows(2).flat_map(|pair| {
        let [a, b] = [pair[0], pair[1]].map(|f| capture.train[f].pose.iter().skip(1));
        a.zip(b).map(|(a, b)| Quat::from_scaled_axis(*a).angle_between(Quat::from_scaled_axis(*b)))
    });
    let (sum, count): (f64, f64) =
        turns.filter(|turn| turn.is_finite()).fold((0.0, 0.0), |(s, n), t| (s + f64::from(t * t), n + 1.0));
    let gap = frames.get(1).map_or(1, |second| second - frames[0]);
    if count > 0.0 { (sum / count).sqrt() / gap as f64 } else { 0.0 }
}

/// Vector along the optical axis from the camera plane to the root joint of a frame as given;
/// `None` for a root behind the camera.
fn root_depth(frame: &Frame, model: &BodyModel) -> Option<Vec3> {
    let root = model.shaped(&frame.betas).joints.first().copied()?;
    let root = match frame.placement {
        Placement::Pelvis { translation } => root + translation,
        Placement::Origin { rotation, translation } => Quat::from_scaled_axis(rotation) * root + translation,
    };
    let to_camera = frame.camera.world_to_camera;
    let depth = to_camera.transform_point3(root).z;
    (depth > 0.0).then(|| to_camera.matrix3.transpose() * Vec3::new(0.0, 0.0, depth))
}

/// A placement with its inverse depth multiplied by `inverse_depth`.
fn rescaled(placement: Placement, root_depth: Vec3, inverse_depth: f32) -> Placement {
    let by = (inverse_depth.recip() - 1.0) * root_depth;
    match placement {
        Placement::Pelvis { translation } => Placement::Pelvis { translation: translation + by },
        Placement::Origin { rotation, translation } => Placement::Origin { rotation, translation: translation + by },
    }
}

/// Sum of shape coefficients, the shorter padded with zeros.
fn sum(a: &[f32], b: &[f32]) -> Vec<f32> {
    let at = |v: &[f32], i: usize| v.get(i).copied().unwrap_or(0.0);
    (0..a.len().max(b.len())).map(|i| at(a, i) + at(b, i)).collect()
}
