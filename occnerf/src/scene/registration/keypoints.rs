//! Residuals of 2-D key points: a detector's points against projected joints.

use glam::{Vec2, Vec3};
use smpl::Posed;
use volrender::Camera;

use crate::capture::Keypoint;
use crate::scene::registration::colors::robust;

/// Least standard deviation of a coordinate, pixels.
const NOISE: f32 = 1.0;

/// Key points of one frame, in pixels of `camera`, and the body there.
pub(super) struct FramePoints<'a> {
    pub camera: &'a Camera,
    pub points: &'a [Keypoint],
    pub posed: &'a Posed,
}

/// Noise of a detector's points.
#[derive(Clone, Debug)]
pub(super) struct DetectorModel {
    /// Robust standard deviation of a coordinate, pixels.
    noise: f32,
    /// Width of the robust loss, in multiples of the usual one: wide while poses are far off.
    pub width: f32,
}

/// A residual, x and y, of a joint.
pub(super) struct PointResidual {
    pub joint: usize,
    /// Projection minus detection, pixels, and its gradients by the joint's position.
    pub residual: Vec2,
    pub gradients: [Vec3; 2],
    pub weight: f32,
}

impl DetectorModel {
    /// Estimates the noise from all frames.
    pub fn measure(frames: &[FramePoints<'_>]) -> Self {
        let given = Self { noise: 1.0, width: 1.0 };
        Self { noise: given.deviation(frames), ..given }
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
            let (at, gradients) = projected(frame.camera, *posed.joints.get(joint)?)?;
            let residual = at - point.place;
            let trust = point.confidence * robust(residual.length_squared(), self.width * self.noise);
            Some(PointResidual { joint, residual, gradients, weight: trust / (self.noise * self.noise) })
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

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Affine3A, Mat3};
    use proptest::prelude::*;
    use smpl::{BodyModel, Placement};
    use volrender::RandomStream;

    fn camera() -> Camera {
        let rotation = Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0));
        let intrinsics = Mat3::from_cols(Vec3::X * 300.0, Vec3::Y * 280.0, Vec3::new(100.0, 90.0, 1.0));
        let extrinsics = Affine3A::from_mat3_translation(rotation, Vec3::new(0.1, 0.2, 4.0));
        Camera::new(intrinsics, extrinsics, 200, 180).unwrap()
    }

    proptest! {
        #[test]
        fn gradients_of_projections_are_finite_differences(place in prop::array::uniform3(-1.0f32..1.0)) {
            let (camera, place) = (camera(), Vec3::from(place));
            let (_, gradients) = projected(&camera, place).unwrap();
            for axis in Vec3::AXES {
                let at = |by: f32| projected(&camera, place + by * axis).unwrap().0;
                let numeric = (at(1e-2) - at(-1e-2)) / 2e-2;
                let exact = Vec2::from_array(gradients.map(|gradient| gradient.dot(axis)));
                prop_assert!(exact.distance(numeric) < 0.02 * (1.0 + exact.length()), "{exact} {numeric}");
            }
        }
    }

    #[test]
    fn the_noise_is_found_beside_outliers() {
        let (model, camera) = (BodyModel::embedded(), camera());
        let mut random = RandomStream::new(&[4]);
        let mut vector = |size: f32| size * Vec3::new(random.normal(), random.normal(), random.normal());
        let shape = model.shaped(&[]);
        let mut made = Vec::new();
        for frame in 0..60 {
            let mut pose: Vec<Vec3> = (0..model.num_joints()).map(|_| vector(0.3)).collect();
            pose[0] = Vec3::Y * frame as f32;
            let posed = model.pose(&shape, &pose, Placement::default());
            let point = |joint: usize| {
                let lost = if (frame + joint).is_multiple_of(7) { 40.0 } else { 0.0 };
                let place = camera.project(posed.joints[joint]).unwrap().truncate() + vector(2.0).truncate() + lost;
                Keypoint { joint, place, confidence: 0.9 }
            };
            let points: Vec<Keypoint> = [1, 4, 7, 16, 18, 20].map(point).to_vec();
            made.push((points, posed));
        }
        let frames: Vec<FramePoints<'_>> =
            made.iter().map(|(points, posed)| FramePoints { camera: &camera, points, posed }).collect();
        let found = DetectorModel::measure(&frames);
        assert!((1.6..2.6).contains(&found.noise), "{}", found.noise);
        let outliers =
            frames.iter().flat_map(|frame| found.residuals(frame)).filter(|seen| seen.residual.length() > 30.0);
        assert!(outliers.map(|seen| seen.weight * found.noise * found.noise).all(|weight| weight < 0.01));
        assert_eq!(DetectorModel::measure(&[]).noise, NOISE);
    }
}
