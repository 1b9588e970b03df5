//! Cameras from the matrices that captures hold.

use glam::{Affine3A, Mat3, Vec3};
use volrender::{Camera, Distortion};

use super::CaptureError;
use super::item::Item;

/// Largest distance of a body or a camera from the origin, in the capture's unit.
pub const MAX_DISTANCE: f32 = 1e7;
/// Largest |R Rᵀ − I| of an extrinsic rotation, far above rounding.
pub(super) const ORTHONORMAL: f64 = 1e-3;
/// Range of focal lengths, pixels.
const FOCAL: (f32, f32) = (0.01, 1e7);

/// A camera with lens distortion. Its image is 1 × 1 until the picture has been read.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens {
    pub camera: Camera,
    pub distortion: Distortion,
}

impl Lens {
    /// From a row-major calibration matrix (9) that puts the first pixel's centre at
    /// `pixel_centre`, and k1 k2 p1 p2 k3; the error describes the fault.
    pub fn new(k: &[f32], extrinsics: Affine3A, d: [f32; 5], pixel_centre: f32) -> Result<Self, String> {
        let mut intrinsics = Mat3::from_cols_slice(k).transpose();
        let focal = k[0].min(k[4])..=k[0].max(k[4]);
        if *focal.start() < FOCAL.0 || *focal.end() > FOCAL.1 {
            return Err(format!("focal lengths of {} and {} pixels, expected {} to {}", k[0], k[4], FOCAL.0, FOCAL.1));
        }
        if k[2].abs().max(k[5].abs()) > FOCAL.1 {
            return Err(format!("a principal point at {} {}, expected at most {} either way", k[2], k[5], FOCAL.1));
        }
        if extrinsics.translation.abs().max_element() > MAX_DISTANCE {
            let expected = format!("expected at most {MAX_DISTANCE} either way");
            return Err(format!("a translation of {}, {expected}", extrinsics.translation));
        }
        // `Camera` has the first pixel's centre at 0.5.
        intrinsics.z_axis += Vec3::new(1.0, 1.0, 0.0) * (0.5 - pixel_centre);
        let camera = Camera::new(intrinsics, extrinsics, 1, 1).map_err(|error| error.to_string())?;
        Ok(Self { camera, distortion: Distortion::from_opencv(d) })
    }

    /// From a 3×3 matrix under `k`, a 3×4 or 4×4 one under `e`, and five numbers under
    /// `distortions` if there are any.
    pub fn read(record: &Item<'_>, k: &str, e: &str, pixel_centre: f32) -> Result<Self, CaptureError> {
        let (k, e) = (record.get(k)?, record.get(e)?);
        let (intrinsics, values) = (k.floats(&[Some(3), Some(3)])?, e.numbers(&[None, Some(4)])?);
        // Products of matrices end in numbers that are 0 and 1 in single precision.
        let last: Option<Vec<f32>> = values.get(12..).map(|row| row.iter().map(|value| *value as f32).collect());
        if !matches!(last.as_deref(), Some([] | [0.0, 0.0, 0.0, 1.0])) {
            let expected = "a rotation and a translation, with a last row of 0 0 0 1";
            return Err(e.invalid(expected, format!("{values:?}")));
        }
        let (turn, moved) = e.rigid(&values, ORTHONORMAL)?;
        let extrinsics = Affine3A::from_mat3_translation(turn.as_mat3(), moved.as_vec3());
        let mut d = [0.0; 5];
        if let Some(item) = record.find("distortions") {
            let values = item.floats(&[None])?;
            let five = || item.invalid("5 numbers (k1 k2 p1 p2 k3)", format!("{values:?}"));
            d = values.as_slice().try_into().map_err(|_| five())?;
        }
        Self::new(&intrinsics, extrinsics, d, pixel_centre).map_err(|error| k.invalid("a pinhole camera", error))
    }
}
