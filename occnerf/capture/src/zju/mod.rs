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

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use glam::{Affine3A, DVec3};
use rayon::prelude::*;
use smpl::BodyModel;

use super::camera::{Lens, ORTHONORMAL};
use super::checks::{self, Fitted};
use super::decode::{Planned, View, capture};
use super::files::FrameFiles;
use super::image::dimensions;
use super::item::{Item, pickled};
use super::pictures::is_directory;
use super::pixels::Area;
use super::{Capture, CaptureError, LoadOptions, json};

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
        let (image, masks, lens) = (dir.join(path), masks(dir, path)?, annots.lenses[camera]);
        let files = FrameFiles { image, masks, labels: true, occluder: None, hidden: None, lens };
        let name = format!("frame_{:06}", instants[index]);
        Ok(Some(Planned { name, files, body: bodies[index].clone(), keypoints: Vec::new() }))
    };
    let mut train = Vec::new();
    for index in 0..instants.len() {
        train.extend(plan(camera, index)?);
    }
    let obstacle = obstacle(dir, &annots, camera, &train)?;
    for (frame, instant) in train.iter_mut().zip(&instants) {
        frame.files.hidden = obstacle.get(instant).cloned();
    }
    let mask_dir = |frame: &Planned| frame.files.masks[0].parent().unwrap_or(dir).to_owned();
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
    let value = json::read(&path, MAX_OCCLUSION_BYTES)?;
    let file = Item::new(&path, &value);
    let name = file.get("camera")?;
    let name = name.value.as_str().ok_or_else(|| name.invalid("a camera's folder", name.value.type_name()))?;
    if name != annots.names[camera] {
        return Ok(BTreeMap::new());
    }
    let (width, height) = dimensions(&first.files.image)?;
    let size = file.get("image_size")?;
    let found = size.indices()?;
    if found != [width as usize, height as usize] {
        let expected = format!("[{width}, {height}], as of {}", first.files.image.display());
        return Err(size.invalid(expected, format!("{found:?}")));
    }
    let area = |rect: &Item<'_>| {
        let side = |key: &str| Ok::<_, CaptureError>(u32::try_from(rect.get(key)?.whole()?).unwrap_or(u32::MAX));
        let [x0, y0, x1, y1] = [side("x0")?, side("y0")?, side("x1")?, side("y1")?];
        if x0 > x1 || y0 > y1 || x1 > width || y1 > height {
            let expected = format!("0 ≤ x0 ≤ x1 ≤ {width} and 0 ≤ y0 ≤ y1 ≤ {height}");
            return Err(rect.invalid(expected, format!("{x0} {y0} {x1} {y1}")));
        }
        Ok(Area { columns: x0..x1, rows: y0..y1 })
    };
    let (one, instants) = (area(&file.get("rect")?)?, file.get("frames")?);
    let frames = instants.indices()?;
    let areas = match file.find("rects") {
        Some(rects) => {
            let areas = rects.list()?.iter().map(area).collect::<Result<Vec<_>, _>>()?;
            if areas.len() != frames.len() {
                return Err(rects.invalid(format!("{}, as many as frames", frames.len()), areas.len().to_string()));
            }
            areas
        }
        None => vec![one; frames.len()],
    };
    let count = annots.num_instants();
    if let Some(beyond) = frames.iter().find(|&&frame| frame >= count) {
        let expected = format!("indices below {count}, as of ims in {}", annots.path.display());
        return Err(instants.invalid(expected, beyond.to_string()));
    }
    Ok(frames.into_iter().zip(areas).collect())
}

/// Lengths of `T` in a metre.
const MILLIMETRES: f32 = 1000.0;

/// `annots.npy`, checked: cameras, and the pictures of each instant.
struct Annots {
    path: PathBuf,
    /// Each camera's folder.
    names: Vec<String>,
    lenses: Vec<Lens>,
    /// Pictures of each instant by camera.
    pictures: Vec<BTreeMap<usize, PathBuf>>,
}

impl Annots {
    fn read(dir: &Path, options: &LoadOptions) -> Result<Self, CaptureError> {
        let path = dir.join("annots.npy");
        let value = pickled(&path)?;
        let whole = Item::new(&path, &value);
        let lenses = lenses(&whole.get("cams")?, options)?;
        let lists = lists(&whole)?;
        let names = folders(&path, &lists, lenses.len())?;
        let numbers: BTreeMap<&str, usize> = names.iter().enumerate().map(|(i, n)| (n.as_str(), i)).collect();
        let mut pictures = Vec::with_capacity(lists.len());
        for (instant, list) in lists.iter().enumerate() {
            let mut by_camera = BTreeMap::new();
            for picture in list {
                let folder = folder(picture);
                let camera = numbers.get(folder.as_str()).ok_or_else(|| {
                    let expected = format!("a picture in one of the folders {}", names.join(", "));
                    CaptureError::invalid(&path, format!("ims[{instant}].ims"), expected, picture.display().to_string())
                })?;
                if let Some(other) = by_camera.insert(*camera, picture.clone()) {
                    let actual = format!("{} and {}", other.display(), picture.display());
                    let key = format!("ims[{instant}].ims");
                    return Err(CaptureError::invalid(&path, key, "one picture a camera", actual));
                }
            }
            pictures.push(by_camera);
        }
        Ok(Self { path, names, lenses, pictures })
    }

    /// Number of the training camera.
    fn camera(&self, options: &LoadOptions) -> Result<usize, CaptureError> {
        let Some(wanted) = &options.camera else { return Ok(0) };
        let count = self.names.len();
        let number = wanted.parse::<usize>().ok().filter(|n| (1..=count).contains(n)).map(|n| n - 1);
        self.names.iter().position(|name| name == wanted).or(number).ok_or_else(|| {
            CaptureError::setting("camera", format!("1 to {count}, or one of {}", self.names.join(", ")), wanted)
        })
    }

    /// Number of instants over all cameras.
    fn num_instants(&self) -> usize {
        self.pictures.len()
    }

    /// Instants that `camera` shows.
    fn instants(&self, camera: usize) -> impl Iterator<Item = usize> {
        (0..self.pictures.len()).filter(move |&instant| self.pictures[instant].contains_key(&camera))
    }

    /// The picture of an instant by `camera`, relative to the capture's directory.
    fn picture(&self, instant: usize, camera: usize) -> Option<&Path> {
        self.pictures[instant].get(&camera).map(PathBuf::as_path)
    }
}

/// The cameras of `cams`.
fn lenses(cams: &Item<'_>, options: &LoadOptions) -> Result<Vec<Lens>, CaptureError> {
    let k = cams.get("K")?;
    let (shape, _) = k.values()?;
    let (&[count, 3, 3], false) = (shape.as_slice(), shape.starts_with(&[0])) else {
        return Err(k.invalid("shape [C, 3, 3], of a camera or more", format!("shape {shape:?}")));
    };
    // Vectors are stored as rows, columns or neither.
    let per_camera = |item: &Item<'_>, wanted: &[usize]| {
        let (shape, values) = item.values()?;
        let axes: Vec<usize> = shape.iter().skip(1).copied().filter(|&n| n != 1).collect();
        if shape.first() == Some(&count) && axes == wanted {
            return Ok(values);
        }
        let expected = format!("shape {wanted:?} for each of the {count} cameras of K");
        Err(item.invalid(expected, format!("shape {shape:?}")))
    };
    let r = cams.get("R")?;
    let (turns, t) = (per_camera(&r, &[3, 3])?, per_camera(&cams.get("T")?, &[3])?);
    let d = cams.find("D").map(|d| per_camera(&d, &[5])).transpose()?.unwrap_or_else(|| vec![0.0; 5 * count]);
    let calibrations = k.floats(&[Some(count), Some(3), Some(3)])?;
    let lens = |camera: usize| {
        let key = |item: &Item<'_>| format!("{}[{camera}]", item.key);
        let rotation = Item { key: key(&r), ..r.clone() }.rotation(&turns[9 * camera..][..9], ORTHONORMAL)?.as_mat3();
        let translation = DVec3::from_slice(&t[3 * camera..]).as_vec3() / MILLIMETRES;
        let extrinsics = Affine3A::from_mat3_translation(rotation, translation);
        let d = std::array::from_fn(|i| d[5 * camera + i] as f32);
        Lens::new(&calibrations[9 * camera..][..9], extrinsics, d, options.pixel_centre)
            .map_err(|error| CaptureError::invalid(k.path, key(&k), "a pinhole camera", error))
    };
    (0..count).map(lens).collect()
}

/// The pictures of every instant.
fn lists(whole: &Item<'_>) -> Result<Vec<Vec<PathBuf>>, CaptureError> {
    let instants = whole.get("ims")?;
    let items = instants.list()?;
    if items.is_empty() {
        return Err(instants.invalid("a frame", "an empty list"));
    }
    let path = |item: &Item<'_>| {
        let text = item.value.as_str().ok_or_else(|| item.invalid("a picture's path", item.value.type_name()))?;
        let path = PathBuf::from(text);
        // Paths must stay within the capture's directory.
        let inside = path.components().all(|part| matches!(part, Component::Normal(_)));
        if inside && path.file_name().is_some() {
            return Ok(path);
        }
        Err(item.invalid("a path below the capture's directory", format!("{text:?}")))
    };
    items.iter().map(|item| item.get("ims")?.list()?.iter().map(path).collect()).collect()
}

fn folder(picture: &Path) -> String {
    picture.parent().map(|p| p.to_string_lossy().into_owned()).unwrap_or_default()
}

/// The folder of each of `count` cameras, by a frame with pictures of all.
fn folders(path: &Path, lists: &[Vec<PathBuf>], count: usize) -> Result<Vec<String>, CaptureError> {
    let longest = lists.iter().map(Vec::len).max().unwrap_or(0);
    if longest != count {
        let expected = format!("{count} pictures in a frame that all cameras see, as cams has cameras, and never more");
        return Err(CaptureError::invalid(path, "ims", expected, format!("up to {longest}")));
    }
    let full = lists.iter().find(|list| list.len() == count);
    let names: Vec<String> = full.into_iter().flatten().map(|picture| folder(picture)).collect();
    let mut seen = BTreeSet::new();
    if let Some(twice) = names.iter().find(|name| !seen.insert(name.as_str())) {
        return Err(CaptureError::invalid(
            path,
            "ims",
            "a folder for each camera",
            format!("two pictures in {twice}/"),
        ));
    }
    Ok(names)
}
