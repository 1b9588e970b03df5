//! Temporal outliers of a fit.

use glam::{Quat, Vec3};
use smpl::BodyModel;

use super::frame::Fault;
use crate::capture::{Capture, Frame};

/// Least lateral jump of the pelvis in multiples of the farthest joint's distance from it, least logarithmic
/// jump of its depth, least jump of the rotation of half of the joints, radians.
const LEAST: [f32; 3] = [0.35, 0.25, 0.5];
/// Least ratios of jumps to the median step.
const TIMES: [f32; 3] = [8.0, 8.0, 5.0];

/// The jumps of each frame from the previous one.
pub(super) fn find(capture: &Capture, body: &BodyModel) -> Vec<Vec<Fault>> {
    let states: Vec<State> = capture.train.iter().map(|frame| State::of(frame, body)).collect();
    let steps: Vec<[f32; 3]> = states.windows(2).map(|pair| pair[0].step(&pair[1])).collect();
    let median = |i: usize| {
        let mut values: Vec<f32> = steps.iter().map(|step| step[i]).collect();
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let limits = [0, 1, 2].map(|i| LEAST[i].max(TIMES[i] * median(i)));
    let faults = |step: &[f32; 3]| {
        let mut faults = Vec::new();
        // A pelvis behind the camera gives NaN; comparisons with it are false.
        if step[0] > limits[0] || step[1] > limits[1] {
            faults.push(Fault::PlaceJump);
        }
        if step[2] > limits[2] {
            faults.push(Fault::PoseJump);
        }
        faults
    };
    let first = if states.is_empty() { None } else { Some(Vec::new()) };
    first.into_iter().chain(steps.iter().map(faults)).collect()
}

/// A body in its camera.
struct State {
    pelvis: Vec3,
    reach: f32,
    bones: Vec<Quat>,
}

impl State {
    fn of(frame: &Frame, body: &BodyModel) -> Self {
        let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
        let camera = frame.camera.world_to_camera;
        let turn = |bone: &glam::Affine3A| Quat::from_mat3a(&(camera.matrix3 * bone.matrix3));
        let pelvis = posed.joints.first().copied().unwrap_or(Vec3::ZERO);
        let reach = posed.joints.iter().map(|joint| joint.distance(pelvis)).fold(f32::MIN_POSITIVE, f32::max);
        Self { pelvis: camera.transform_point3(pelvis), reach, bones: posed.bones.iter().map(turn).collect() }
    }

    /// Lateral and depth step of the pelvis, and the median rotation of the joints.
    fn step(&self, next: &Self) -> [f32; 3] {
        let direction = |p: Vec3| p.truncate() / p.z;
        let across = direction(self.pelvis).distance(direction(next.pelvis)) * self.pelvis.z / self.reach;
        let depth = (next.pelvis.z / self.pelvis.z).ln().abs();
        let mut turns: Vec<f32> = self.bones.iter().zip(&next.bones).map(|(a, b)| a.angle_between(*b)).collect();
        turns.sort_by(f32::total_cmp);
        [across, depth, turns.get(turns.len() / 2).copied().unwrap_or(0.0)]
    }
}
