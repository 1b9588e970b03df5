//! HumanNeRF's prepared layout (Weng et al. 2022), with OccNeRF's `eval` cameras.
//!
//! ```text
//! images/frame_000000.png …   masks/frame_000000.png …   (PNG or JPEG)
//! cameras.pkl                 {frame: {intrinsics (3,3), extrinsics (4,4), distortions (5)?}}
//! mesh_infos.pkl              {frame: {Rh (3), Th (3), poses (3J), betas (≤ B),
//!                              tpose_joints (J,3), …}}
//! canonical_joints.pkl        {joints (J,3), avg_betas (≤ B)}
//! eval/Camera_…/              images, masks, cameras.pkl, mesh_infos.pkl again, nothing occluded
//! ```
//!
//! Frames are the entries of `cameras.pkl` in the order of their names, `10` after `9`.

#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use smpl::BodyModel;

use super::camera::Lens;
use super::decode::{Planned, View, capture};
use super::files::FrameFiles;
use super::item::{Item, pickled};
use super::names::FrameName;
use super::pictures::{Pictures, file_name, is_directory};
use super::{Capture, CaptureError, LoadOptions, checks};

/// Reads a capture in this layout.
pub(super) fn load(dir: &Path, body: &BodyModel, options: &LoadOptions) -> Result<Capture, CaptureError> {
    options.only_zju("HumanNeRF's prepared layout")?;
    let mut all = Vec::new();
    let train = plan(dir, body, options, |names| {
        all = names.iter().map(|n| (*n).to_owned()).collect();
        Ok(options.select(names))
    })?;
    let names = options.select(all.iter());
    let mean_betas = mean_betas(dir, body)?;

    let mut eval = Vec::new();
    for camera in eval_directories(dir)? {
        let mut indices = Vec::new();
        let view = plan(&camera, body, options, |mut seen| {
            if let Some(odd) = seen.iter().find(|name| index(&all, name).is_none()) {
                let expected = format!("the name of a frame of {}", dir.join("cameras.pkl").display());
                let file = camera.join("cameras.pkl");
                return Err(CaptureError::invalid(&file, *odd, expected, "no such training frame"));
            }
            seen.retain(|name| index(&names, name).is_some_and(|i| i % options.eval_stride == 0));
            let found = seen.iter().filter_map(|name| index(&names, name));
            indices.extend(found.map(|index| (file_name(&camera), index)));
            Ok(seen)
        })?;
        eval.extend(view.map(|view| (view, indices)));
    }

    let train = train.ok_or_else(|| CaptureError::missing(&dir.join("cameras.pkl"), "frame"))?;
    capture(dir, train, eval, Some(mean_betas), body, options)
}

fn index(names: &[impl AsRef<str>], name: &str) -> Option<usize> {
    names.binary_search_by(|n| FrameName(n.as_ref()).cmp(&FrameName(name))).ok()
}

/// The frames of a directory that `choose` selects by their sorted names; `None` if none.
fn plan(
    dir: &Path,
    body: &BodyModel,
    options: &LoadOptions,
    choose: impl FnOnce(Vec<&str>) -> Result<Vec<&str>, CaptureError>,
) -> Result<Option<View>, CaptureError> {
    if !dir.is_dir() {
        return Err(CaptureError::missing(dir, "directory"));
    }
    let paths = [dir.join("cameras.pkl"), dir.join("mesh_infos.pkl")];
    let [cameras, bodies] = &paths;
    let (camera_values, body_values) = (pickled(cameras)?, pickled(bodies)?);
    let lenses = Item::new(cameras, &camera_values).frames()?;
    let infos = Item::new(bodies, &body_values).frames()?;
    for (has, lacks, has_path, lacks_path) in [(&lenses, &infos, cameras, bodies), (&infos, &lenses, bodies, cameras)] {
        if let Some(name) = has.keys().find(|name| !lacks.contains_key(*name)) {
            let expected = format!("an entry, as in {}", has_path.display());
            return Err(CaptureError::invalid(lacks_path, name.0, expected, "no such key"));
        }
    }
    let images = Pictures::list(&dir.join("images"))?;
    let masks = Pictures::list(&dir.join("masks"))?;
    if let Some((name, path)) = images.iter().find(|(name, _)| !lenses.contains_key(&FrameName(name))) {
        let expected = format!("an entry `{name}` in {}", cameras.display());
        return Err(CaptureError::invalid(path, "camera of the image", expected, "none"));
    }
    let chosen = choose(lenses.keys().map(|name| name.0).collect())?;
    let planned = |&name: &&str| {
        let (image, masks) = (images.demand(name, cameras)?, vec![masks.demand(name, cameras)?]);
        let (lens, info) = (&lenses[&FrameName(name)], &infos[&FrameName(name)]);
        let fitted = checks::about_origin(info, "betas", body)?;
        checks::joints(info, "tpose_joints", &fitted.betas, body)?;
        let lens = Lens::read(lens, "intrinsics", "extrinsics", options.pixel_centre)?;
        let files = FrameFiles { image, masks, labels: false, occluder: None, hidden: None, lens };
        Ok(Planned { name: name.to_owned(), files, body: fitted, keypoints: Vec::new() })
    };
    // Collected as results first: the first error in order is reported.
    let frames: Vec<Result<Planned, CaptureError>> = chosen.par_iter().map(planned).collect();
    let frames: Vec<Planned> = frames.into_iter().collect::<Result<_, _>>()?;
    if frames.is_empty() {
        return Ok(None);
    }
    View::new(frames, &dir.join("masks"), cameras).map(Some)
}

/// The shape of the canonical body, `avg_betas` of `canonical_joints.pkl`, its joints checked
/// against the model's.
fn mean_betas(dir: &Path, body: &BodyModel) -> Result<Vec<f32>, CaptureError> {
    let path = dir.join("canonical_joints.pkl");
    let value = pickled(&path)?;
    let canonical = Item::new(&path, &value);
    let betas = checks::betas(&canonical, "avg_betas", body)?;
    checks::joints(&canonical, "joints", &betas, body)?;
    Ok(betas)
}

/// `eval/*/` in the order of their names; none where there is no `eval`.
fn eval_directories(dir: &Path) -> Result<Vec<PathBuf>, CaptureError> {
    let root = dir.join("eval");
    if !is_directory(&root)? {
        return Ok(Vec::new());
    }
    let mut found = Vec::new();
    for entry in std::fs::read_dir(&root).map_err(CaptureError::io(&root))? {
        let path = entry.map_err(CaptureError::io(&root))?.path();
        if is_directory(&path)? {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}
