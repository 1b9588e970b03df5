//! Consistency of body model, cameras and pictures.

use std::path::Path;

use glam::{Vec2, Vec3};
use smpl::{BodyModel, Placement};

use super::camera::MAX_DISTANCE;
use super::item::Item;
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

/// A body as a file poses it.
#[derive(Clone)]
pub(super) struct Fitted {
    pub pose: Vec<Vec3>,
    pub placement: Placement,
    pub betas: Vec<f32>,
}

/// Errors for a value above `most` in magnitude.
fn below(item: &Item<'_>, values: &[f32], most: f32) -> Result<(), CaptureError> {
    match values.iter().find(|value| value.abs() > most) {
        Some(value) => Err(item.invalid(format!("numbers up to {most} either way"), value.to_string())),
        None => Ok(()),
    }
}

/// Shape coefficients under `key`, at most as many as the model's.
pub(super) fn betas(record: &Item<'_>, key: &str, body: &BodyModel) -> Result<Vec<f32>, CaptureError> {
    let item = record.get(key)?;
    let values = item.floats(&[None])?;
    if values.len() > body.num_betas() || values.is_empty() && body.num_betas() > 0 {
        let expected = match body.num_betas() {
            0 => "no numbers: the body model has one shape only".to_owned(),
            most => format!("1 to {most} numbers, as the body model has"),
        };
        return Err(item.invalid(expected, format!("shape [{}]", values.len())));
    }
    below(&item, &values, MAX_BETA)?;
    Ok(values)
}

/// The rotation of every joint, (3J) or (J,3) under `poses`.
pub(super) fn pose(record: &Item<'_>, body: &BodyModel) -> Result<Vec<Vec3>, CaptureError> {
    let (item, joints) = (record.get("poses")?, body.num_joints());
    let shape = item.values()?.0;
    let values =
        if shape.ends_with(&[joints, 3]) { item.floats(&[Some(joints), Some(3)]) } else { item.floats(&[None]) }?;
    below(&item, &values, MAX_ANGLE)?;
    if values.len() != 3 * joints {
        let expected = format!("shape [{}], 3 for each of the body model's {joints} joints", 3 * joints);
        return Err(item.invalid(expected, format!("shape {shape:?}")));
    }
    Ok(triples(&values))
}

/// Detected joints, (N,4) under `keypoints`; none without the key.
pub(super) fn keypoints(record: &Item<'_>, body: &BodyModel) -> Result<Vec<Keypoint>, CaptureError> {
    let Some(item) = record.find("keypoints") else { return Ok(Vec::new()) };
    let (shape, values) = item.values()?;
    if values.is_empty() {
        return Ok(Vec::new());
    }
    if shape.len() != 2 || shape[1] != 4 {
        return Err(item.invalid("shape [N, 4]: joint, x, y, confidence", format!("shape {shape:?}")));
    }
    if record.find("distortions").is_some() {
        return Err(item.invalid("none beside `distortions`", "key points of a distorted picture"));
    }
    let joints = body.num_joints();
    let point = |row: &[f64]| {
        let [joint, x, y, confidence] = [row[0], row[1], row[2], row[3]].map(|value| value as f32);
        let is_joint = joint >= 0.0 && joint.fract() == 0.0 && (joint as usize) < joints;
        let is_near = x.abs().max(y.abs()) < FARTHEST_PIXEL;
        if !(is_joint && is_near && (0.0..=1.0).contains(&confidence)) {
            let expected = format!("a joint below {joints}, a pixel, a confidence of 0 to 1");
            return Err(item.invalid(expected, format!("{row:?}")));
        }
        Ok(Keypoint { joint: joint as usize, place: Vec2::new(x, y), confidence })
    };
    values.chunks_exact(4).map(point).collect()
}

/// A body in ZJU-MoCap's way: `poses` with a zero root, rotation `Rh` and translation `Th` about
/// the origin, and shape coefficients under `key`.
pub(super) fn about_origin(record: &Item<'_>, key: &str, body: &BodyModel) -> Result<Fitted, CaptureError> {
    let vector = |key: &str, most: f32| {
        let item = record.get(key)?;
        let values = item.floats(&[Some(3)])?;
        below(&item, &values, most).map(|()| Vec3::from_slice(&values))
    };
    let pose = pose(record, body)?;
    if let Some(root) = pose.first().filter(|root| **root != Vec3::ZERO) {
        let expected = "a zero root (the global rotation is Rh)";
        return Err(record.get("poses")?.invalid(expected, format!("{root} for joint 0")));
    }
    let placement = Placement::Origin { rotation: vector("Rh", MAX_ANGLE)?, translation: vector("Th", MAX_DISTANCE)? };
    Ok(Fitted { pose, placement, betas: betas(record, key, body)? })
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
pub(super) fn joints(record: &Item<'_>, key: &str, betas: &[f32], body: &BodyModel) -> Result<(), CaptureError> {
    let item = record.get(key)?;
    let expected = item.floats(&[Some(body.num_joints()), Some(3)])?;
    let shaped = body.shaped(betas);
    same(&item, "joint", &shaped.joints, &triples(&expected), JOINT_TOLERANCE * extent(&shaped.vertices))
}

/// Largest side of the points' box.
pub(super) fn extent(points: &[Vec3]) -> f32 {
    let low = points.iter().copied().fold(Vec3::INFINITY, Vec3::min);
    let high = points.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
    (high - low).max_element()
}

/// Errors unless the model's points, each `what`, are those of the file.
pub(super) fn same(
    item: &Item<'_>,
    what: &str,
    model: &[Vec3],
    file: &[Vec3],
    tolerance: f32,
) -> Result<(), CaptureError> {
    for (i, (model, file)) in model.iter().zip(file).enumerate() {
        let distance = model.distance(*file);
        if distance.is_nan() || distance > tolerance {
            let expected = format!(
                "the body model's within {tolerance:.3} (is it the model that the capture was fitted with, and are \
                 files numbered as the frames are?)"
            );
            return Err(item.invalid(expected, format!("{what} {i} at {file}, {distance:.3} from the model's")));
        }
    }
    Ok(())
}

/// Groups of three numbers.
pub(super) fn triples(values: &[f32]) -> Vec<Vec3> {
    values.chunks_exact(3).map(Vec3::from_slice).collect()
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
