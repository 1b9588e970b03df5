//! Consistency of body model, cameras and pictures.

use std::path::Path;

use glam::{Vec2, Vec3};
use smpl::{BodyModel, Placement};

use super::camera::MAX_DISTANCE;
use super::records::{Record, triples};
use super::{CaptureError, Frame, Keypoint};

/// Tolerance of a joint against the file's, as a fraction of the body's largest extent: 4 cm at
/// 1.7 m. The same model agrees to rounding, others are several times as far off.
const JOINT_TOLERANCE: f32 = 0.04 / 1.7;

/// Largest coordinate of a key point.
pub(super) const FARTHEST_PIXEL: f32 = 1e5;
/// Largest component of a rotation, radians.
pub(super) const MAX_ANGLE: f32 = 1e3;
/// Largest shape coefficient, in standard deviations.
pub const MAX_BETA: f32 = 1e3;

/// Errors for a value above `most` in magnitude.
pub(super) fn below(record: &Record<'_>, key: &str, values: &[f32], most: f32) -> Result<(), CaptureError> {
    match values.iter().find(|value| value.abs() > most) {
        Some(value) => Err(record.invalid(key, format!("numbers up to {most} either way"), value.to_string())),
        None => Ok(()),
    }
}

/// Shape coefficients, at most as many as the model's.
pub(super) fn betas(record: &Record<'_>, key: &str, body: &BodyModel) -> Result<Vec<f32>, CaptureError> {
    let (shape, values) = record.array(key)?;
    if shape.len() != 1 || values.len() > body.num_betas() || values.is_empty() && body.num_betas() > 0 {
        let expected = match body.num_betas() {
            0 => "no numbers: the body model has one shape only".to_owned(),
            most => format!("1 to {most} numbers, as the body model has"),
        };
        return Err(record.invalid(key, expected, format!("shape {shape:?}")));
    }
    below(record, key, &values, MAX_BETA)?;
    Ok(values)
}

/// The rotation of every joint, (3J) or (J,3) under `poses`.
pub(super) fn pose(record: &Record<'_>, body: &BodyModel) -> Result<Vec<Vec3>, CaptureError> {
    let joints = body.num_joints();
    let (shape, values) = record.array("poses")?;
    below(record, "poses", &values, MAX_ANGLE)?;
    if shape != [3 * joints] && shape != [joints, 3] {
        let expected = format!("shape [{}], 3 for each of the body model's {joints} joints", 3 * joints);
        return Err(record.invalid("poses", expected, format!("shape {shape:?}")));
    }
    Ok(triples(&values))
}

/// Detected joints, (N,4) under `keypoints`; none without the key.
pub(super) fn keypoints(record: &Record<'_>, body: &BodyModel) -> Result<Vec<Keypoint>, CaptureError> {
    const KEY: &str = "keypoints";
    if !record.has(KEY) {
        return Ok(Vec::new());
    }
    let (shape, values) = record.stacked(KEY)?;
    if values.is_empty() {
        return Ok(Vec::new());
    }
    if shape.len() != 2 || shape[1] != 4 {
        return Err(record.invalid(KEY, "shape [N, 4]: joint, x, y, confidence", format!("shape {shape:?}")));
    }
    if record.has("distortions") {
        return Err(record.invalid(KEY, "none beside `distortions`", "key points of a distorted picture"));
    }
    let joints = body.num_joints();
    let point = |row: &[f32]| {
        let [joint, x, y, confidence] = [row[0], row[1], row[2], row[3]];
        let is_joint = joint >= 0.0 && joint.fract() == 0.0 && (joint as usize) < joints;
        let is_near = x.abs().max(y.abs()) < FARTHEST_PIXEL;
        if !(is_joint && is_near && (0.0..=1.0).contains(&confidence)) {
            let expected = format!("a joint below {joints}, a pixel, a confidence of 0 to 1");
            return Err(record.invalid(KEY, expected, format!("{row:?}")));
        }
        Ok(Keypoint { joint: joint as usize, place: Vec2::new(x, y), confidence })
    };
    values.chunks_exact(4).map(point).collect()
}

/// [`pose`] with a zero root, for a separate global rotation.
pub(super) fn rootless_pose(record: &Record<'_>, body: &BodyModel) -> Result<Vec<Vec3>, CaptureError> {
    let pose = pose(record, body)?;
    if let Some(root) = pose.first().filter(|root| **root != Vec3::ZERO) {
        let expected = "a zero root (the global rotation is Rh)";
        return Err(record.invalid("poses", expected, format!("{root} for joint 0")));
    }
    Ok(pose)
}

/// ZJU-MoCap's way of placing a body: rotation `Rh` and translation `Th` about the origin.
pub(super) fn origin(record: &Record<'_>) -> Result<Placement, CaptureError> {
    let (rotation, translation) = (record.vec3("Rh")?, record.vec3("Th")?);
    below(record, "Rh", &rotation.to_array(), MAX_ANGLE)?;
    below(record, "Th", &translation.to_array(), MAX_DISTANCE)?;
    Ok(Placement::Origin { rotation, translation })
}

/// Mean shape coefficients of all frames, missing ones being 0.
pub(super) fn mean_betas<'a>(frames: impl ExactSizeIterator<Item = &'a [f32]>) -> Vec<f32> {
    let count = frames.len() as f64;
    let mut sums = Vec::new();
    for betas in frames {
        sums.resize(sums.len().max(betas.len()), 0.0f64);
        sums.iter_mut().zip(betas).for_each(|(sum, &beta)| *sum += f64::from(beta));
    }
    sums.iter().map(|sum| (sum / count) as f32).collect()
}

/// Compares the T-pose joints under `key` with those of `body` for `betas`.
pub(super) fn joints(record: &Record<'_>, key: &str, betas: &[f32], body: &BodyModel) -> Result<(), CaptureError> {
    let why = ": the body model's joints (is it the model that the capture was fitted with?)";
    let expected = triples(&record.shaped(key, &[body.num_joints(), 3], why)?);
    let shaped = body.shaped(betas);
    let low = shaped.vertices.iter().copied().fold(Vec3::INFINITY, Vec3::min);
    let high = shaped.vertices.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
    let tolerance = JOINT_TOLERANCE * (high - low).max_element();
    for (joint, (model, file)) in shaped.joints.iter().zip(&expected).enumerate() {
        let distance = model.distance(*file);
        if distance > tolerance {
            return Err(record.invalid(
                key,
                format!(
                    "the body model's joints for these betas within {tolerance:.3} (is it the model that the \
                     capture was fitted with?)"
                ),
                format!("joint {joint} at {file}, {distance:.3} from the model's"),
            ));
        }
    }
    Ok(())
}

/// At least one mask shows the subject. `dir` holds the masks.
pub(super) fn subject_is_seen(dir: &Path, frames: &[Frame]) -> Result<(), CaptureError> {
    let mut brightest = 0.0f32;
    // The first frame nearly always decides.
    for frame in frames {
        brightest = frame.pixels()?.mask.iter().copied().fold(brightest, f32::max);
        if brightest > 0.5 {
            return Ok(());
        }
    }
    Err(CaptureError::invalid(
        dir,
        "all masks",
        "a subject pixel (value above 127 of 255) in at least one frame",
        format!("none in {} frames, the largest value is {}", frames.len(), brightest * 255.0),
    ))
}

/// At least one frame has a vertex of the posed body in its image. `path` holds the cameras.
pub(super) fn body_is_seen(path: &Path, frames: &[Frame], body: &BodyModel) -> Result<(), CaptureError> {
    let sees = |frame: &Frame| {
        let shaped = body.shaped(&frame.betas);
        let posed = body.pose(&shaped, &frame.pose, frame.placement);
        let camera = &frame.camera;
        posed.vertices.iter().any(|&v| {
            camera.project(v).is_some_and(|p| {
                let inside = |x: f32, size: u32| x >= 0.0 && x <= size as f32;
                inside(p.x, camera.width) && inside(p.y, camera.height)
            })
        })
    };
    // The first frame nearly always decides.
    if frames.iter().any(sees) {
        return Ok(());
    }
    Err(CaptureError::invalid(
        path,
        "all extrinsics",
        "a camera that sees the posed body in at least one frame",
        format!("no vertex of the body inside the image in any of {} frames", frames.len()),
    ))
}
