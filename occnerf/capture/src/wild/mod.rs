//! HumanNeRF's layout for videos from anywhere.
//!
//! ```text
//! images/NAME.png …       masks/NAME.png …      (PNG or JPEG; masks 0 to 255, the visible person)
//! metadata.json           {NAME: {poses (3J), betas (≤ B), cam_intrinsics (3,3),
//!                          cam_extrinsics (4,4), distortions (5)?, keypoints (N,4)?}}
//! occluders/NAME.png …    where known: 255 for an occluder of the person
//! clean/images, masks/    some of the frames again without occluders, kept back
//! ```
//!
//! The pose's first joint turns the body about its pelvis; the extrinsics hold the body's
//! translation. Frames are the entries of `metadata.json` in the order of their names, `10` after
//! `9`; pictures that it does not mention are left out. A row of `keypoints` is a joint of the body
//! model, its pixel (x, y; pixel centres at integer + 0.5) and the detector's confidence, 0 to 1.

#[cfg(test)]
mod tests;

use std::path::Path;

use smpl::{BodyModel, Placement};

use super::camera::Lens;
use super::checks::{self, Fitted};
use super::decode::{Planned, View, capture};
use super::files::FrameFiles;
use super::item::Item;
use super::names::FrameName;
use super::pictures::{Pictures, is_directory};
use super::{Capture, CaptureError, LoadOptions, json};

/// Largest `metadata.json`: tens of thousands of frames.
const MAX_BYTES: u64 = 64 << 20;
/// Camera name of the frames under `clean`.
const CLEAN: &str = "clean";

/// Reads a capture in this layout.
pub(super) fn load(dir: &Path, body: &BodyModel, options: &LoadOptions) -> Result<Capture, CaptureError> {
    options.only_zju("HumanNeRF's wild layout")?;
    let path = dir.join("metadata.json");
    let value = json::read(&path, MAX_BYTES)?;
    let all = Item::new(&path, &value).frames()?;
    let names: Vec<&str> = all.iter().map(|(FrameName(name), _)| *name).collect();
    let frames = options.select(all);

    let (images, masks) = (Pictures::list(&dir.join("images"))?, Pictures::list(&dir.join("masks"))?);
    let occluders = optional(&dir.join("occluders"), &names)?;
    let plan = |name: &str, record: &Item<'_>, [images, masks]: [&Pictures; 2]| {
        let (image, masks) = (images.demand(name, &path)?, vec![masks.demand(name, &path)?]);
        let lens = Lens::read(record, "cam_intrinsics", "cam_extrinsics", options.pixel_centre)?;
        let (pose, betas) = (checks::pose(record, body)?, checks::betas(record, "betas", body)?);
        Ok::<_, CaptureError>(Planned {
            name: name.to_owned(),
            files: FrameFiles { image, masks, labels: false, occluder: None, hidden: None, lens },
            body: Fitted { pose, placement: Placement::default(), betas },
            keypoints: checks::keypoints(record, body)?,
        })
    };
    let mut train = Vec::new();
    for (FrameName(name), record) in &frames {
        let mut frame = plan(name, record, [&images, &masks])?;
        frame.files.occluder = occluders.as_ref().and_then(|o| o.get(name));
        train.push(frame);
    }
    let train = View::new(train, &dir.join("masks"), &path)?;

    let clean = dir.join(CLEAN);
    let (mut indices, mut kept) = (Vec::new(), Vec::new());
    is_directory(&clean)?;
    if let Some(images) = optional(&clean.join("images"), &names)? {
        let masks = Pictures::list(&clean.join("masks"))?;
        for (index, (FrameName(name), record)) in frames.iter().enumerate().step_by(options.eval_stride) {
            if images.get(name).is_some() {
                indices.push((CLEAN.to_owned(), index));
                kept.push(plan(name, record, [&images, &masks])?);
            }
        }
    }
    let eval = match kept.is_empty() {
        true => Vec::new(),
        false => vec![(View::new(kept, &clean.join("masks"), &path)?, indices)],
    };
    capture(dir, train, eval, None, body, options)
}

/// The pictures of a folder that need not be there; if there are any, one has a frame's name.
fn optional(dir: &Path, names: &[&str]) -> Result<Option<Pictures>, CaptureError> {
    if !is_directory(dir)? {
        return Ok(None);
    }
    let pictures = Pictures::list(dir)?;
    if let Some((first, _)) = pictures.iter().next()
        && names.iter().all(|name| pictures.get(name).is_none())
    {
        let expected = format!("names of frames of metadata.json, as {}", names.first().unwrap_or(&""));
        return Err(CaptureError::invalid(dir, "names", expected, first.as_str()));
    }
    Ok(Some(pictures))
}
