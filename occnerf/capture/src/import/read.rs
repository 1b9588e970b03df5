//! Detection of a fit's format.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use array_files::pickle::Value;

use super::file::value;
use super::fit::{Fit, FitFrame, Person, Tool};
use super::video::Video;
use super::{datasets, easymocap, join, points, sam3d, tools};
use crate::CaptureError;
use crate::checks::{MAX_ANGLE, MAX_BETA};
use crate::item::Item;

/// Expected formats.
const TOOLS: &str = "a result of WHAM, 4D-Humans / PHALP, GVHMR, PromptHMR, VIBE, CLIFF, GLAMR, ROMP or SAM 3D Body, \
    EasyMocap's folder, joints (with --joints), poses.npz of PeopleSnapshot, smpl_parms.pth of GaussianAvatar, or \
    smpl_output_*.pkl of NeuMan";

/// Reads a fit; the format is detected by content. Also returns how its frames were joined with the
/// pictures, unless by name.
pub(super) fn read(path: &Path, video: &Video) -> Result<(Fit, Option<String>), CaptureError> {
    let fit = match path.is_dir() {
        true => sam3d::folder(path, video)?.map_or_else(|| easymocap::read(path, video), Ok)?,
        false => {
            let name = path.file_name().and_then(|name| name.to_str());
            if let Some(name @ ("tracking_results.pth" | "slam_results.pth")) = name {
                let expected = "wham_output.pkl, WHAM's result (demo.py --save_pkl)";
                return Err(CaptureError::invalid(path, "the file", expected, format!("{name}, of a step before")));
            }
            parse(path, &value(path, TOOLS)?, video)?
        }
    };
    checked(path, fit, video)
}

/// Reads an array of joints of the set called `set`.
pub(super) fn joints(path: &Path, set: &str, video: &Video) -> Result<(Fit, Option<String>), CaptureError> {
    checked(path, points::read(path, set, points::count(set)?, video)?, video)
}

fn checked(path: &Path, mut fit: Fit, video: &Video) -> Result<(Fit, Option<String>), CaptureError> {
    let note = join(path, &mut fit, video)?;
    for person in &fit.people {
        check(path, person, video)?;
    }
    fit.people.retain(|person| !person.frames.is_empty());
    Ok((fit, note))
}

/// Replaces indices of a fit by those of the video's pictures; the note of [`Joined`].
fn join(path: &Path, fit: &mut Fit, video: &Video) -> Result<Option<String>, CaptureError> {
    let indices: BTreeSet<usize> = fit.people.iter().flat_map(|person| &person.frames).map(|f| f.index).collect();
    let Some(last) = indices.last() else { return Ok(None) };
    let (joined, indices) = match &fit.names {
        Some(names) => {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            let expected = || format!("names of pictures, as {}", video.names[0]);
            let joined = join::by_name(video, &names).map_err(|why| match why {
                join::Disjoint::Twice(number) => {
                    CaptureError::invalid(path, format!("number {number}"), "one entry a frame", "several")
                }
                join::Disjoint::Apart => {
                    CaptureError::invalid(path, "pictures", expected(), format!("{} and others", names[0]))
                }
            })?;
            (joined, (0..names.len()).collect())
        }
        None => {
            let expected = || format!("frames of the video, which has {} (counted from 0)", video.names.len());
            let beyond = || CaptureError::invalid(path, "frames", expected(), format!("frame {last}"));
            (join::by_index(video, &indices).ok_or_else(beyond)?, indices)
        }
    };
    let at: BTreeMap<usize, Option<usize>> = indices.into_iter().zip(joined.at).collect();
    for person in &mut fit.people {
        let before = person.frames.len();
        let placed = std::mem::take(&mut person.frames).into_iter();
        let placed = placed.filter_map(|frame| Some(FitFrame { index: (*at.get(&frame.index)?)?, ..frame }));
        person.frames = placed.collect();
        person.absent = before - person.frames.len();
    }
    Ok(joined.note)
}

/// Reads a file's value; the format is detected by its keys.
pub(super) fn parse(path: &Path, value: &Value, video: &Video) -> Result<Fit, CaptureError> {
    let root = Item::new(path, value);
    if let Some(frames) = sam3d::frames(value, video) {
        return sam3d::read(path, frames, video);
    }
    let with = |keys: &[&str]| keys.iter().all(|key| root.find(key).is_some());
    if with(&["people", "camera"]) {
        return tools::prompthmr(&root, video);
    }
    if with(&["person_data", "cam_pose"]) {
        return tools::glamr(&root);
    }
    if let Some(results) = root.find("results") {
        if results.find("smpl_thetas").is_some() {
            return Err(results.invalid("ROMP's result of a video (romp --mode=video)", "that of one picture"));
        }
        return tools::romp(&results, video);
    }
    if with(&["transl", "betas", "thetas"]) || with(&["transl", "betas", "body_pose"]) {
        return datasets::peoplesnapshot(Tool::PeopleSnapshot, &root, video);
    }
    if with(&["body_pose", "trans"]) {
        return datasets::peoplesnapshot(Tool::GaussianAvatar, &root, video);
    }
    if with(&["pose", "shape", "global_t", "focal_l", "detection_all"]) {
        return tools::cliff(&root, video);
    }
    if ["K_fullimg", "smpl_params_incam", "body_params_incam"].iter().any(|key| with(&[key])) {
        return tools::gvhmr(&root, video);
    }
    let entries = root.entries()?;
    let has = |keys: &[&str]| entries.iter().any(|(_, item)| keys.iter().all(|key| item.value.get(key).is_some()));
    if has(&["tid", "smpl", "camera"]) {
        tools::phalp(entries, video)
    } else if has(&["pose", "trans", "frame_ids"]) {
        tools::wham(&entries, video)
    } else if has(&["pose", "betas", "frame_ids"]) && (has(&["orig_cam"]) || has(&["pred_cam", "bboxes"])) {
        tools::vibe(&entries, video)
    } else if has(&["pose", "betas"]) && path.with_file_name("alignments.npy").is_file() {
        datasets::neuman(path, &entries, video)
    } else if has(&["smpl_thetas", "cam_trans"]) {
        tools::romp(&root, video)
    } else {
        let held: Vec<&str> = entries.iter().map(|(name, _)| name.as_str()).take(8).collect();
        Err(root.invalid(TOOLS, format!("a dictionary of {}", held.join(", "))))
    }
}

/// Checks that indices are unique and within the video, and values plausible.
pub(super) fn check(path: &Path, person: &Person, video: &Video) -> Result<(), CaptureError> {
    let mut seen = vec![false; video.names.len()];
    for frame in &person.frames {
        let key = format!("person {}, frame {}", person.id, frame.index);
        let invalid = |expected: String, actual: String| CaptureError::invalid(path, key.as_str(), expected, actual);
        match seen.get_mut(frame.index) {
            Some(seen) if !*seen => *seen = true,
            Some(_) => return Err(invalid("each frame once".to_owned(), "it twice".to_owned())),
            None => {
                let expected = format!("a frame of the video, which has {} (counted from 0)", video.names.len());
                return Err(invalid(expected, format!("frame {}", frame.index)));
            }
        }
        if frame.focal.iter().any(|f| !(*f >= 1.0 && *f <= 1e6)) {
            return Err(invalid("a focal length of 1 to 1000000 pixels".to_owned(), format!("{:?}", frame.focal)));
        }
        let angles = frame.pose.iter().flat_map(|angle| angle.to_array());
        let mut numbers = angles.map(|a| (a, MAX_ANGLE)).chain(frame.betas.iter().map(|&beta| (beta, MAX_BETA)));
        if let Some((number, most)) = numbers.find(|(number, most)| number.abs() > f64::from(*most)) {
            return Err(invalid(format!("angles and shape coefficients up to {most}"), number.to_string()));
        }
        if frame.offset.abs().max_element() > 1e5 {
            return Err(invalid("a body within 100 km".to_owned(), format!("{}", frame.offset)));
        }
    }
    Ok(())
}
