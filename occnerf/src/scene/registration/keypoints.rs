//! Residuals of 2-D key points: a detector's points against projected joints. A detector places a
//! joint elsewhere than the body model does, by a constant offset in the axes of the joint's bone,
//! which is estimated from all frames.

use glam::{Mat3, Vec2, Vec3};
use smpl::Posed;
use volrender::Camera;

use crate::capture::Keypoint;
use crate::scene::registration::equations::robust;

/// Least standard deviation of a coordinate, pixels.
const NOISE: f32 = 1.0;
/// Standard deviation of an offset, metres of a body 1.7 high.
const OFFSET: f32 = 0.04;

/// Key points of one frame, in pixels of `camera`, and the body there.
pub(super) struct FramePoints<'a> {
    pub camera: &'a Camera,
    pub points: &'a [Keypoint],
    pub posed: &'a Posed,
}

/// Offsets of a detector's points, and their noise.
#[derive(Clone, Debug)]
pub(super) struct DetectorModel {
    /// Offset from each joint in the axes of its bone, (J).
    offsets: Vec<Vec3>,
    /// Robust standard deviation of a coordinate, pixels.
    noise: f32,
}

/// A residual, x and y, of a point that is fixed to a bone.
pub(super) struct PointResidual {
    pub joint: usize,
    /// The body's point in the world.
    pub place: Vec3,
    /// Projection minus detection, pixels, and its gradients by `place`.
    pub residual: Vec2,
    pub gradients: [Vec3; 2],
    pub weight: f32,
}

impl DetectorModel {
    /// Estimates offsets by regularised least squares, then the noise. `unit` is the length of a metre of
    /// a body 1.7 high.
    pub fn measure(frames: &[FramePoints<'_>], joints: usize, unit: f32) -> Self {
        let mut model = Self { offsets: vec![Vec3::ZERO; joints], noise: 1.0 };
        model.noise = model.deviation(frames);
        let ridge = (model.noise / (OFFSET * unit)).powi(2);
        let mut sums = vec![(Mat3::from_diagonal(Vec3::splat(ridge)), Vec3::ZERO); joints];
        for frame in frames {
            for seen in model.residuals(frame) {
                let bone = Mat3::from(frame.posed.bones[seen.joint].matrix3).transpose();
                let weight = seen.weight * model.noise * model.noise;
                for (gradient, residual) in seen.gradients.iter().zip(seen.residual.to_array()) {
                    let row = bone * *gradient;
                    let sum = &mut sums[seen.joint];
                    sum.0 += Mat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
                    sum.1 -= weight * residual * row;
                }
            }
        }
        model.offsets = sums.iter().map(|(matrix, side)| matrix.inverse() * *side).collect();
        model.noise = model.deviation(frames);
        model
    }

    /// Scaled median absolute deviation of the coordinates.
    fn deviation(&self, frames: &[FramePoints<'_>]) -> f32 {
        let mut errors: Vec<f32> = frames
            .iter()
            .flat_map(|frame| self.residuals(frame))
            .flat_map(|seen| seen.residual.abs().to_array())
            .collect();
        let middle = errors.len() / 2;
        let median = if errors.is_empty() { 0.0 } else { *errors.select_nth_unstable_by(middle, f32::total_cmp).1 };
        (1.48 * median).max(NOISE)
    }

    /// Residuals of a frame's points in front of the camera.
    pub fn residuals<'a>(&'a self, frame: &'a FramePoints<'a>) -> impl Iterator<Item = PointResidual> + 'a {
        frame.points.iter().filter_map(move |point| {
            let (joint, posed) = (point.joint, frame.posed);
            let place = *posed.joints.get(joint)? + posed.bones[joint].matrix3 * self.offsets[joint];
            let (at, gradients) = projected(frame.camera, place)?;
            let residual = at - point.place;
            let trust = point.confidence * robust(residual.length_squared(), self.noise);
            Some(PointResidual { joint, place, residual, gradients, weight: trust / (self.noise * self.noise) })
        })
    }
}

/// Projection of a point and its gradients in the world; `None` behind the camera.
fn projected(camera: &Camera, point: Vec3) -> Option<(Vec2, [Vec3; 2])> {
    let at = camera.project(point)?.truncate();
    let p = camera.world_to_camera.transform_point3(point);
    let to_world = camera.world_to_camera.matrix3.transpose();
    let x = to_world * (Vec3::new(1.0, 0.0, -p.x / p.z) * (camera.focal.x / p.z));
    let y = to_world * (Vec3::new(0.0, 1.0, -p.y / p.z) * (camera.focal.y / p.z));
    Some((at, [x, y]))
}
