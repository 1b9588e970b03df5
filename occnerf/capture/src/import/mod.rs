//! Import of the results of body estimators and segmenters.
//!
//! [`import`] reads the frames of a video, a fit and masks, and writes a capture in HumanNeRF's
//! wild layout for [`super::load_capture`]. Formats are detected by content:
//!
//! - fits: WHAM, 4D-Humans / PHALP, GVHMR, PromptHMR, VIBE / PyMAF, CLIFF, GLAMR, ROMP, EasyMocap,
//!   and the data sets PeopleSnapshot (also as GaussianAvatar has it) and NeuMan ([`Tool`]);
//! - points, to which a body is fitted: SAM 3D Body, and arrays of joints of any estimator;
//! - masks: object ids (SAM 2's palette PNGs or folders, Grounded-SAM-2's `.npy`), coverage
//!   (MatAnyone, plain 0/255 pictures), or the fit's own (4D-Humans / PHALP, PromptHMR);
//! - 2-D key points: OpenPose's folder, or an array (T, J, 3).
//!
//! Estimators place the body in camera space for an assumed focal length. The capture's world has
//! the camera's axes, or those of the file's cameras; the body's translation is in the extrinsics.

mod body;
#[cfg(test)]
mod damage;
mod datasets;
mod easymocap;
mod file;
mod fit;
mod join;
mod keypoints;
#[cfg(test)]
mod keypoints_tests;
mod masks;
mod options;
mod points;
#[cfg(test)]
mod points_tests;
mod read;
mod rle;
mod sam3d;
#[cfg(test)]
mod tests;
mod tools;
#[cfg(test)]
mod tools_tests;
mod video;
mod write;

pub use self::fit::Tool;

use std::path::{Path, PathBuf};

use glam::DVec3;
use smpl::BodyModel;

use self::fit::{BETAS, FitFrame, Person, SHARED, SMPLX};
pub use self::options::ImportOptions;

use self::masks::Masks;
use self::video::Video;
use self::write::Placed;
use super::CaptureError;
use crate::image::has_profile;

/// Statistics of an import.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    /// The estimator of the fit.
    pub tool: Tool,
    /// The person's id.
    pub person: String,
    /// Frames of the capture.
    pub frames: usize,
    /// Ids and numbers of frames of the other people.
    pub others: Vec<(String, usize)>,
    /// Frames of the video.
    pub video_frames: usize,
    /// Frames before the person's first, after the last, and between without a fit.
    pub unfitted: [usize; 3],
    /// Frames with a stale fit of an earlier frame.
    pub ghosts: usize,
    /// Frames with a fit but without a mask.
    pub unmasked: usize,
    /// Frames with a fit but without a picture.
    pub absent: usize,
    /// What a user should know: gaps of the pictures, and what was joined other than by name.
    pub notes: Vec<String>,
    /// Largest standard deviation of a shape coefficient over the frames; the capture has the
    /// robust mean.
    pub betas_spread: f64,
    /// Focal length in pixels of the first frame.
    pub focal: f64,
    /// Kind of the masks.
    pub masks: &'static str,
    /// The body model's file; `None` for the embedded body, in its mean shape unless fitted to
    /// points.
    pub body: Option<PathBuf>,
}

/// Writes the capture of `options` into the folder `out`, created if absent.
///
/// # Errors
/// Files that are missing, malformed, of unknown format, or inconsistent: frames beyond the video,
/// pictures or masks of unequal sizes, a named body model with other joints than the fit's. The
/// error names file, key, expected and actual value. Files already written are left.
pub fn import(options: &ImportOptions, out: &Path) -> Result<Imported, CaptureError> {
    let video = Video::list(&options.frames)?;
    if let Some(focal) = options.focal.filter(|focal| !(*focal >= 1.0 && *focal <= 1e6)) {
        return Err(CaptureError::setting("focal", "1 to 1000000 pixels", focal));
    }
    let (fit, joined) = match &options.joints {
        Some(set) => read::joints(&options.fit, set, &video)?,
        None => read::read(&options.fit, &video)?,
    };
    let tool = fit.tool;
    let (mut person, others, continued) = choose(&options.fit, fit.people, options.person.as_deref())?;
    let gaps_of_video = Some(video.gaps()).filter(|gaps| !gaps.is_empty());
    let mut notes: Vec<String> =
        gaps_of_video.map(|gaps| format!("pictures: numbers without one: {gaps}")).into_iter().collect();
    if has_profile(&video.paths[0])? {
        notes.push("pictures: their colour profile is not applied, colours are taken for sRGB".to_owned());
    }
    notes.extend(joined.map(|note| format!("fit: {note}")));
    notes.extend(continued);
    let (body_path, model) = body::find(tool, options.body.as_deref(), &[&options.fit, &options.frames])?;
    let hands = match (tool.hands_at_mean(), &body_path) {
        (Some(true), Some(path)) => body::mean_hands(path)?,
        _ => Vec::new(),
    };
    let (map, open) = (options.vertex_map.as_deref(), body_path.is_none());
    let mapped = points::mapped(&options.fit, map, person.vertices, &model, open)?;
    if tool.is_points() {
        let set = options.joints.as_deref().unwrap_or(sam3d::SET);
        notes.push(points::solve(&options.fit, set, mapped, &mut person, &model)?);
    } else if body_path.is_none() {
        // Shape coefficients of another body.
        person.frames.iter_mut().for_each(|frame| frame.betas.clear());
    }
    let (betas, betas_spread) = robust_mean(person.frames.iter().map(|frame| frame.betas.as_slice()));
    let unfitted = gaps(&person, video.names.len());
    let masks = match &options.masks {
        Some(path) => Some(Masks::open(path, options, &video)?),
        None if person.frames.iter().all(|frame| frame.mask.is_none()) => Masks::of_alpha(options, &video)?,
        None => None,
    };
    notes.extend(masks.iter().flat_map(|masks| &masks.notes).map(|note| format!("masks: {note}")));
    let has_mask = |frame: &FitFrame| masks.as_ref().map_or(frame.mask.is_some(), |masks| masks.has(frame.index));
    let fitted = person.frames.len();
    let frames: Vec<FitFrame> = person.frames.into_iter().filter(has_mask).collect();
    if frames.is_empty() {
        let (path, what) = match &options.masks {
            Some(path) => (path, "a mask of a frame with a fit"),
            None => (
                &options.fit,
                "masks in the fit (4D-Humans and PromptHMR have them) or in the frames' alpha, or --masks",
            ),
        };
        return Err(CaptureError::invalid(path, "masks", what, format!("none, of {fitted} fitted frames")));
    }
    let unmasked = fitted - frames.len();
    let rest = tool.pelvis().filter(|_| body_path.is_none());
    let place = |frame| placed(frame, rest, &betas, &model, &hands, options.focal);
    let mut placed: Vec<Placed> = frames.into_iter().map(place).collect();
    if let Some(path) = &options.keypoints {
        notes.push(keypoints::add(path, &mut placed, &betas, &model, &video)?);
    }
    let kind = masks.as_ref().map_or("those in the fit", |masks| masks.kind);
    write::capture(options, &video, &placed, &betas, masks.as_ref(), out)?;
    write::body(&model, out)?;
    Ok(Imported {
        tool,
        person: person.id,
        frames: placed.len(),
        others,
        video_frames: video.names.len(),
        unfitted,
        ghosts: person.ghosts,
        unmasked,
        absent: person.absent,
        notes,
        betas_spread,
        focal: placed.first().map_or(0.0, |placed| placed.frame.focal[0]),
        masks: kind,
        body: body_path,
    })
}

/// The person chosen, ids and numbers of frames of the others, and a hint at one person's other
/// ids.
type Choice = (Person, Vec<(String, usize)>, Option<String>);

/// The person `asked` for, of one id or of several (`0,4,17`), or the one in most frames (the first
/// of equals).
fn choose(path: &Path, mut people: Vec<Person>, asked: Option<&str>) -> Result<Choice, CaptureError> {
    let most = (0..people.len()).min_by_key(|&i| (usize::MAX - people[i].frames.len(), i));
    let ids: Vec<String> = match (asked, most) {
        (Some(asked), _) => asked.split(',').map(|id| id.trim().to_owned()).collect(),
        (None, Some(most)) => vec![people[most].id.clone()],
        (None, None) => return Err(CaptureError::invalid(path, "people", "a person", "nobody")),
    };
    let mut person = Person::default();
    for id in &ids {
        let Some(at) = people.iter().position(|person| person.id == *id) else {
            let each = people.iter().map(|p| format!("{} ({} frames)", p.id, p.frames.len()));
            let found = each.collect::<Vec<_>>().join(", ");
            return Err(CaptureError::invalid(path, "people", format!("person {id}"), found));
        };
        let part = people.remove(at);
        // Where two ids have a frame, that of the id named first.
        let new = part.frames.into_iter().filter(|new| person.frames.iter().all(|frame| frame.index != new.index));
        let new: Vec<FitFrame> = new.collect();
        person.frames.extend(new);
        person.ghosts += part.ghosts;
        person.absent += part.absent;
        person.vertices = part.vertices;
    }
    person.id = ids.join(",");
    person.frames.sort_by_key(|frame| frame.index);
    let continued = people.iter().filter(|other| continues(&person, other)).map(|other| other.id.as_str());
    let continued = continued.collect::<Vec<_>>().join(",");
    let hint = format!(
        "fit: person {continued} goes on in time and place where person {} ends: the same? --person {},{continued}",
        person.id, person.id
    );
    let others = people.iter().map(|other| (other.id.clone(), other.frames.len())).collect();
    Ok((person, others, (!continued.is_empty()).then_some(hint)))
}

/// Whether two tracks may be of one person: no frame in common, and ends within a second and a
/// metre.
fn continues(a: &Person, b: &Person) -> bool {
    const FRAMES: usize = 30;
    const METRES: f64 = 1.0;
    let disjoint = b.frames.iter().all(|b| a.frames.iter().all(|a| a.index != b.index));
    let near = |a: Option<&FitFrame>, b: Option<&FitFrame>| {
        a.zip(b).is_some_and(|(a, b)| {
            a.index.abs_diff(b.index) <= FRAMES && a.pelvis(DVec3::ZERO).distance(b.pelvis(DVec3::ZERO)) < METRES
        })
    };
    disjoint && (near(a.frames.last(), b.frames.first()) || near(a.frames.first(), b.frames.last()))
}

/// Frames before the person's first, after the last, and between without a fit.
fn gaps(person: &Person, total: usize) -> [usize; 3] {
    let (Some(first), Some(last)) = (person.frames.first(), person.frames.last()) else { return [total, 0, 0] };
    let between = last.index - first.index + 1 - person.frames.len();
    [first.index, total - 1 - last.index, between]
}

/// The mean of each coefficient over the values within five (scaled) median deviations of the
/// median, and the largest standard deviation of a coefficient over all values.
fn robust_mean<'a>(frames: impl Iterator<Item = &'a [f64]> + Clone) -> (Vec<f64>, f64) {
    /// Median absolute deviations in a standard deviation of a normal distribution.
    const SCALE: f64 = 1.4826;
    let mut spread = 0.0f64;
    let median = |values: &mut [f64]| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let mean = |i: usize| {
        let mut values: Vec<f64> = frames.clone().map(|betas| betas.get(i).copied().unwrap_or(0.0)).collect();
        let middle = median(&mut values);
        let mut off: Vec<f64> = values.iter().map(|v| (v - middle).abs()).collect();
        let limit = 5.0 * SCALE * median(&mut off);
        let count = values.len().max(1) as f64;
        let all = values.iter().sum::<f64>() / count;
        spread = spread.max((values.iter().map(|v| (v - all).powi(2)).sum::<f64>() / count).sqrt());
        let kept: Vec<f64> = values.into_iter().filter(|v| (v - middle).abs() <= limit).collect();
        kept.iter().sum::<f64>() / kept.len().max(1) as f64
    };
    ((0..BETAS).map(mean).collect(), spread)
}

/// Converts a fitted frame to the capture's form: all joints of the body model, and a translation
/// that keeps the pelvis of the frame's own shape, at rest at `rest` if the fit is of another body.
fn placed(
    mut frame: FitFrame,
    rest: Option<DVec3>,
    betas: &[f64],
    model: &BodyModel,
    hands: &[DVec3],
    focal: Option<f64>,
) -> Placed {
    let pelvis = |betas: &[f64]| {
        let betas: Vec<f32> = betas.iter().take(model.num_betas()).map(|&beta| beta as f32).collect();
        model.shaped(&betas).joints.first().map_or(DVec3::ZERO, |joint| joint.as_dvec3())
    };
    let own = rest.unwrap_or_else(|| pelvis(&frame.betas));
    if let Some(focal) = focal {
        frame.refocused(focal, own);
    }
    let mut pose = frame.pose.clone();
    if pose.len() > model.num_joints() {
        pose.truncate(SHARED);
    }
    pose.resize(model.num_joints(), DVec3::ZERO);
    if pose.len() == SMPLX && !hands.is_empty() {
        let start = SMPLX - hands.len();
        pose[start..].copy_from_slice(hands);
    }
    let translation = frame.pelvis(own) - frame.world_to_camera * pelvis(betas);
    Placed { pose, translation, frame, keypoints: Vec::new() }
}
