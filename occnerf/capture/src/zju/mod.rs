//! Raw ZJU-MoCap (Peng et al. 2021), many cameras around one person.
//!
//! ```text
//! annots.npy                   {cams: {K (C,3,3), R (C,3,3), T (C,3) in millimetres, D (C,5)?},
//!                               ims: [{ims: [paths]}]}
//! Camera_B1/000000.jpg …       the paths of `ims`: a frame's pictures, a folder a camera
//! mask_cihp/Camera_B1/… .png   labels, 0 being background; or mask/; where there are both, either
//! new_params/0.npy …           {poses (1,3J), Rh (1,3), Th (1,3), shapes (1,≤B)}, counted from 0,
//!                              or all from 1
//! new_vertices/0.npy …         (V,3), where present compared with the model
//! occlusion.json               {camera, image_size (w,h), rect {x0, y0, x1, y1}, frames}, where
//!                              present; of one that moves, also rects, one for each of frames
//! ```

mod annots;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Deserialize;
use smpl::BodyModel;

use self::annots::Annots;
use super::decode::{Fitted, Planned, View, capture};
use super::files::read_text;
use super::image::dimensions;
use super::item::{Item, pickled};
use super::pictures::is_directory;
use super::pixels::Area;
use super::{Capture, CaptureError, LoadOptions, checks};

/// Tolerance of a vertex against the file's, as a fraction of the body's largest extent, 1 cm at
/// 1.7 m.
const VERTEX_TOLERANCE: f32 = 0.01 / 1.7;
/// Longest `occlusion.json` that is read.
const MAX_OCCLUSION_BYTES: u64 = 1 << 20;

/// Reads a capture in this layout.
pub(super) fn load(dir: &Path, body: &BodyModel, options: &LoadOptions) -> Result<Capture, CaptureError> {
    let annots = Annots::read(dir, options)?;
    let camera = annots.camera(options)?;
    let instants = options.select(annots.instants(camera));
    let bodies = bodies(dir, &annots, &instants, body)?;

    let plan = |camera: usize, index: usize| -> Result<Option<Planned>, CaptureError> {
        let Some(path) = annots.picture(instants[index], camera) else { return Ok(None) };
        Ok(Some(Planned {
            name: format!("frame_{:06}", instants[index]),
            image: dir.join(path),
            masks: masks(dir, path)?,
            labels: true,
            occluder: None,
            hidden: None,
            lens: annots.lenses[camera],
            body: bodies[index].clone(),
            keypoints: Vec::new(),
        }))
    };
    let mut train = Vec::new();
    for index in 0..instants.len() {
        train.extend(plan(camera, index)?);
    }
    let obstacle = obstacle(dir, &annots, camera, &train)?;
    for (frame, instant) in train.iter_mut().zip(&instants) {
        frame.hidden = obstacle.get(instant).cloned();
    }
    let mask_dir = |frame: &Planned| frame.masks[0].parent().unwrap_or(dir).to_owned();
    let first_masks = train.first().map_or(dir.to_owned(), mask_dir);
    let train = View::new(train, &first_masks, &annots.path)?;

    let mut views = Vec::new();
    for other in (0..annots.lenses.len()).filter(|&c| c != camera) {
        let (mut kept, mut indices) = (Vec::new(), Vec::new());
        for index in (0..instants.len()).step_by(options.eval_stride) {
            let there = match annots.picture(instants[index], other).map(|path| dir.join(path)) {
                Some(path) => !is_directory(&path)? && path.is_file(),
                None => false,
            };
            if let Some(frame) = if there { plan(other, index)? } else { None } {
                kept.push(frame);
                indices.push((annots.names[other].clone(), index));
            }
        }
        if let Some(first) = kept.first() {
            let masks = mask_dir(first);
            views.push((View::new(kept, &masks, &annots.path)?, indices));
        }
    }
    capture(dir, train, views, None, body, options)
}

/// The masks that exist of a picture.
fn masks(dir: &Path, picture: &Path) -> Result<Vec<PathBuf>, CaptureError> {
    let wanted = ["mask_cihp", "mask"].map(|kind| dir.join(kind).join(picture).with_extension("png"));
    let found: Vec<PathBuf> = wanted.iter().filter(|path| path.is_file()).cloned().collect();
    if found.is_empty() {
        let what = format!("mask of {} (nor is it in mask/)", picture.display());
        return Err(CaptureError::missing(&wanted[0], what));
    }
    Ok(found)
}

/// The fitted bodies of the given instants.
fn bodies(dir: &Path, annots: &Annots, instants: &[usize], body: &BodyModel) -> Result<Vec<Fitted>, CaptureError> {
    let file = |kind: &str, number: usize| dir.join(kind).join(format!("{number}.npy"));
    // Some subjects count from 1: 0.npy is absent and the last number present.
    let last = annots.num_instants();
    let offset = usize::from(!file("new_params", 0).is_file() && file("new_params", last).is_file());
    // Collected as results first: the first error in order is reported.
    let fitted: Vec<Result<Fitted, CaptureError>> = instants
        .par_iter()
        .map(|&instant| {
            let path = file("new_params", instant + offset);
            if !path.is_file() {
                let what = format!("body parameters of ims[{instant}] in {}", annots.path.display());
                return Err(CaptureError::missing(&path, what));
            }
            let value = pickled(&path)?;
            let fitted = checks::about_origin(&Item::new(&path, &value), "shapes", body)?;
            let vertices = file("new_vertices", instant + offset);
            if vertices.is_file() {
                compare(&vertices, &fitted, body)?;
            }
            Ok(fitted)
        })
        .collect();
    fitted.into_iter().collect()
}

/// Errors unless the model's vertices are those of the file.
fn compare(path: &Path, fitted: &Fitted, body: &BodyModel) -> Result<(), CaptureError> {
    let value = array_files::pickle::read(path)?;
    let item = Item { key: "vertices".to_owned(), ..Item::new(path, &value) };
    let expected = checks::triples(&item.floats(&[Some(body.num_vertices()), Some(3)])?);
    let posed = body.pose(&body.shaped(&fitted.betas), &fitted.pose, fitted.placement);
    let tolerance = VERTEX_TOLERANCE * checks::extent(&expected);
    checks::same(&item, "vertex", &posed.vertices, &expected, tolerance)
}

#[derive(Deserialize)]
struct OcclusionFile {
    camera: String,
    image_size: [u32; 2],
    rect: Rectangle,
    frames: Vec<usize>,
    rects: Option<Vec<Rectangle>>,
}

#[derive(Clone, Copy, Deserialize)]
struct Rectangle {
    x0: u32,
    y0: u32,
    x1: u32,
    y1: u32,
}

/// The obstacle of `occlusion.json` by instant, in pixels of the files; none without a file, or for
/// one of another camera.
fn obstacle(
    dir: &Path,
    annots: &Annots,
    camera: usize,
    train: &[Planned],
) -> Result<BTreeMap<usize, Area>, CaptureError> {
    let path = dir.join("occlusion.json");
    let (true, Some(first)) = (path.is_file(), train.first()) else { return Ok(BTreeMap::new()) };
    let text = read_text(&path, MAX_OCCLUSION_BYTES)?;
    let invalid = |key: &str, expected: String, actual: String| CaptureError::invalid(&path, key, expected, actual);
    let OcclusionFile { camera: name, image_size, rect, frames, rects } = serde_json::from_str(&text).map_err(|e| {
        let expected = "camera, image_size (width, height), rect with x0 y0 x1 y1, and frames";
        invalid("the file", expected.to_owned(), e.to_string())
    })?;
    if name != annots.names[camera] {
        return Ok(BTreeMap::new());
    }
    let (width, height) = dimensions(&first.image)?;
    if image_size != [width, height] {
        let expected = format!("[{width}, {height}], as of {}", first.image.display());
        return Err(invalid("image_size", expected, format!("{image_size:?}")));
    }
    for rect in rects.iter().flatten().chain([&rect]) {
        if rect.x0 > rect.x1 || rect.y0 > rect.y1 || rect.x1 > width || rect.y1 > height {
            let expected = format!("0 ≤ x0 ≤ x1 ≤ {width} and 0 ≤ y0 ≤ y1 ≤ {height}");
            return Err(invalid("rect", expected, format!("{} {} {} {}", rect.x0, rect.y0, rect.x1, rect.y1)));
        }
    }
    let rects = rects.unwrap_or_else(|| vec![rect; frames.len()]);
    if rects.len() != frames.len() {
        return Err(invalid("rects", format!("{}, as many as frames", frames.len()), rects.len().to_string()));
    }
    let count = annots.num_instants();
    if let Some(beyond) = frames.iter().find(|&&frame| frame >= count) {
        let expected = format!("indices below {count}, as of ims in {}", annots.path.display());
        return Err(invalid("frames", expected, beyond.to_string()));
    }
    let area = |r: Rectangle| Area { columns: r.x0..r.x1, rows: r.y0..r.y1 };
    Ok(frames.into_iter().zip(rects.into_iter().map(area)).collect())
}
