//! EasyMocap's folder: `smpl/000000.json` (also `smpl/CAMERA/…`, or the files themselves), lists of
//! {`id`, `Rh`, `Th`, `poses`, `shapes`}; beside or above it `intri.yml` and `extri.yml`. A vertex
//! is R(Rh) · lbs(poses, shapes) + Th, about the origin of a world whose z points up.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use serde::Deserialize;

use super::fit::{About, Fit, FitFrame, Person, SMPL, Tool, axis_angle, rotation};
use super::item::{text, turn};
use super::video::Video;
use super::yaml;
use crate::CaptureError;

/// A person as `write_smpl` prints it; matrices of one row.
#[derive(Deserialize)]
struct Record {
    id: i64,
    #[serde(rename = "Rh")]
    rh: Vec<Vec<f64>>,
    #[serde(rename = "Th")]
    th: Vec<Vec<f64>>,
    poses: Vec<Vec<f64>>,
    shapes: Vec<Vec<f64>>,
}

/// The camera that filmed.
struct Camera {
    rotation: DMat3,
    translation: DVec3,
    focal: [f64; 2],
    centre: [f64; 2],
}

pub(super) fn read(dir: &Path, video: &Video) -> Result<Fit, CaptureError> {
    let inner = dir.join("smpl");
    let folder = if inner.is_dir() { inner } else { dir.to_owned() };
    let files = listed(&folder)?;
    if files.is_empty() {
        let expected = "EasyMocap's smpl/000000.json …, intri.yml and extri.yml";
        return Err(CaptureError::invalid(&folder, "files", expected, "no .json file with a number for a name"));
    }
    let camera = camera(&folder, video)?;
    let mut people: BTreeMap<i64, Person> = BTreeMap::new();
    for (index, path) in &files {
        let text = text(path)?;
        let records = records(&text)
            .map_err(|e| CaptureError::invalid(path, "the file", "JSON of id, Rh, Th, poses, shapes", e.to_string()))?;
        for record in records {
            let new = || Person { id: record.id.to_string(), ..Person::default() };
            people.entry(record.id).or_insert_with(new).frames.push(frame(path, *index, &record, &camera)?);
        }
    }
    Ok(Fit { tool: Tool::EasyMocap, people: people.into_values().collect(), names: None })
}

/// The people of a file: a list, a list under `annots`, or a map by their ids.
fn records(text: &str) -> serde_json::Result<Vec<Record>> {
    use serde_json::{Value, from_value};
    let mut file: Value = serde_json::from_str(text)?;
    if let Some(list) = file.get_mut("annots") {
        file = list.take();
    }
    let Value::Object(map) = file else { return from_value(file) };
    let with_id = map.into_iter().map(|(key, mut person)| {
        if let (Value::Object(fields), Ok(id)) = (&mut person, key.parse::<i64>()) {
            fields.entry("id").or_insert_with(|| id.into());
        }
        person
    });
    from_value(Value::Array(with_id.collect()))
}

/// The files of frames by their numbers.
fn listed(folder: &Path) -> Result<BTreeMap<usize, PathBuf>, CaptureError> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(CaptureError::io(folder))? {
        let path = entry.map_err(CaptureError::io(folder))?.path();
        let stem = path.file_stem().and_then(|s| s.to_str()).unwrap_or("");
        if path.extension().is_some_and(|e| e == "json")
            && let Ok(number) = stem.parse::<usize>()
        {
            files.insert(number, path);
        }
    }
    Ok(files)
}

fn frame(path: &Path, index: usize, record: &Record, camera: &Camera) -> Result<FitFrame, CaptureError> {
    let key = |name: &str| format!("person {}, {name}", record.id);
    let numbers = |name: &str, rows: &[Vec<f64>], counts: &[usize]| match rows {
        [row] if counts.contains(&row.len()) && row.iter().all(|x| (*x as f32).is_finite()) => Ok(row.clone()),
        [row] => Err(CaptureError::invalid(path, key(name), format!("{counts:?} numbers"), format!("{}", row.len()))),
        _ => Err(CaptureError::invalid(path, key(name), "one row", format!("{}", rows.len()))),
    };
    let rh = DVec3::from_slice(&numbers("Rh", &record.rh, &[3])?);
    let th = DVec3::from_slice(&numbers("Th", &record.th, &[3])?);
    let poses = numbers("poses", &record.poses, &[3 * SMPL, 3 * SMPL - 3])?;
    let mut pose: Vec<DVec3> = poses.chunks_exact(3).map(DVec3::from_slice).collect();
    if pose.len() < SMPL {
        pose.insert(0, DVec3::ZERO);
    }
    // The root's own rotation, where there is one, comes before that about the origin.
    pose[0] = if pose[0] == DVec3::ZERO { rh } else { axis_angle(rotation(rh) * rotation(pose[0])) };
    Ok(FitFrame {
        index,
        pose,
        betas: numbers("shapes", &record.shapes, &[10, 11, 12, 16])?.into_iter().take(10).collect(),
        world_to_camera: camera.rotation,
        about: About::Origin(camera.rotation * rotation(rh)),
        offset: camera.rotation * th + camera.translation,
        focal: camera.focal,
        centre: camera.centre,
        mask: None,
        points: Vec::new(),
    })
}

/// The camera of `intri.yml` and `extri.yml` in `folder` or the nearest folder above: its only one,
/// or the first.
fn camera(folder: &Path, video: &Video) -> Result<Camera, CaptureError> {
    let whole = folder.canonicalize().map_err(CaptureError::io(folder))?;
    let above = whole.ancestors().take(3).find(|dir| dir.join("intri.yml").is_file());
    let dir = above.ok_or_else(|| {
        CaptureError::missing(
            &folder.join("intri.yml"),
            "file (nor in the two folders above): the cameras of EasyMocap",
        )
    })?;
    let (intri, extri) = (dir.join("intri.yml"), dir.join("extri.yml"));
    let (inner, outer) = (yaml::parse(&text(&intri)?), yaml::parse(&text(&extri)?));
    let name = inner.keys().filter_map(|key| key.strip_prefix("K_")).next();
    let name = name.ok_or_else(|| CaptureError::invalid(&intri, "K_…", "a camera's matrix", "none"))?;
    let finite = |path: &Path, map: &BTreeMap<String, Vec<f64>>, key: String, count: usize| match map.get(&key) {
        Some(values) if values.len() == count && values.iter().all(|x| (*x as f32).is_finite()) => Ok(values.clone()),
        found => {
            let found = found.map_or("nothing".to_owned(), |values| format!("{values:?}"));
            Err(CaptureError::invalid(path, key, format!("{count} finite numbers"), found))
        }
    };
    let k = finite(&intri, &inner, format!("K_{name}"), 9)?;
    let [width, height] = video.sides();
    for (key, side) in [("W", width), ("H", height)] {
        let key = format!("{key}_{name}");
        if let Some(found) = inner.get(&key).filter(|found| found.as_slice() != [side]) {
            let expected = format!("{side}, as the frames' {width}×{height}");
            let found: Vec<String> = found.iter().map(f64::to_string).collect();
            return Err(CaptureError::invalid(&intri, key, expected, found.join(", ")));
        }
    }
    if let Some(lens) = inner.get(&format!("dist_{name}")).filter(|lens| lens.iter().any(|d| *d != 0.0)) {
        let key = format!("dist_{name}");
        return Err(CaptureError::invalid(
            &intri,
            key,
            "no lens distortion (undistort the frames)",
            format!("{lens:?}"),
        ));
    }
    let matrix = match outer.contains_key(&format!("Rot_{name}")) {
        true => {
            let key = format!("Rot_{name}");
            let values = finite(&extri, &outer, key.clone(), 9)?;
            turn(&values).ok_or_else(|| CaptureError::invalid(&extri, key, "a rotation", format!("{values:?}")))?
        }
        false => rotation(DVec3::from_slice(&finite(&extri, &outer, format!("R_{name}"), 3)?)),
    };
    let translation = DVec3::from_slice(&finite(&extri, &outer, format!("T_{name}"), 3)?);
    Ok(Camera { rotation: matrix, translation, focal: [k[0], k[4]], centre: [k[2], k[5]] })
}
