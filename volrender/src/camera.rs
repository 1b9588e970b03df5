use glam::{Affine3A, Mat3, Vec2, Vec3};

use crate::distortion::Distortion;
use crate::ray::Ray;

/// A pinhole camera in OpenCV's convention: x right, y down, z forward.
///
/// ```
/// use glam::{Affine3A, Mat3, Vec3};
/// use volrender::Camera;
///
/// // fx, fy 80; cx 32, cy 24; two metres in front of the origin.
/// let intrinsics = Mat3::from_cols_array(&[80.0, 0.0, 0.0, 0.0, 80.0, 0.0, 32.0, 24.0, 1.0]);
/// let camera = Camera::new(intrinsics, Affine3A::from_translation(Vec3::Z * 2.0), 64, 48)?;
/// assert_eq!(camera.centre_of_projection(), Vec3::Z * -2.0);
/// assert_eq!(camera.ray(32.0, 24.0).direction, Vec3::Z);
/// assert_eq!(camera.project(Vec3::X), Some(Vec3::new(72.0, 24.0, 2.0))); // pixel and depth
/// # Ok::<(), volrender::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Focal lengths in pixels.
    pub focal: Vec2,
    /// Principal point in pixels; (0, 0) is the outer corner of the top left pixel.
    pub centre: Vec2,
    /// Extrinsics, world to camera.
    pub world_to_camera: Affine3A,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
}

/// Invalid camera parameters, or an image too small for a metric.
///
/// ```
/// let small = volrender::metrics::ssim(&[0.5; 75], &[0.5; 75], 5, 5).unwrap_err();
/// assert_eq!(small.to_string(), "an image of 5×5 pixels is smaller than 7×7");
/// ```
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct Error(String);

impl Error {
    pub(crate) fn image_size(width: usize, height: usize, least: usize) -> Self {
        Self(format!("an image of {width}×{height} pixels is smaller than {least}×{least}"))
    }
}

/// Skew relative to the focal length that is tolerated as rounding of a calibration file.
const SKEW: f32 = 1e-5;

impl Camera {
    /// A camera from a 3×3 calibration matrix and extrinsics that map world to camera.
    ///
    /// # Errors
    /// Skewed or otherwise invalid intrinsics, extrinsics that are not finite or not invertible, an
    /// image without pixels. Scaled and not quite orthonormal rotations are accepted: rays stay
    /// exact and of unit length, the depth of [`Camera::project`] is in the camera's unit.
    pub fn new(intrinsics: Mat3, world_to_camera: Affine3A, width: u32, height: u32) -> Result<Self, Error> {
        let k = intrinsics;
        let focal = Vec2::new(k.x_axis.x, k.y_axis.y);
        let usual = k.is_finite()
            && focal.min_element() > 0.0
            && k.y_axis.x.abs() <= SKEW * focal.x
            && k.x_axis.y.abs() <= SKEW * focal.y
            && k.x_axis.z == 0.0
            && k.y_axis.z == 0.0
            && (k.z_axis.z - 1.0).abs() <= SKEW;
        if !usual {
            let message = format!("intrinsics {k} are not [fx 0 cx; 0 fy cy; 0 0 1] with positive focal lengths");
            return Err(Error(message));
        }
        let inverse = world_to_camera.inverse();
        if !world_to_camera.is_finite() || world_to_camera.matrix3.determinant() == 0.0 || !inverse.is_finite() {
            return Err(Error(format!("extrinsics {world_to_camera} are not finite and invertible")));
        }
        if width == 0 || height == 0 {
            return Err(Error::image_size(width as usize, height as usize, 1));
        }
        Ok(Self { focal, centre: Vec2::new(k.z_axis.x, k.z_axis.y), world_to_camera, width, height })
    }

    /// The calibration matrix.
    pub fn intrinsics(&self) -> Mat3 {
        Mat3::from_cols(Vec3::new(self.focal.x, 0.0, 0.0), Vec3::new(0.0, self.focal.y, 0.0), self.centre.extend(1.0))
    }

    /// Centre of projection in the world.
    pub fn centre_of_projection(&self) -> Vec3 {
        self.world_to_camera.inverse().translation.into()
    }

    /// The ray through image position (`u`, `v`) in pixels. The centre of pixel (column, row) is
    /// (column + 0.5, row + 0.5).
    pub fn ray(&self, u: f32, v: f32) -> Ray {
        let camera_to_world = self.world_to_camera.inverse();
        let p = (Vec2::new(u, v) - self.centre) / self.focal;
        let direction: Vec3 = camera_to_world.transform_vector3(p.extend(1.0));
        Ray { origin: camera_to_world.translation.into(), direction: direction.normalize_or_zero() }
    }

    /// Pixel coordinates and depth (u, v, z) of a world point, inside the image or not. `None` if
    /// it is not in front of the camera or the result is not finite.
    pub fn project(&self, x: Vec3) -> Option<Vec3> {
        let p = self.world_to_camera.transform_point3(x);
        if p.z.is_nan() || p.z <= 0.0 {
            return None;
        }
        let pixel = self.focal * (p.truncate() / p.z) + self.centre;
        let projected = pixel.extend(p.z);
        projected.is_finite().then_some(projected)
    }

    /// The camera of the image resized to `width` × `height` pixels (each at least 1).
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        let scale = Vec2::new(width as f32 / self.width as f32, height as f32 / self.height as f32);
        Self { focal: self.focal * scale, centre: self.centre * scale, width, height, ..*self }
    }

    /// Position in the distorted image of `pixel` in the undistorted one: the lookup that
    /// undistorts an image.
    pub fn distort_pixel(&self, distortion: &Distortion, pixel: Vec2) -> Vec2 {
        let p = (pixel - self.centre) / self.focal;
        self.focal * distortion.distort(p) + self.centre
    }
}
