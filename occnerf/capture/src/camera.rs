//! Cameras from the matrices that captures hold.

use glam::{Affine3A, Mat3, Vec3};
use volrender::{Camera, Distortion};

use super::CaptureError;
use super::records::Record;

/// Largest distance of a body or a camera from the origin, in the capture's unit.
pub const MAX_DISTANCE: f32 = 1e7;
/// Largest |R Rᵀ − I| of an extrinsic rotation, far above rounding.
const ORTHONORMAL: f32 = 1e-3;
/// Range of focal lengths, pixels.
const FOCAL: (f32, f32) = (0.01, 1e7);

/// A camera with lens distortion. Its image is 1 × 1 until the picture has been read.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens {
    pub camera: Camera,
    pub distortion: Distortion,
}

/// The three numbers of row `i` of a matrix with `columns` columns.
fn row(values: &[f32], columns: usize, i: usize) -> Vec3 {
    Vec3::from_slice(&values[columns * i..])
}

/// A rotation from 3 rows of `columns` values each; `None` unless it is one.
pub(super) fn rotation(values: &[f32], columns: usize) -> Option<Mat3> {
    let row = |i| row(values, columns, i);
    let rotation = Mat3::from_cols(row(0), row(1), row(2)).transpose();
    let product = (rotation * rotation.transpose() - Mat3::IDENTITY).to_cols_array();
    let skewed = product.iter().any(|x| x.abs() > ORTHONORMAL) || rotation.determinant() < 0.0;
    (!skewed).then_some(rotation)
}

/// A camera from a row-major calibration matrix (9) that puts the first pixel's centre at
/// `pixel_centre`; the error describes the fault.
pub(super) fn pinhole(k: &[f32], extrinsics: Affine3A, pixel_centre: f32) -> Result<Camera, String> {
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
    Camera::new(intrinsics, extrinsics, 1, 1).map_err(|error| error.to_string())
}

impl Lens {
    /// From a 3×3 matrix under `k`, a 3×4 or 4×4 one under `e`, and five numbers under
    /// `distortions` if there are any.
    pub fn read(record: &Record<'_>, k: &str, e: &str, pixel_centre: f32) -> Result<Self, CaptureError> {
        let intrinsics = record.shaped(k, &[3, 3], "")?;
        let (shape, values) = record.array(e)?;
        if shape != [4, 4] && shape != [3, 4] {
            return Err(record.invalid(e, "shape [4, 4]", format!("shape {shape:?}")));
        }
        let last = values.get(12..).unwrap_or_default();
        let rotation = rotation(&values, 4).filter(|_| last.is_empty() || last == [0.0, 0.0, 0.0, 1.0]);
        let rotation = rotation.ok_or_else(|| {
            let expected = "a rotation and a translation, with a last row of 0 0 0 1";
            record.invalid(e, expected, format!("{values:?}"))
        })?;
        let translation = Vec3::new(values[3], values[7], values[11]);
        let camera = pinhole(&intrinsics, Affine3A::from_mat3_translation(rotation, translation), pixel_centre)
            .map_err(|error| record.invalid(k, "a pinhole camera", error))?;

        let mut distortion = Distortion::default();
        if record.has("distortions") {
            let (shape, d) = record.array("distortions")?;
            let five: [f32; 5] = d
                .try_into()
                .map_err(|_| record.invalid("distortions", "5 numbers (k1 k2 p1 p2 k3)", format!("shape {shape:?}")))?;
            distortion = Distortion::from_opencv(five);
        }
        Ok(Self { camera, distortion })
    }
}
