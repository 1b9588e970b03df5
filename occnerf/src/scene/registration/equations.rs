//! The normal equations of one frame: outline residuals, colour residuals, and those of 2-D key
//! points, a detector's points against projected joints.

use glam::{Vec2, Vec3};
use smpl::{BodyModel, Posed, Shaped};
use volrender::Camera;

use crate::capture::Keypoint;
use crate::scene::registration::colors::{Colors, robust};
use crate::scene::registration::corrections::{PointJacobian, SurfaceJacobian};
use crate::scene::registration::observations::{Edge, Observations};
use crate::scene::registration::system::NormalEquations;

/// Step of the finite differences by a shape coefficient.
pub(super) const BETA_STEP: f32 = 0.5;
/// Standard deviation of an outline residual: pixels, and metres of varying clothes.
const OUTLINE: [f32; 2] = [0.6, 0.006];
/// Correlation length of outline residuals, pixels.
const CORRELATED: f32 = 3.0;
/// Weight of colour residuals, which are mostly model error: one albedo a vertex, smooth light.
const COLOR: f32 = 0.1;

/// The unknown scale of the root's inverse depth; the focal length follows it, so that the size of
/// the projected body is constant.
#[derive(Clone, Copy, Debug)]
pub(super) struct Perspective {
    /// Inverse depth in multiples of the given one.
    pub inverse_depth: f32,
    /// Given depth of the root.
    pub depth: f32,
}

impl Perspective {
    /// Derivative of a point's projection by `inverse_depth`, as a shift of the point in the world.
    pub fn derivative(&self, camera: &Camera, point: Vec3) -> Vec3 {
        let at = camera.world_to_camera.transform_point3(point);
        let share = (self.depth / self.inverse_depth - at.z) / (self.inverse_depth * at.z);
        camera.world_to_camera.matrix3.transpose() * (share * at.with_z(0.0))
    }
}

/// Accumulates the normal equations of a frame.
pub(super) struct Equations<'a> {
    posed: &'a Posed,
    /// The camera, where its focal length is unknown.
    perspective: Option<(Perspective, Camera)>,
    /// The body with [`BETA_STEP`] added to each shape coefficient.
    reshaped: Vec<Posed>,
    surface: SurfaceJacobian<'a>,
    jacobian: PointJacobian,
    row: Vec<f64>,
    pub normal: NormalEquations,
}

impl<'a> Equations<'a> {
    /// Equations of a body in the pose `posed` of `shape`; `reshaped` has [`BETA_STEP`] added to
    /// each shape coefficient, `camera` is the frame's. The global unknowns are the shape and,
    /// where given, the perspective.
    pub fn new(
        model: &'a BodyModel,
        (shape, posed): (&'a Shaped, &'a Posed),
        reshaped: Vec<Posed>,
        camera: &Camera,
        perspective: Option<(Perspective, Camera)>,
    ) -> Self {
        let global = reshaped.len() + usize::from(perspective.is_some());
        let normal = NormalEquations::new(3 * (model.num_joints() + 1), global);
        let surface = SurfaceJacobian::new(model, &shape.vertices, posed, camera);
        Self { posed, perspective, reshaped, surface, jacobian: PointJacobian::default(), row: Vec::new(), normal }
    }

    /// Evaluates the Jacobian of a vertex for [`Equations::add`].
    fn at(&mut self, v: usize) {
        self.surface.at(v, &mut self.jacobian);
        self.by_globals(|posed| posed.vertices[v]);
    }

    /// Adds to the Jacobian of a point its derivatives by the global unknowns.
    fn by_globals(&mut self, point: impl Fn(&Posed) -> Vec3) {
        let Self { jacobian, reshaped, posed, perspective, normal, .. } = self;
        for (k, more) in reshaped.iter().enumerate() {
            jacobian.columns.push((normal.per_frame + k) as u32);
            jacobian.directions.push((point(more) - point(posed)) / BETA_STEP);
        }
        if let Some((perspective, camera)) = perspective {
            jacobian.columns.push((normal.per_frame + reshaped.len()) as u32);
            jacobian.directions.push(perspective.derivative(camera, point(posed)));
        }
    }

    /// Adds a residual with its gradients by the vertex position and by a rotation of the surface.
    fn add(&mut self, weight: f32, residual: f32, by_position: Vec3, by_rotation: Vec3) {
        let Self { jacobian, row, normal, .. } = self;
        row.clear();
        row.extend(jacobian.directions.iter().map(|d| f64::from(d.dot(by_position))));
        for (column, turn) in jacobian.rotations() {
            row[column] += f64::from(turn.dot(by_rotation));
        }
        normal.add(f64::from(weight), f64::from(residual), &jacobian.columns, row);
    }

    /// Adds the outline residuals, in clothes that become thicker by `thicker` (V). `unit` is the
    /// length of a metre of a body 1.7 high.
    pub fn add_outline(&mut self, observed: &Observations, thicker: &[f32], unit: f32) {
        // Length of the outline of a body of this area, pixels.
        let around = 3.5 * (observed.area as f32).sqrt();
        let independent = (around / (CORRELATED * observed.edges.len().max(1) as f32)).min(1.0);
        for &Edge { vertex, distance, gradient, scale } in &observed.edges {
            let v = vertex as usize;
            let residual = thicker[v] * scale - distance;
            let noise = OUTLINE[0] + OUTLINE[1] * unit * scale;
            self.at(v);
            let weight = independent * robust(residual * residual, noise) / (noise * noise);
            self.add(weight, residual, gradient, Vec3::ZERO);
        }
    }

    /// Adds the residuals of key points.
    pub fn add_keypoints(&mut self, frame: &FramePoints<'_>, detector: &DetectorModel) {
        for PointResidual { joint, residual, gradients, weight } in detector.residuals(frame) {
            self.surface.fixed(joint, frame.posed.joints[joint], &mut self.jacobian);
            self.by_globals(|posed| posed.joints[joint]);
            let rows = gradients.into_iter().zip(residual.to_array());
            rows.for_each(|(gradient, residual)| self.add(weight, residual, gradient, Vec3::ZERO));
        }
    }

    /// Adds the colour residuals, under a blur of `blur` pixels.
    pub fn add_colors(&mut self, observed: &Observations, colors: &Colors, blur: f32) {
        // Residuals of vertices closer than the blur are correlated.
        let density = observed.colors.len() as f32 / observed.area.max(1) as f32;
        let independent = (4.0 * std::f32::consts::PI * blur * blur * density).max(1.0).recip();
        for (seen, jacobian) in observed.colors.iter().zip(&observed.jacobians) {
            let Some(residual) = colors.residual(seen) else { continue };
            let squared = colors.noise * colors.noise;
            let weight = COLOR * independent * robust(residual.length_squared(), colors.noise) / squared;
            self.at(seen.0 as usize);
            let by_rotation = colors.rotation_jacobian(seen);
            (0..3).for_each(|c| self.add(weight, residual[c], jacobian[c], by_rotation[c]));
        }
    }
}

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
    use glam::{Affine3A, Mat3};
    use proptest::prelude::*;
    use smpl::{BodyModel, Placement};
    use volrender::RandomStream;

    use super::*;

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
