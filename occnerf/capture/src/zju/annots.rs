//! `annots.npy`: cameras, and the pictures of each instant.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use glam::{Affine3A, DVec3};

use crate::camera::{Lens, ORTHONORMAL};
use crate::item::{Item, pickled};
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
