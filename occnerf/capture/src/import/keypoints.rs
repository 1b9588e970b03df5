//! 2-D key points of a detector: OpenPose's folder of JSON, or one array (T, J, 3) of pixels and
//! confidences as ViTPose and RTMPose write it.

use std::path::Path;

use glam::Vec2;
use smpl::{BodyModel, Placement};

use super::file::{array, json};
use super::join;
use super::video::Video;
use super::write::Placed;
use crate::checks::FARTHEST_PIXEL;
use crate::item::Item;
use crate::names::FrameName;
use crate::pictures::listed;
use crate::{CaptureError, Keypoint};

/// Names of the sets of J points, [`point_fit::joint_set`].
const SETS: [(usize, &str); 2] = [(17, "coco17"), (25, "openpose25")];
/// Points of less confidence are dropped.
const LEAST: f32 = 0.3;
/// SMPL's first joint that no set of key points has.
const HANDS: usize = 22;

/// A person in a picture: x, y, confidence of each point.
type Detection = Vec<[f32; 3]>;

/// Gives each frame the key points of the person whose joints project nearest to them; returns what
/// to say of them.
pub(super) fn add(
    path: &Path,
    frames: &mut [Placed],
    betas: &[f64],
    model: &BodyModel,
    video: &Video,
) -> Result<String, CaptureError> {
    let (found, joined) = if path.is_dir() { folder(path, video)? } else { of_array(path, video)? };
    let count = found.iter().flatten().map(Vec::len).next().unwrap_or_default();
    let invalid = |expected: &str, actual: String| CaptureError::invalid(path, "points", expected, actual);
    let set = SETS.iter().find(|(points, _)| *points == count).map(|(_, set)| *set);
    let set = set.ok_or_else(|| invalid("17 (COCO) or 25 (OpenPose) a person", format!("{count}")))?;
    let anchors = point_fit::joint_set(model, set)
        .ok_or_else(|| invalid("a body with SMPL's joints", format!("{} joints", model.num_joints())))?;
    let joint = |anchor: &Option<point_fit::Anchor>| match anchor.as_ref()?.joints[..] {
        [(joint, 1.0)] if joint < HANDS => Some(joint),
        _ => None,
    };
    let joints: Vec<Option<usize>> = anchors.iter().map(joint).collect();
    let shaped = model.shaped(&betas.iter().take(model.num_betas()).map(|beta| *beta as f32).collect::<Vec<_>>());
    let (mut distances, mut with) = (Vec::new(), 0);
    for placed in frames {
        let pose: Vec<_> = placed.pose.iter().map(|v| v.as_vec3()).collect();
        let posed = model.pose(&shaped, &pose, Placement::default());
        let fit = &placed.frame;
        let project = |joint: usize| {
            let at = fit.world_to_camera * posed.joints[joint].as_dvec3() + placed.translation;
            Vec2::new(
                (fit.focal[0] * at.x / at.z + fit.centre[0]) as f32,
                (fit.focal[1] * at.y / at.z + fit.centre[1]) as f32,
            )
        };
        let off = |point: &Keypoint| point.place.distance(project(point.joint));
        let candidates = found[fit.index].iter().map(|person| -> Vec<Keypoint> {
            let points = person.iter().zip(&joints).filter(|([.., confidence], _)| *confidence >= LEAST);
            let point = |(&[x, y, confidence], joint): (&[f32; 3], &Option<usize>)| {
                Some(Keypoint { joint: (*joint)?, place: Vec2::new(x, y), confidence: confidence.min(1.0) })
            };
            points.filter_map(point).collect()
        });
        let mean = |points: &Vec<Keypoint>| points.iter().map(&off).sum::<f32>() / points.len() as f32;
        let nearest = candidates.filter(|points| !points.is_empty()).min_by(|a, b| mean(a).total_cmp(&mean(b)));
        placed.keypoints = nearest.unwrap_or_default();
        with += usize::from(!placed.keypoints.is_empty());
        distances.extend(placed.keypoints.iter().map(off));
    }
    if distances.is_empty() {
        return Err(invalid("a person in a frame with a fit", "none of enough confidence".to_owned()));
    }
    let middle = distances.len() / 2;
    let median = *distances.select_nth_unstable_by(middle, f32::total_cmp).1;
    let joined = joined.map_or(String::new(), |note| format!("; {note}"));
    Ok(format!("key points: {set} in {with} frames, {median:.1} px from the fit's joints in the median{joined}"))
}

/// People of each frame of the video, and how they were joined with it.
type Found = (Vec<Vec<Detection>>, Option<String>);

/// OpenPose's `NAME_keypoints.json`, one a picture.
fn folder(path: &Path, video: &Video) -> Result<Found, CaptureError> {
    let name = |name: String| name.strip_suffix("_keypoints").map(str::to_owned).unwrap_or(name);
    let mut files: Vec<_> = listed(path, &["json"])?.into_iter().map(|(stem, file)| (name(stem), file)).collect();
    files.sort_by(|a, b| FrameName(&a.0).cmp(&FrameName(&b.0)));
    let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
    let expected = || format!("NAME_keypoints.json of pictures, as {}", video.names[0]);
    if names.is_empty() {
        return Err(CaptureError::invalid(path, "files", expected(), "no .json"));
    }
    let joined = join::by_name(video, &names)
        .map_err(|_| CaptureError::invalid(path, "files", expected(), format!("{} and others", names[0])))?;
    let mut found = vec![Vec::new(); video.names.len()];
    for ((_, file), at) in files.iter().zip(&joined.at) {
        let Some(at) = *at else { continue };
        let value = json(file)?;
        for person in Item::new(file, &value).get("people")?.list()? {
            let points = person.get("pose_keypoints_2d")?;
            found[at].push(detection(file, &points.key, &points.floats(&[None])?)?);
        }
    }
    Ok((found, joined.note))
}

/// An array (T, J, 3) of one person, also as PyTorch saves it.
fn of_array(path: &Path, video: &Video) -> Result<Found, CaptureError> {
    let expected = format!("shape [{}, points, 3], one person of the video's frames", video.names.len());
    let array = array(path, &expected, |shape| matches!(shape, [_, _, 3]))?;
    let frames = array.shape[0];
    let joined = join::by_index(video, &(0..frames).collect());
    let joined = joined.ok_or_else(|| CaptureError::invalid(path, "the file", expected, format!("{frames} frames")))?;
    let values: Vec<f32> = array.to_f64().into_iter().map(|v| v as f32).collect();
    let mut found = vec![Vec::new(); video.names.len()];
    for (row, at) in values.chunks_exact((3 * array.shape[1]).max(1)).zip(&joined.at) {
        if let Some(at) = *at {
            found[at] = vec![detection(path, "the array", row)?];
        }
    }
    Ok((found, joined.note))
}

/// Finite pixels and confidences of at least 0.
fn detection(path: &Path, key: &str, values: &[f32]) -> Result<Detection, CaptureError> {
    let (points, rest) = values.as_chunks::<3>();
    // False for NaN.
    let is_near = |x: &f32| x.abs() < FARTHEST_PIXEL;
    let is_point = |[x, y, c]: &[f32; 3]| is_near(x) && is_near(y) && *c >= 0.0 && c.is_finite();
    match points.iter().find(|point| !is_point(point)) {
        None if rest.is_empty() => Ok(points.to_vec()),
        fault => {
            let found = fault.map_or(format!("{} numbers", values.len()), |point| format!("{point:?}"));
            Err(CaptureError::invalid(path, key, "x and y in pixels and a confidence of each point", found))
        }
    }
}
