//! Priors and masks made wrong on purpose, to see what a method bears.

use glam::{Quat, Vec2, Vec3};
use serde::{Deserialize, Serialize};
use smpl::{BodyModel, Placement};

use crate::demo::landmarks::joint;
use crate::demo::motion::{Pose, TrackerError, track, wander};
use crate::photograph::{Shot, fray};
use capture::{Capture, CaptureError, Frame, Keypoint};
use volrender::RandomStream;

/// Number of corrupted coefficients; later ones change the body little.
const BETAS: usize = 10;
const SHAPE: u64 = 0x5348_4150;
const DEPTH: u64 = 0x4445_5054;
const LIMBS: u64 = 0x4c49_4d42;
const LIGHT: u64 = 0x4c49_4748;
const POINTS: u64 = 0x504f_494e;

/// Errors added to what a capture says of the body and of its pixels. None by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Perturbation {
    /// Root mean square error of each bone's global orientation, degrees, smooth in time, 0 to 90.
    pub pose_degrees: f32,
    /// Standard deviation of the error of each shape coefficient, the same in all frames, 0 to 5.
    pub shape: f32,
    /// Root mean square error of the place, metres of a body 1.7 high, smooth in time, 0 to 1.
    pub translation: f32,
    /// Root mean square error of the distance from the camera, per cent, smooth in time, 0 to 50.
    pub depth_percent: f32,
    /// Standard deviation of the error of the lengths of the limbs' bones, per cent, left as right,
    /// 0 to 50: see [`Perturbation::corrupt_body`].
    pub limbs_percent: f32,
    /// Largest displacement of the edges of the training masks, pixels, 0 to 64. What is
    /// added shows black.
    pub ragged_pixels: f32,
    /// Pixels by which the training masks are larger (smaller if negative) than they should be, −64
    /// to 64. What is added shows black.
    pub mask_pixels: i32,
    /// Standard deviation of the noise of key points, pixels of a body 250 high, 0 to 50; none are
    /// made at 0. They are SMPL's limbs' joints, each off by a constant as large beside it.
    pub keypoint_pixels: f32,
    /// Training frames as a camera and a segmenter make them.
    pub photographed: bool,
    /// Draw of the random errors.
    pub seed: u64,
}

impl Perturbation {
    /// No error.
    pub const NONE: Self = Self {
        pose_degrees: 0.0,
        shape: 0.0,
        translation: 0.0,
        depth_percent: 0.0,
        limbs_percent: 0.0,
        ragged_pixels: 0.0,
        mask_pixels: 0,
        keypoint_pixels: 0.0,
        photographed: false,
        seed: 0,
    };
    /// What cameras, estimators and segmenters make of a real video.
    pub const REAL: Self = Self {
        pose_degrees: 2.5,
        shape: 0.5,
        translation: 0.01,
        depth_percent: 2.0,
        limbs_percent: 2.5,
        ragged_pixels: 2.0,
        mask_pixels: 0,
        keypoint_pixels: 1.5,
        photographed: true,
        seed: 0,
    };

    fn check(&self) -> Result<(), CaptureError> {
        let real = [
            ("wrong.pose_degrees", self.pose_degrees, 90.0),
            ("wrong.shape", self.shape, 5.0),
            ("wrong.translation", self.translation, 1.0),
            ("wrong.depth_percent", self.depth_percent, 50.0),
            ("wrong.limbs_percent", self.limbs_percent, 50.0),
            ("wrong.ragged_pixels", self.ragged_pixels, 64.0),
            ("wrong.keypoint_pixels", self.keypoint_pixels, 50.0),
        ];
        for (name, value, most) in real {
            if !(0.0..=most).contains(&value) {
                return Err(CaptureError::setting(name, format!("0 to {most}"), value));
            }
        }
        if !(-64..=64).contains(&self.mask_pixels) {
            return Err(CaptureError::setting("wrong.mask_pixels", "-64 to 64", self.mask_pixels));
        }
        Ok(())
    }

    /// Makes a capture wrong. Views kept back get the wrong bodies of their instants, but keep
    /// their pixels. Lengths of limbs are the body's: see [`Perturbation::corrupt_body`].
    ///
    /// # Errors
    /// A value out of its range.
    pub fn apply(&self, capture: &mut Capture, body: &BodyModel) -> Result<(), CaptureError> {
        self.check()?;
        if self.keypoint_pixels > 0.0 {
            detect(capture, body, self.keypoint_pixels, self.seed);
        }
        let shots = if self.photographed { shots(capture, body, self.seed) } else { Vec::new() };
        if self.shape > 0.0 {
            let mut stream = RandomStream::new(&[SHAPE ^ self.seed]);
            let count = body.num_betas().min(BETAS);
            let error: Vec<f32> = (0..count).map(|_| self.shape * stream.normal()).collect();
            let frames = capture.train.iter_mut().map(|f| &mut f.betas);
            let views = capture.eval.iter_mut().map(|v| &mut v.frame.betas);
            for betas in frames.chain(views).chain([&mut capture.mean_betas]) {
                betas.resize(betas.len().max(count), 0.0);
                betas.iter_mut().zip(&error).for_each(|(beta, error)| *beta += error);
            }
        }
        if self.pose_degrees > 0.0 || self.translation > 0.0 || self.depth_percent > 0.0 {
            self.displace(capture, body);
        }
        for (index, frame) in capture.train.iter_mut().enumerate() {
            let (shot, grown, ragged) = (shots.get(index).copied(), self.mask_pixels, self.ragged_pixels);
            let number = numbered(index, self.seed);
            if shot.is_none() && grown == 0 && ragged == 0.0 {
                continue;
            }
            frame.source.edit(move |pixels| {
                let photograph = shot.map(|shot| shot.photograph(pixels));
                pixels.grow(grown);
                if ragged > 0.0 {
                    fray(pixels, ragged, number);
                }
                if let (Some(shot), Some(photograph)) = (shot, photograph) {
                    shot.segment(pixels, &photograph);
                }
            });
        }
        Ok(())
    }

    /// Makes the limbs of a body too long or too short, each bone with its twin on the other side
    /// ([`BodyModel::limbs`]).
    pub fn corrupt_body(&self, body: &mut BodyModel) {
        if self.limbs_percent == 0.0 {
            return;
        }
        let limbs = body.limbs();
        let mut moved = body.v_template.clone();
        for pair in limbs.pairs() {
            let part = 0.01 * self.limbs_percent * RandomStream::new(&[LIMBS ^ self.seed, pair as u64]).normal();
            moved.iter_mut().zip(limbs.longer(pair)).for_each(|(v, longer)| *v += part * longer);
        }
        body.v_template = moved;
    }

    /// Turns bones, and moves the whole.
    fn displace(&self, capture: &mut Capture, body: &BodyModel) {
        let shaped = body.shaped(&capture.mean_betas);
        let height = |pick: fn(f32, f32) -> f32| shaped.vertices.iter().map(|v| v.y).reduce(pick).unwrap_or(0.0);
        let unit = (height(f32::max) - height(f32::min)) / 1.7;
        self.turn(capture, body, self.translation * unit);
        // Of three axes each has a third of the square.
        let rms = 3.0f32.sqrt() * 0.01 * self.depth_percent;
        let nearer = wander(&mut RandomStream::new(&[DEPTH ^ self.seed]), capture.train.len(), rms);
        for (frame, nearer) in capture.train.iter_mut().zip(nearer) {
            let pelvis = body.shaped(&frame.betas).joints.first().copied().unwrap_or(Vec3::ZERO);
            let Pose { rotation, translation, .. } = about_origin(frame, pelvis);
            let away = rotation * pelvis + translation - frame.camera.centre_of_projection();
            match &mut frame.placement {
                Placement::Origin { translation, .. } | Placement::Pelvis { translation } => {
                    *translation += nearer.x * away;
                }
            }
        }
        for view in &mut capture.eval {
            if let Some(frame) = capture.train.get(view.train_index) {
                (view.frame.pose, view.frame.placement) = (frame.pose.clone(), frame.placement);
            }
        }
    }

    fn turn(&self, capture: &mut Capture, body: &BodyModel, translation: f32) {
        let pelvis = |frame: &Frame| body.shaped(&frame.betas).joints.first().copied().unwrap_or(Vec3::ZERO);
        let Some(first) = capture.train.first().map(pelvis) else { return };
        let poses: Vec<Pose> = capture.train.iter().map(|frame| about_origin(frame, pelvis(frame))).collect();
        let error = TrackerError { seed: self.seed, rotation: self.pose_degrees.to_radians(), translation };
        for (frame, pose) in capture.train.iter_mut().zip(track(&poses, &body.parents, first, error)) {
            let Pose { joints, rotation, translation } = pose;
            frame.pose = joints;
            match &mut frame.placement {
                Placement::Origin { rotation: r, translation: t } => {
                    (*r, *t) = (rotation.to_scaled_axis(), translation);
                }
                Placement::Pelvis { translation: t } => {
                    let pelvis = body.shaped(&frame.betas).joints.first().copied().unwrap_or(Vec3::ZERO);
                    frame.pose[0] = rotation.to_scaled_axis();
                    *t = translation + rotation * pelvis - pelvis;
                }
            }
        }
    }
}

/// Number of a frame's noise: a thousand frames a draw.
fn numbered(frame: usize, seed: u64) -> u64 {
    (frame as u64).wrapping_add(seed.wrapping_mul(1000))
}

/// Joints of SMPL's limbs.
const LIMB_JOINTS: [usize; 12] = [1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21];

/// Places of the joints in a frame's picture, and the height of the body there, pixels; none of a
/// body without SMPL's joints.
fn projected(frame: &Frame, body: &BodyModel) -> Option<(Vec<Vec2>, f32)> {
    let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
    let all = |points: &[Vec3]| -> Option<Vec<Vec2>> {
        points.iter().map(|p| frame.camera.project(*p).map(|p| p.truncate())).collect()
    };
    let (joints, vertices) = (all(&posed.joints)?, all(&posed.vertices)?);
    let end = |pick: fn(f32, f32) -> f32| vertices.iter().map(|v| v.y).reduce(pick);
    (joints.len() == joint::COUNT).then_some((joints, end(f32::max)? - end(f32::min)?))
}

/// Gives the training frames key points with this noise.
fn detect(capture: &mut Capture, body: &BodyModel, noise: f32, seed: u64) {
    let mut stream = RandomStream::new(&[POINTS ^ seed]);
    let mut vector = move || noise / 250.0 * Vec2::new(stream.normal(), stream.normal());
    let offsets = LIMB_JOINTS.map(|_| vector());
    for frame in &mut capture.train {
        let Some((joints, height)) = projected(frame, body) else { continue };
        let points = LIMB_JOINTS.iter().zip(offsets).map(|(&joint, offset)| {
            let place = joints[joint] + height * (offset + vector());
            Keypoint { joint, place, confidence: 0.8 }
        });
        frame.keypoints = points.collect();
    }
}

/// The cameras' and the segmenter's faults in each training frame.
fn shots(capture: &Capture, body: &BodyModel, seed: u64) -> Vec<Shot> {
    let light = wander(&mut RandomStream::new(&[LIGHT ^ seed]), capture.train.len(), 3.0f32.sqrt());
    let shot = |(i, (frame, light)): (usize, (&Frame, Vec3))| match projected(frame, body) {
        Some((joints, height)) => Shot {
            height,
            hand: Some((joints[joint::RIGHT_ELBOW], joints[joint::RIGHT_ELBOW + 4])),
            foot: Some(joints[joint::LEFT_ANKLE + 3]),
            ..Shot::new(numbered(i, seed), light.x)
        },
        None => Shot::new(numbered(i, seed), light.x),
    };
    capture.train.iter().zip(light).enumerate().map(shot).collect()
}

/// The pose with its global rotation about the origin.
fn about_origin(frame: &Frame, pelvis: Vec3) -> Pose {
    let mut joints = frame.pose.clone();
    let (rotation, translation) = match frame.placement {
        Placement::Origin { rotation, translation } => (Quat::from_scaled_axis(rotation), translation),
        Placement::Pelvis { translation } => {
            let rotation = Quat::from_scaled_axis(joints.first().copied().unwrap_or(Vec3::ZERO));
            (rotation, translation + pelvis - rotation * pelvis)
        }
    };
    if let Some(root) = joints.first_mut() {
        *root = Vec3::ZERO;
    }
    Pose { joints, rotation, translation }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DemoConfig, demo};

    fn capture(body: &BodyModel) -> Capture {
        sized(body, 48)
    }

    fn sized(body: &BodyModel, size: u32) -> Capture {
        let exact = DemoConfig { pose_noise_degrees: 0.0, translation_noise: 0.0, ..DemoConfig::default() };
        demo(&DemoConfig { size, frames: 12, eval_cameras: 1, ..exact }, body).unwrap()
    }

    #[test]
    fn bones_turn_by_the_angle_asked_for_about_the_pelvis_in_both_placements() {
        let body = BodyModel::embedded();
        let before = capture(&body);
        let wrong = Perturbation { pose_degrees: 6.0, ..Perturbation::default() };
        let mut about_pelvis = before.clone();
        for frame in &mut about_pelvis.train {
            let pelvis = body.shaped(&frame.betas).joints[0];
            let Placement::Origin { rotation, translation } = frame.placement else { panic!("the demo's placement") };
            frame.pose[0] = rotation;
            let kept = Quat::from_scaled_axis(rotation) * pelvis - pelvis;
            frame.placement = Placement::Pelvis { translation: translation + kept };
        }
        for mut after in [before.clone(), about_pelvis] {
            wrong.apply(&mut after, &body).unwrap();
            let (mut squares, mut count) = (0.0, 0.0);
            for (a, b) in before.train.iter().zip(&after.train) {
                let shape = body.shaped(&a.betas);
                let (a, b) = (body.pose(&shape, &a.pose, a.placement), body.pose(&shape, &b.pose, b.placement));
                assert!(a.joints[0].distance(b.joints[0]) < 1e-4);
                for (a, b) in a.bones.iter().zip(&b.bones) {
                    let turn = Quat::from_mat3a(&(b.matrix3 * a.matrix3.inverse()));
                    squares += turn.normalize().to_scaled_axis().length_squared();
                    count += 1.0;
                }
            }
            let rms = (squares / count).sqrt().to_degrees();
            assert!((rms - 6.0).abs() < 0.1, "{rms}");
            let view = &after.eval[0];
            assert_eq!(view.frame.pose, after.train[view.train_index].pose);
        }
    }

    #[test]
    fn every_draw_has_errors_of_its_own() {
        let body = BodyModel::embedded();
        let of = |seed: u64| {
            let (mut capture, mut model) = (capture(&body), body.clone());
            let wrong = Perturbation { seed, ..Perturbation::REAL };
            wrong.apply(&mut capture, &body).unwrap();
            wrong.corrupt_body(&mut model);
            let frame = &capture.train[5];
            let mask = frame.pixels().unwrap().mask.clone();
            (frame.pose.clone(), frame.placement, capture.mean_betas.clone(), frame.keypoints.clone(), mask, model)
        };
        let (first, again, other) = (of(1), of(1), of(2));
        assert!(first.0 == again.0 && first.4 == again.4);
        assert!(first.0 != other.0 && first.1 != other.1 && first.2 != other.2 && first.3 != other.3);
        assert!(first.4 != other.4 && first.5.v_template != other.5.v_template);
    }

    #[test]
    fn masks_grow_and_shrink_and_pictures_stay_within_them() {
        let body = BodyModel::embedded();
        let before = capture(&body);
        let area = |c: &Capture| c.train.iter().map(|f| f.pixels().unwrap().mask.iter().sum::<f32>()).sum::<f32>();
        for (mask_pixels, grows) in [(2, true), (-2, false)] {
            let mut after = before.clone();
            Perturbation { mask_pixels, ..Perturbation::default() }.apply(&mut after, &body).unwrap();
            assert_eq!(area(&after) > 1.1 * area(&before), grows);
            assert_eq!(area(&after) < 0.9 * area(&before), !grows);
            for frame in &after.train {
                let pixels = frame.pixels().unwrap();
                let mut each = pixels.image.pixels.chunks_exact(3).zip(&pixels.mask);
                assert!(each.all(|(p, m)| p.iter().all(|c| *c <= m + 1e-5)));
            }
        }
    }

    #[test]
    fn the_whole_moves_by_as_much_as_is_asked_for() {
        let body = BodyModel::embedded();
        let before = capture(&body);
        let pelvis = |frame: &Frame| body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement).joints[0];
        for wrong in [
            Perturbation { translation: 0.05, ..Perturbation::NONE },
            Perturbation { depth_percent: 3.0, ..Perturbation::NONE },
        ] {
            let mut after = before.clone();
            wrong.apply(&mut after, &body).unwrap();
            let (mut squares, mut parts) = (0.0, 0.0);
            for (a, b) in before.train.iter().zip(&after.train) {
                let (from, to) = (pelvis(a), pelvis(b));
                let ray = from - a.camera.centre_of_projection();
                squares += (to - from).length_squared() / before.train.len() as f32;
                parts += ((to - from).length() / ray.length()).powi(2) / before.train.len() as f32;
                assert!(wrong.depth_percent == 0.0 || (to - from).cross(ray).length() < 1e-3);
            }
            let (rms, part) = (squares.sqrt(), 100.0 * parts.sqrt());
            // The body is nearly 1.7 high; the shares of the axes are only even on the average.
            assert!(wrong.translation == 0.0 || (rms / wrong.translation - 1.0).abs() < 0.1, "{rms}");
            assert!(wrong.depth_percent == 0.0 || (part / wrong.depth_percent - 1.0).abs() < 0.5, "{part}");
            assert_eq!(after.eval[0].frame.placement, after.train[after.eval[0].train_index].placement);
        }
    }

    /// As two real captures have them: intersection over union of prior and mask .67, 11 % of the
    /// masks are not the person, joints 2.3 % of the height from key points.
    #[test]
    fn a_real_capture_has_the_statistics_of_real_captures() {
        let body = BodyModel::embedded();
        let usual = DemoConfig { frames: 48, eval_cameras: 0, occluded_fraction: 0.0, ..DemoConfig::default() };
        let before = demo(&usual, &body).unwrap();
        let mut after = before.clone();
        Perturbation::REAL.apply(&mut after, &body).unwrap();
        let mut body = body;
        Perturbation::REAL.corrupt_body(&mut body);
        let (mut overlap, mut dirty, mut apart) = (0.0, 0.0, 0.0);
        for (a, b) in before.train.iter().zip(&after.train) {
            let (truth, mask) = (a.pixels().unwrap().mask, b.pixels().unwrap().mask);
            let posed = body.pose(&body.shaped(&b.betas), &b.pose, b.placement);
            let volrender::Camera { focal, centre, world_to_camera, width, height } = b.camera;
            let camera = visibility::View { focal, centre, world_to_camera, width, height };
            let options = visibility::RasterOptions::default();
            let prior: Vec<Option<visibility::Fragment>> =
                visibility::Rasterizer::default().faces(&posed.vertices, &body.faces, &camera, &options).unwrap();
            let share = |of: &dyn Fn(usize) -> bool, all: &dyn Fn(usize) -> bool| {
                let count = |pick: &dyn Fn(usize) -> bool| (0..mask.len()).filter(|&i| pick(i)).count() as f32;
                count(&|i| of(i) && all(i)) / count(all)
            };
            overlap += share(&|i| mask[i] > 0.5 && prior[i].is_some(), &|i| mask[i] > 0.5 || prior[i].is_some());
            dirty += share(&|i| truth[i] <= 0.5, &|i| mask[i] > 0.5);
            let (joints, height) = projected(b, &body).unwrap();
            let off = b.keypoints.iter().map(|point| point.place.distance(joints[point.joint]) / height);
            apart += off.sum::<f32>() / b.keypoints.len() as f32;
        }
        let [overlap, dirty, apart] = [overlap, dirty, apart].map(|sum| sum / before.train.len() as f32);
        assert!((overlap - 0.67).abs() < 0.03, "{overlap} {dirty} {apart}");
        assert!((dirty - 0.11).abs() < 0.02, "{dirty} {apart}");
        assert!((apart - 0.023).abs() < 0.004, "{apart}");
    }

    #[test]
    fn errors_out_of_range_are_named() {
        assert_eq!(Perturbation::NONE, Perturbation::default());
        Perturbation::REAL.check().unwrap();
        for (wrong, name) in [
            (Perturbation { pose_degrees: f32::NAN, ..Perturbation::default() }, "pose_degrees"),
            (Perturbation { shape: -1.0, ..Perturbation::default() }, "shape"),
            (Perturbation { ragged_pixels: -1.0, ..Perturbation::default() }, "ragged_pixels"),
            (Perturbation { mask_pixels: 65, ..Perturbation::default() }, "mask_pixels"),
        ] {
            assert!(wrong.check().unwrap_err().to_string().contains(name));
        }
    }
}
