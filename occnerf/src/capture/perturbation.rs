//! Priors and masks made wrong on purpose, to see what a method bears.

use glam::{Quat, Vec3};
use serde::{Deserialize, Serialize};
use smpl::{BodyModel, Placement};

use super::demo::motion::{Pose, TrackerError, track};
use super::pixels::Edit;
use super::synth::noise::normal;
use super::{Capture, CaptureError, Frame};
use crate::random::Stream;

/// Coefficients that are wrong at most: what follows hardly changes the body.
const BETAS: usize = 10;
const SHAPE: u64 = 0x5348_4150;

/// Errors added to what a capture says of the body and of its pixels. None by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Perturbation {
    /// Root mean square error of each bone's global orientation, degrees, smooth in time, 0 to 90.
    pub pose_degrees: f32,
    /// Standard deviation of the error of each shape coefficient, the same in all frames, 0 to 5.
    pub shape: f32,
    /// Pixels by which the training masks are larger (smaller if negative) than they should be, −64
    /// to 64. What is added shows black.
    pub mask_pixels: i32,
}

impl Perturbation {
    pub(super) fn check(&self) -> Result<(), CaptureError> {
        let real = [("wrong.pose_degrees", self.pose_degrees, 90.0), ("wrong.shape", self.shape, 5.0)];
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
    /// their pixels.
    ///
    /// # Errors
    /// A value out of its range.
    pub fn apply(&self, capture: &mut Capture, body: &BodyModel) -> Result<(), CaptureError> {
        self.check()?;
        if self.shape > 0.0 {
            let mut stream = Stream::new(&[SHAPE]);
            let count = body.num_betas().min(BETAS);
            let error: Vec<f32> = (0..count).map(|_| self.shape * normal(&mut stream)).collect();
            let frames = capture.train.iter_mut().map(|f| &mut f.betas);
            let views = capture.eval.iter_mut().map(|v| &mut v.frame.betas);
            for betas in frames.chain(views).chain([&mut capture.mean_betas]) {
                betas.resize(betas.len().max(count), 0.0);
                betas.iter_mut().zip(&error).for_each(|(beta, error)| *beta += error);
            }
        }
        if self.pose_degrees > 0.0 {
            self.turn(capture, body);
        }
        if self.mask_pixels != 0 {
            capture.train.iter_mut().for_each(|frame| frame.source.edit(Edit::Grow(self.mask_pixels)));
        }
        Ok(())
    }

    fn turn(&self, capture: &mut Capture, body: &BodyModel) {
        let pelvis = |frame: &Frame| body.shaped(&frame.betas).joints.first().copied().unwrap_or(Vec3::ZERO);
        let Some(first) = capture.train.first().map(pelvis) else { return };
        let poses: Vec<Pose> = capture.train.iter().map(|frame| about_origin(frame, pelvis(frame))).collect();
        let error = TrackerError { seed: 0, rotation: self.pose_degrees.to_radians(), translation: 0.0 };
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
        for view in &mut capture.eval {
            if let Some(frame) = capture.train.get(view.train_index) {
                (view.frame.pose, view.frame.placement) = (frame.pose.clone(), frame.placement);
            }
        }
    }
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
    use super::super::{DemoConfig, demo};
    use super::*;

    fn capture(body: &BodyModel) -> Capture {
        let exact = DemoConfig { pose_noise_degrees: 0.0, translation_noise: 0.0, ..DemoConfig::default() };
        demo(&DemoConfig { size: 48, frames: 12, eval_cameras: 1, ..exact }, body).unwrap()
    }

    #[test]
    fn nothing_changes_by_default() {
        let body = BodyModel::embedded();
        let (before, mut after) = (capture(&body), capture(&body));
        Perturbation::default().apply(&mut after, &body).unwrap();
        for (a, b) in before.train.iter().zip(&after.train) {
            assert!(
                a.pose == b.pose
                    && a.betas == b.betas
                    && a.shown().mask == b.shown().mask
                    && a.placement == b.placement
            );
        }
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
    fn masks_grow_and_shrink_and_pictures_stay_within_them() {
        let body = BodyModel::embedded();
        let before = capture(&body);
        let area = |c: &Capture| c.train.iter().map(|f| f.shown().mask.iter().sum::<f32>()).sum::<f32>();
        for (mask_pixels, grows) in [(2, true), (-2, false)] {
            let mut after = before.clone();
            Perturbation { mask_pixels, ..Perturbation::default() }.apply(&mut after, &body).unwrap();
            assert_eq!(area(&after) > 1.1 * area(&before), grows);
            assert_eq!(area(&after) < 0.9 * area(&before), !grows);
            for frame in &after.train {
                let pixels = frame.shown();
                let mut each = pixels.image.pixels.chunks_exact(3).zip(&pixels.mask);
                assert!(each.all(|(p, m)| p.iter().all(|c| *c <= m + 1e-5)));
            }
        }
    }

    #[test]
    fn errors_out_of_range_are_named() {
        for (wrong, name) in [
            (Perturbation { pose_degrees: f32::NAN, ..Perturbation::default() }, "pose_degrees"),
            (Perturbation { shape: -1.0, ..Perturbation::default() }, "shape"),
            (Perturbation { mask_pixels: 65, ..Perturbation::default() }, "mask_pixels"),
        ] {
            assert!(wrong.check().unwrap_err().to_string().contains(name));
        }
    }
}
