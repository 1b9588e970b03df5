//! `annots.npy`: cameras, and the pictures of each instant.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use array_files::pickle::Value;
use glam::{Affine3A, Vec3};
use volrender::Distortion;

use crate::camera::{Lens, pinhole, rotation};
use crate::records::{Record, Records};
use crate::{CaptureError, LoadOptions};

/// Lengths of `T` in a metre.
const MILLIMETRES: f32 = 1000.0;

/// The file, checked.
pub(super) struct Annots {
    pub path: PathBuf,
    /// Each camera's folder.
    pub names: Vec<String>,
    pub lenses: Vec<Lens>,
    /// Pictures of each instant by camera.
    pictures: Vec<BTreeMap<usize, PathBuf>>,
}

impl Annots {
    pub fn read(dir: &Path, options: &LoadOptions) -> Result<Self, CaptureError> {
        let path = dir.join("annots.npy");
        let records = Records::load(&path)?;
        let lenses = lenses(&records.record("cams")?, options)?;
        let lists = lists(&records.whole())?;
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
    pub fn camera(&self, options: &LoadOptions) -> Result<usize, CaptureError> {
        let Some(wanted) = &options.camera else { return Ok(0) };
        let count = self.names.len();
        let number = wanted.parse::<usize>().ok().filter(|n| (1..=count).contains(n)).map(|n| n - 1);
        self.names.iter().position(|name| name == wanted).or(number).ok_or_else(|| {
            CaptureError::setting("camera", format!("1 to {count}, or one of {}", self.names.join(", ")), wanted)
        })
    }

    /// Number of instants over all cameras.
    pub fn num_instants(&self) -> usize {
        self.pictures.len()
    }

    /// Instants that `camera` shows.
    pub fn instants(&self, camera: usize) -> impl Iterator<Item = usize> {
        (0..self.pictures.len()).filter(move |&instant| self.pictures[instant].contains_key(&camera))
    }

    /// The picture of an instant by `camera`, relative to the capture's directory.
    pub fn picture(&self, instant: usize, camera: usize) -> Option<&Path> {
        self.pictures[instant].get(&camera).map(PathBuf::as_path)
    }
}

/// The cameras of `cams`.
fn lenses(cams: &Record<'_>, options: &LoadOptions) -> Result<Vec<Lens>, CaptureError> {
    let (shape, k) = cams.stacked("K")?;
    let &[count, 3, 3] = shape.as_slice() else {
        return Err(cams.invalid("K", "shape [C, 3, 3]", format!("shape {shape:?}")));
    };
    if count == 0 {
        return Err(cams.invalid("K", "a camera", "none"));
    }
    // Vectors are stored as rows, columns or neither.
    let per_camera = |key: &str, wanted: &[usize]| {
        let (shape, values) = cams.stacked(key)?;
        let axes: Vec<usize> = shape.iter().skip(1).copied().filter(|&n| n != 1).collect();
        if shape.first() == Some(&count) && axes == wanted {
            return Ok(values);
        }
        let expected = format!("shape {wanted:?} for each of the {count} cameras of K");
        Err(cams.invalid(key, expected, format!("shape {shape:?}")))
    };
    let (r, t) = (per_camera("R", &[3, 3])?, per_camera("T", &[3])?);
    let d = if cams.has("D") { per_camera("D", &[5])? } else { vec![0.0; 5 * count] };
    (0..count)
        .map(|camera| {
            let key = |name: &str| format!("{name}[{camera}]");
            let values = &r[9 * camera..9 * camera + 9];
            let rotation =
                rotation(values, 3).ok_or_else(|| cams.invalid(&key("R"), "a rotation", format!("{values:?}")))?;
            let translation = Vec3::from_slice(&t[3 * camera..]) / MILLIMETRES;
            let extrinsics = Affine3A::from_mat3_translation(rotation, translation);
            let camera_of = pinhole(&k[9 * camera..9 * camera + 9], extrinsics, options.pixel_centre)
                .map_err(|error| cams.invalid(&key("K"), "a pinhole camera", error))?;
            let d = &d[5 * camera..5 * camera + 5];
            let distortion = Distortion::from_opencv([d[0], d[1], d[2], d[3], d[4]]);
            Ok(Lens { camera: camera_of, distortion })
        })
        .collect()
}

/// The pictures of every instant.
fn lists(whole: &Record<'_>) -> Result<Vec<Vec<PathBuf>>, CaptureError> {
    let value = whole.value("ims")?;
    let items = value.items().ok_or_else(|| whole.invalid("ims", "a list of frames", value.type_name()))?;
    if items.is_empty() {
        return Err(whole.invalid("ims", "a frame", "an empty list"));
    }
    let list = |(instant, item): (usize, &Value)| {
        let key = format!("ims[{instant}].ims");
        let paths = item.get("ims").and_then(Value::items);
        let paths = paths.ok_or_else(|| whole.invalid(&key, "a list of pictures", item.type_name()))?;
        let path = |path: &Value| {
            let text = path.as_str().ok_or_else(|| whole.invalid(&key, "a picture's path", path.type_name()))?;
            let path = PathBuf::from(text);
            // Paths must stay within the capture's directory.
            let inside = path.components().all(|part| matches!(part, Component::Normal(_)));
            if inside && path.file_name().is_some() {
                return Ok(path);
            }
            Err(whole.invalid(&key, "a path below the capture's directory", format!("{text:?}")))
        };
        paths.iter().map(path).collect()
    };
    items.iter().enumerate().map(list).collect()
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
