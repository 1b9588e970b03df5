use glam::{Affine3A, Mat3, Vec2, Vec3};

use crate::distortion::Distortion;
use crate::ray::Ray;

/// A pinhole camera in OpenCV's convention: x right, y down, z forward.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Focal lengths in pixels.
    pub focal: Vec2,
    /// Principal point in pixels; (0, 0) is the outer corner of the first pixel.
    pub centre: Vec2,
    /// Extrinsics.
    pub world_to_camera: Affine3A,
    /// Pixels a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Why a camera or a metric cannot be had.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The intrinsics are not a matrix of the form \[fx 0 cx; 0 fy cy; 0 0 1\] with positive,
    /// finite focal lengths.
    #[error("intrinsics {0} are not [fx 0 cx; 0 fy cy; 0 0 1] with positive focal lengths")]
    Intrinsics(Mat3),
    /// Values that are not finite, or a linear part that cannot be inverted.
    #[error("extrinsics {0} are not finite and invertible")]
    Extrinsics(Affine3A),
    /// An image without pixels, or one smaller than a metric's window.
    #[error("an image of {width}×{height} pixels is smaller than {least}×{least}")]
    ImageSize {
        /// Pixels a row.
        width: usize,
        /// Rows.
        height: usize,
        /// Smallest side allowed.
        least: usize,
    },
}

/// Skew, relative to the focal length, below which it is rounding of a calibration file.
const SKEW: f32 = 1e-5;

impl Camera {
    /// A camera from a 3×3 calibration matrix and extrinsics that map world to camera.
    ///
    /// # Errors
    /// Skewed or otherwise unusual intrinsics, extrinsics that are not finite or not invertible, no
    /// pixels. A rotation that is not quite orthonormal, or scaled, is accepted: rays stay exact
    /// and of unit length, the depth of [`Camera::project`] is then in the camera's unit.
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
            return Err(Error::Intrinsics(k));
        }
        let inverse = world_to_camera.inverse();
        if !world_to_camera.is_finite() || world_to_camera.matrix3.determinant() == 0.0 || !inverse.is_finite() {
            return Err(Error::Extrinsics(world_to_camera));
        }
        if width == 0 || height == 0 {
            return Err(Error::ImageSize { width: width as usize, height: height as usize, least: 1 });
        }
        Ok(Self { focal, centre: Vec2::new(k.z_axis.x, k.z_axis.y), world_to_camera, width, height })
    }

    /// The calibration matrix.
    #[must_use]
    pub fn intrinsics(&self) -> Mat3 {
        Mat3::from_cols(Vec3::new(self.focal.x, 0.0, 0.0), Vec3::new(0.0, self.focal.y, 0.0), self.centre.extend(1.0))
    }

    /// Position of the camera in the world.
    #[must_use]
    pub fn centre_of_projection(&self) -> Vec3 {
        self.world_to_camera.inverse().translation.into()
    }

    /// The ray through image position (`u`, `v`) in pixels. The centre of pixel (column, row) is
    /// (column + 0.5, row + 0.5).
    #[must_use]
    pub fn ray(&self, u: f32, v: f32) -> Ray {
        let camera_to_world = self.world_to_camera.inverse();
        let p = (Vec2::new(u, v) - self.centre) / self.focal;
        let direction: Vec3 = camera_to_world.transform_vector3(p.extend(1.0));
        Ray { origin: camera_to_world.translation.into(), direction: direction.normalize_or_zero() }
    }

    /// Image position and depth (u, v, z) of a point of the world, whether inside the image or not.
    /// `None` where it is not in front of the camera, or the result is not finite.
    #[must_use]
    pub fn project(&self, x: Vec3) -> Option<Vec3> {
        let p = self.world_to_camera.transform_point3(x);
        if p.z.is_nan() || p.z <= 0.0 {
            return None;
        }
        let pixel = self.focal * (p.truncate() / p.z) + self.centre;
        let projected = pixel.extend(p.z);
        projected.is_finite().then_some(projected)
    }

    /// The camera of the same picture scaled to `width` × `height` pixels (each at least 1).
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        let scale = Vec2::new(width as f32 / self.width as f32, height as f32 / self.height as f32);
        Self { focal: self.focal * scale, centre: self.centre * scale, width, height, ..*self }
    }

    /// The pixel where a lens with `distortion` puts what a perfect lens puts at `pixel`: read a
    /// distorted photograph here to fill `pixel` of the undistorted one.
    #[must_use]
    pub fn distort_pixel(&self, distortion: &Distortion, pixel: Vec2) -> Vec2 {
        let p = (pixel - self.centre) / self.focal;
        self.focal * distortion.distort(p) + self.centre
    }
}
