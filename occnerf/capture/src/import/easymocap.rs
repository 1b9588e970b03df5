//! EasyMocap's folder: `smpl/000000.json` (also `smpl/CAMERA/…`, or the files themselves), lists of
//! {`id`, `Rh`, `Th`, `poses`, `shapes`}; beside or above it `intri.yml` and `extri.yml`. A vertex
//! is R(Rh) · lbs(poses, shapes) + Th, about the origin of a world whose z points up.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::pickle::Value;
use array_files::{Data, NdArray};
use glam::{DMat3, DVec3};

use super::file::{json, text};
use super::fit::{About, BETAS, Fit, FitFrame, Lens, ORTHONORMAL, People, SMPL, Tool, axis_angle, pinhole, rotation};
use super::video::Video;
use crate::CaptureError;
use crate::item::Item;
use crate::pictures::listed;

/// The camera that filmed.
struct Camera {
    rotation: DMat3,
    translation: DVec3,
    lens: Lens,
}

pub(super) fn read(dir: &Path, video: &Video) -> Result<Fit, CaptureError> {
    let inner = dir.join("smpl");
    let folder = if inner.is_dir() { inner } else { dir.to_owned() };
    let files = listed(&folder, &["json"])?.into_iter();
    let files: Vec<_> = files.filter_map(|(stem, path)| Some((stem.parse::<usize>().ok()?, path))).collect();
    if files.is_empty() {
        let expected = "EasyMocap's smpl/000000.json …, intri.yml and extri.yml";
        return Err(CaptureError::invalid(&folder, "files", expected, "no .json file with a number for a name"));
    }
    let camera = camera(&folder, video)?;
    let mut people = People::default();
    for (index, path) in &files {
        let value = json(path)?;
        let root = Item::new(path, &value);
        // A list, a list under `annots`, or a map by ids.
        let root = root.find("annots").unwrap_or(root);
        let records: Vec<(String, Item<'_>)> = match root.value {
            Value::Dict(_) => root.entries()?,
            _ => root.list()?.into_iter().map(|item| (String::new(), item)).collect(),
        };
        for (name, record) in records {
            let id = match (record.find("id"), name.parse()) {
                (None, Ok(id)) => id,
                _ => record.get("id")?.whole()?,
            };
            people.get(id).frames.push(frame(*index, &record, &camera)?);
        }
    }
    Ok(Fit::of_video(Tool::EasyMocap, people.into_vec()))
}

/// A person as `write_smpl` prints it: `Rh`, `Th`, `poses` and `shapes`, matrices of one row.
fn frame(index: usize, record: &Item<'_>, camera: &Camera) -> Result<FitFrame, CaptureError> {
    let numbers = |name: &str, counts: &[usize]| {
        let item = record.get(name)?;
        let values = item.numbers(&[None])?;
        match counts.contains(&values.len()) {
            true => Ok(values),
            false => Err(item.invalid(format!("{counts:?} numbers"), values.len().to_string())),
        }
    };
    let (rh, th) = (DVec3::from_slice(&numbers("Rh", &[3])?), DVec3::from_slice(&numbers("Th", &[3])?));
    let mut row = numbers("poses", &[3 * SMPL, 3 * SMPL - 3])?;
    if row.len() < 3 * SMPL {
        row.splice(..0, [0.0; 3]);
    }
    row.extend(&numbers("shapes", &[10, 11, 12, 16])?[..BETAS]);
    row.extend((camera.rotation * th + camera.translation).to_array());
    let mut frame = FitFrame::still(index, &row, camera.lens);
    // The root's own rotation, where there is one, comes before that about the origin.
    let root = &mut frame.pose[0];
    *root = if *root == DVec3::ZERO { rh } else { axis_angle(rotation(rh) * rotation(*root)) };
    let about = About::Origin(camera.rotation * rotation(rh));
    Ok(FitFrame { world_to_camera: camera.rotation, about, ..frame })
}

/// The camera of `intri.yml` and `extri.yml` in `folder` or the nearest folder above: its only one,
/// or the first.
fn camera(folder: &Path, video: &Video) -> Result<Camera, CaptureError> {
    let whole = folder.canonicalize().map_err(CaptureError::io(folder))?;
    let above = whole.ancestors().take(3).find(|dir| dir.join("intri.yml").is_file());
    let dir = above.ok_or_else(|| {
        let what = "file (nor in the two folders above): the cameras of EasyMocap";
        CaptureError::missing(&folder.join("intri.yml"), what)
    })?;
    let (intri, extri) = (dir.join("intri.yml"), dir.join("extri.yml"));
    let (inner, outer) = (yaml(&text(&intri)?), yaml(&text(&extri)?));
    let (inner, outer) = (Item::new(&intri, &inner), Item::new(&extri, &outer));
    let entries = inner.entries()?;
    let name = entries.iter().find_map(|(key, _)| key.strip_prefix("K_"));
    let name = name.ok_or_else(|| CaptureError::invalid(&intri, "K_…", "a camera's matrix", "none"))?;
    let lens = pinhole(&inner.get(&format!("K_{name}"))?.numbers(&[Some(9)])?);
    let [width, height] = video.sides();
    for (key, side) in [("W", width), ("H", height)] {
        let Some(item) = inner.find(&format!("{key}_{name}")) else { continue };
        let found = item.number()?;
        if found != side {
            let expected = format!("{side}, as the frames' {width}×{height}");
            return Err(item.invalid(expected, found.to_string()));
        }
    }
    if let Some(item) = inner.find(&format!("dist_{name}")) {
        let lens = item.values()?.1;
        if lens.iter().any(|d| *d != 0.0) {
            return Err(item.invalid("no lens distortion (undistort the frames)", format!("{lens:?}")));
        }
    }
    let rotation = match outer.find(&format!("Rot_{name}")) {
        Some(item) => item.rotation(&item.numbers(&[Some(9)])?, ORTHONORMAL)?,
        None => rotation(DVec3::from_slice(&outer.get(&format!("R_{name}"))?.numbers(&[Some(3)])?)),
    };
    let translation = DVec3::from_slice(&outer.get(&format!("T_{name}"))?.numbers(&[Some(3)])?);
    Ok(Camera { rotation, translation, lens })
}

/// The numbers and matrices, row by row, of OpenCV's YAML (`!!opencv-matrix` with its `data`), in
/// the order of their names. Everything else is ignored; malformed numbers are NaN.
fn yaml(text: &str) -> Value {
    let number = |text: &str| text.trim().parse().unwrap_or(f64::NAN);
    let mut found = BTreeMap::new();
    let (mut name, mut list) = (String::new(), None::<String>);
    for line in text.lines() {
        // A list may go on over several lines.
        if let Some(text) = &mut list {
            text.push_str(line);
        } else if let Some((key, rest)) = line.split_once(':') {
            let (indented, key, rest) = (key.starts_with([' ', '%']), key.trim(), rest.trim());
            if !indented {
                name = key.trim_matches('"').to_owned();
                if rest.parse::<f64>().is_ok() {
                    found.insert(name.clone(), vec![number(rest)]);
                }
            } else if key == "data" && rest.starts_with('[') {
                list = Some(rest.to_owned());
            }
        }
        if let Some(text) = list.take_if(|text| text.contains(']')) {
            let inside = text.trim_start_matches('[').split(']').next().unwrap_or("");
            let values = inside.split(',').filter(|item| !item.trim().is_empty()).map(number);
            found.insert(name.clone(), values.collect());
        }
    }
    let array = |values: Vec<f64>| NdArray { shape: vec![values.len()], data: Data::F64(values) };
    Value::Dict(found.into_iter().map(|(name, values)| (Value::Str(name), Value::Array(array(values)))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrices_and_numbers_are_found_by_name() {
        let text = "%YAML:1.0\n---\nnames:\n  - \"1\"\nK_1: !!opencv-matrix\n  rows: 1\n  cols: 3\n  dt: d\n  data: [ 1., 2,\n      -3e0 ]\nH_1: 256\nx: [a]\n";
        let found = |text: &str, key: &str| yaml(text).get(key).map(|value| value.as_array().unwrap().to_f64());
        assert_eq!(found(text, "K_1").unwrap(), [1.0, 2.0, -3.0]);
        assert_eq!(found(text, "H_1").unwrap(), [256.0]);
        assert!(found(text, "x").is_none() && found(text, "names").is_none());
        assert!(found("K: !!opencv-matrix\n  data: [1, x]\n", "K").unwrap()[1].is_nan());
        assert!(found("K: !!opencv-matrix\n  data: [1, ", "K").is_none());
    }
}
