//! SAM 3D Body's list of dictionaries, one a person: `pred_keypoints_3d` (70,3) in camera axes from
//! a place at `pred_cam_t` (3), `focal_length`, `pred_keypoints_2d` (70,2), `mask`, `pred_vertices`
//! (V,3) in the axes of the points. Saved by `.npz`, `.npy`, pickle or JSON: a folder with a file a
//! frame, or one file with a list of frames, or a dictionary of them by name.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use array_files::pickle::Value;
use glam::{DVec2, DVec3};

use super::file::value;
use super::fit::{Fit, FitFrame, OwnMask, Person, Tool, vectors};
use super::video::Video;
use crate::CaptureError;
use crate::item::Item;
use crate::names::{FrameName, number};
use crate::pictures::{file_name, listed};

const POINTS: &str = "pred_keypoints_3d";
/// Joint set of the points.
pub(super) const SET: &str = "mhr70";
const COUNT: usize = 70;
/// Vertices; every [`stride`]-th follows the points.
pub(super) const VERTICES: &str = "pred_vertices";
/// Most people of a picture, whose pairs with those of earlier ones are compared.
const MAX_PEOPLE: usize = 256;
/// Bones that tell people's sizes: upper arms, thighs and shins.
const BONES: [[usize; 2]; 6] = [[5, 7], [6, 8], [9, 11], [10, 12], [11, 13], [12, 14]];

/// Step between the vertices that follow the points: at most 128 do.
pub(super) fn stride(vertices: usize) -> usize {
    vertices.div_ceil(128).max(1)
}

/// The people of one picture; `None` for another kind of value.
fn people(value: &Value) -> Option<&[Value]> {
    match value {
        Value::Dict(_) if value.get(POINTS).is_some() => Some(std::slice::from_ref(value)),
        // An archive of one array.
        Value::Dict(entries) if entries.len() == 1 => people(&entries[0].1),
        _ => value.items().filter(|items| items.iter().all(|item| item.get(POINTS).is_some())),
    }
}

/// The frames in a file's value, named or in order; `None` for another kind of file.
pub(super) fn frames(value: &Value, video: &Video) -> Option<Vec<(Option<String>, Value)>> {
    let list = |people: &[Value]| Value::List(people.to_vec());
    let inner = match value {
        Value::Dict(entries) if entries.len() == 1 && entries[0].1.items().is_some() => &entries[0].1,
        _ => value,
    };
    if let Value::Dict(entries) = inner
        && !entries.is_empty()
        && inner.get(POINTS).is_none()
    {
        let stem = |name: &str| Path::new(name).file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let entry = |(name, value): &(Value, Value)| Some((Some(stem(name.as_str()?)?), list(people(value)?)));
        return entries.iter().map(entry).collect();
    }
    match people(inner) {
        // Of one picture all people, of a video one person a frame.
        Some(all) if video.names.len() > 1 && all.len() == video.names.len() => {
            Some(all.iter().map(|person| (None, list(std::slice::from_ref(person)))).collect())
        }
        Some([]) => None,
        Some(all) => Some(vec![(None, list(all))]),
        None => inner.items()?.iter().map(|frame| Some((None, list(people(frame)?)))).collect(),
    }
}

/// Reads a folder with a file a frame; `None` where its first file is not of this kind.
pub(super) fn folder(dir: &Path, video: &Video) -> Result<Option<Fit>, CaptureError> {
    let mut files: BTreeMap<usize, PathBuf> = BTreeMap::new();
    for (stem, path) in listed(dir, &["npz", "npy", "pkl", "json"])? {
        let Some(number) = number(&stem) else { continue };
        if let Some(other) = files.insert(number, path.clone()) {
            let mut both = [file_name(&other), file_name(&path)];
            both.sort();
            return Err(CaptureError::invalid(dir, format!("number {number}"), "one file a frame", both.join(" and ")));
        }
    }
    let mut named = Vec::new();
    for path in files.values() {
        let expected = format!("a list of people with {POINTS}");
        let value = value(path, &expected)?;
        let Some(people) = people(&value) else {
            if named.is_empty() {
                return Ok(None);
            }
            return Err(CaptureError::invalid(path, "the file", expected, value.type_name()));
        };
        let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned());
        named.push((stem, Value::List(people.to_vec()), path.as_path()));
    }
    if named.is_empty() {
        return Ok(None);
    }
    fit(named, video).map(Some)
}

/// Reads the frames of one file.
pub(super) fn read(path: &Path, frames: Vec<(Option<String>, Value)>, video: &Video) -> Result<Fit, CaptureError> {
    let mut frames: Vec<_> = frames.into_iter().map(|(name, value)| (name, value, path)).collect();
    if frames.iter().any(|(name, ..)| name.is_some()) {
        let name = |name: &Option<String>| name.clone().unwrap_or_default();
        frames.sort_by(|a, b| FrameName(&name(&a.0)).cmp(&FrameName(&name(&b.0))));
        if let Some(pair) = frames.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            return Err(CaptureError::invalid(path, name(&pair[0].0), "each frame once", "it twice"));
        }
    }
    fit(frames, video)
}

/// The state by which a person is found in the next frame.
struct Track {
    place: DVec3,
    motion: DVec3,
    size: f64,
    last: usize,
    person: Person,
}

fn fit(frames: Vec<(Option<String>, Value, &Path)>, video: &Video) -> Result<Fit, CaptureError> {
    let mut tracks: Vec<Track> = Vec::new();
    let mut projected: Vec<(DVec2, DVec2)> = Vec::new();
    let (mut unknown, mut rows) = (None, None);
    for (index, (name, value, path)) in frames.iter().enumerate() {
        let root = Item { path, key: name.clone().unwrap_or_else(|| index.to_string()), value };
        let (mut found, people) = (Vec::new(), root.list()?);
        if people.len() > MAX_PEOPLE {
            return Err(root.invalid(format!("at most {MAX_PEOPLE} people"), people.len().to_string()));
        }
        for person in people {
            let item = person.get(POINTS)?;
            let (points, at) = (item.numbers(&[Some(1), Some(COUNT), Some(3)])?, person.get("pred_cam_t")?);
            let at = DVec3::from_slice(&at.numbers(&[Some(3)])?);
            let mut points: Vec<DVec3> = vectors(&points).into_iter().map(|p| p + at).collect();
            if let Some(behind) = points.iter().find(|p| p.z <= 0.0) {
                return Err(item.invalid("points in front of the camera, with pred_cam_t", behind.to_string()));
            }
            let focal = person.find("focal_length").map(|item| item.number()).transpose()?;
            if focal.is_none() {
                let pixels = person.get("pred_keypoints_2d")?.numbers(&[Some(1), Some(COUNT), Some(2)])?;
                let pairs = points.iter().zip(pixels.chunks_exact(2));
                projected.extend(pairs.map(|(p, uv)| (p.truncate() / p.z, DVec2::from_slice(uv))));
                unknown.get_or_insert_with(|| (*path, person.key.clone()));
            }
            if let Some(item) = person.find(VERTICES) {
                let vertices = item.rows(3)?;
                let known = *rows.get_or_insert(vertices.len());
                if vertices.len() != known {
                    return Err(item.invalid(format!("{known} rows, as before"), vertices.len().to_string()));
                }
                points.extend(vertices.iter().step_by(stride(known)).map(|p| DVec3::from_slice(p) + at));
            }
            let mask = person.find("mask").map(|item| mask(&item)).transpose()?;
            let [focal, centre] = video.lens(focal.unwrap_or(0.0));
            found.push(FitFrame { index, points, mask, offset: at, focal, centre, ..FitFrame::default() });
        }
        assign(&mut tracks, found, index);
    }
    if let Some((path, key)) = unknown {
        let (focal, centre) = solved(&projected).ok_or_else(|| {
            CaptureError::invalid(path, key, "pred_keypoints_2d that one camera projects, or focal_length", "others")
        })?;
        let frames = tracks.iter_mut().flat_map(|track| &mut track.person.frames);
        for frame in frames.filter(|frame| frame.focal[0] == 0.0) {
            (frame.focal, frame.centre) = ([focal; 2], centre.to_array());
        }
    }
    let names: Option<Vec<String>> = frames.into_iter().map(|(name, ..)| name).collect();
    let vertices = rows.unwrap_or(0);
    let people = tracks.into_iter().map(|track| Person { vertices, ..track.person }).collect();
    Ok(Fit { tool: Tool::Sam3dBody, people, names })
}

/// Assigns the people of a frame to those of earlier frames: nearest pairs first, by the distance
/// from the extrapolated place, in which depth has a low weight, and by the size of bones.
fn assign(tracks: &mut Vec<Track>, found: Vec<FitFrame>, index: usize) {
    const METRES: f64 = 1.5;
    const DEPTH: f64 = 0.4;
    /// Metres that a size of e times another counts.
    const SIZE: f64 = 2.0;
    let describe = |frame: &FitFrame| {
        let middle = frame.points[..COUNT].iter().sum::<DVec3>() / COUNT as f64;
        (middle, BONES.iter().map(|[a, b]| frame.points[*a].distance(frame.points[*b])).sum::<f64>().max(1e-3))
    };
    let described: Vec<(DVec3, f64)> = found.iter().map(describe).collect();
    let mut pairs = Vec::new();
    for (t, track) in tracks.iter().enumerate() {
        // Motion is believed for half a second.
        let wait = (index - track.last) as f64;
        let expected = track.place + track.motion * wait.min(15.0);
        for (i, (middle, size)) in described.iter().enumerate() {
            let off = ((*middle - expected) * DVec3::new(1.0, 1.0, DEPTH)).length();
            let cost = off + SIZE * (size / track.size).ln().abs();
            if cost < METRES {
                pairs.push((cost, t, i));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut of: Vec<Option<usize>> = vec![None; found.len()];
    for (_, t, i) in pairs {
        if of[i].is_none() && !of.contains(&Some(t)) {
            of[i] = Some(t);
        }
    }
    for ((frame, of), (place, size)) in found.into_iter().zip(of).zip(described) {
        match of.map(|t| &mut tracks[t]) {
            Some(track) => {
                let motion = (place - track.place) / (index - track.last) as f64;
                track.motion += 0.3 * (motion - track.motion);
                track.size += 0.1 * (size - track.size);
                (track.place, track.last) = (place, index);
                track.person.frames.push(frame);
            }
            None => {
                let person = Person::new(tracks.len(), [frame]);
                tracks.push(Track { place, motion: DVec3::ZERO, size, last: index, person });
            }
        }
    }
}

/// Focal length and principal point of points (x/z, y/z) and their pixels, by least squares; `None`
/// unless they fit to some pixels.
fn solved(pairs: &[(DVec2, DVec2)]) -> Option<(f64, DVec2)> {
    const PIXELS: f64 = 10.0;
    let count = pairs.len() as f64;
    let sum = pairs.iter().fold([DVec2::ZERO; 2], |[a, b], pair| [a + pair.0, b + pair.1]);
    let [x, u] = sum.map(|sum| sum / count);
    let across: f64 = pairs.iter().map(|pair| (pair.0 - x).dot(pair.1 - u)).sum();
    let focal = across / pairs.iter().map(|pair| (pair.0 - x).length_squared()).sum::<f64>();
    let centre = u - focal * x;
    let off = pairs.iter().map(|pair| (focal * pair.0 + centre).distance_squared(pair.1)).sum::<f64>() / count;
    (focal >= 1.0 && off.sqrt() < PIXELS).then_some((focal, centre))
}

/// `mask` (H,W), axes of length 1 left out.
fn mask(item: &Item<'_>) -> Result<OwnMask, CaptureError> {
    let array = item.array()?;
    let shape: Vec<usize> = array.shape.iter().copied().filter(|n| *n != 1).collect();
    let &[height, width] = shape.as_slice() else {
        return Err(item.invalid("shape [_, _]", format!("shape {:?}", array.shape)));
    };
    Ok(OwnMask::Pixels(height, width, array.to_f64().iter().map(|level| *level > 0.0).collect()))
}
