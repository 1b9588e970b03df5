//! Data sets with fits: PeopleSnapshot and NeuMan.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::pickle;
use glam::{DMat3, DQuat, DVec3};

use super::file::{text, value};
use super::fit::{About, BETAS, Fit, FitFrame, Lens, ORTHONORMAL, Person, SMPL, Tool, axis_angle, pinhole, rotation};
use super::video::Video;
use crate::CaptureError;
use crate::item::Item;

/// PeopleSnapshot as InstantAvatar prepares it: `poses.npz` {`betas` (10), `transl` (N,3), and
/// `thetas` (N,72) or `global_orient` (N,3) and `body_pose` (N,69)}, a row a frame; beside it or in
/// the folder above `cameras.npz` {`intrinsic` (3,3), `extrinsic` (4,4) world to camera, `height`,
/// `width`}. The root turns about the pelvis. GaussianAvatar makes of it `smpl_parms.pth` {`beta`
/// (1,10), `body_pose` (N,72), `trans` (N,3)} and `cam_parms.npz` {`intrinsic`, `extrinsic`}.
pub(super) fn peoplesnapshot(tool: Tool, fit: &Item<'_>, video: &Video) -> Result<Fit, CaptureError> {
    let is_prepared = tool == Tool::PeopleSnapshot;
    let name = if is_prepared { "cameras.npz" } else { "cam_parms.npz" };
    let near = fit.path.ancestors().skip(1).take(2).map(|dir| dir.join(name)).find(|file| file.is_file());
    let absent = || CaptureError::missing(&fit.path.with_file_name(name), "file (nor in the folder above): the camera");
    let cameras = near.ok_or_else(absent)?;
    let camera = value(&cameras, "an archive of the camera")?;
    let camera = Item::new(&cameras, &camera);
    for (key, side) in ["width", "height"].into_iter().zip(video.sides()).filter(|_| is_prepared) {
        let given = camera.get(key)?;
        let found = given.number()?;
        if found != side {
            return Err(given.invalid(format!("{side}, as the frames"), found.to_string()));
        }
    }
    let (mut rows, shape, place) = match (is_prepared, fit.find("thetas").is_some()) {
        (false, _) => (fit.table(None, &[("body_pose", 3 * SMPL)])?, "beta", "trans"),
        (true, true) => (fit.table(None, &[("thetas", 3 * SMPL)])?, "betas", "transl"),
        (true, false) => (fit.table(None, &[("global_orient", 3), ("body_pose", 3 * SMPL - 3)])?, "betas", "transl"),
    };
    let (shape, place) = (fit.get(shape)?, fit.get(place)?);
    let betas = match is_prepared {
        true => shape.numbers(&[Some(1), Some(BETAS)])?,
        false => shape.rows(BETAS)?.into_iter().next().ok_or_else(|| shape.invalid("a row", "none"))?,
    };
    let places = place.rows(3)?;
    place.as_long(rows.len(), places.len())?;
    // The frames of a partial split are unknown.
    if places.len() < video.names.len() {
        let expected = format!("{} rows, one a frame of the video", video.names.len());
        return Err(place.invalid(expected, places.len().to_string()));
    }
    let lens = pinhole(&camera.get("intrinsic")?.numbers(&[Some(3), Some(3)])?);
    let extrinsic = camera.get("extrinsic")?;
    let (turn, moved) = extrinsic.rigid(&extrinsic.numbers(&[Some(4), Some(4)])?, ORTHONORMAL)?;
    rows.iter_mut().zip(&places).for_each(|(row, place)| row.extend(betas.iter().chain(place)));
    let frames = rows.iter().enumerate().map(|(index, row)| {
        let still = FitFrame::still(index, row, lens);
        let offset = turn * still.offset + moved;
        FitFrame { world_to_camera: turn, about: About::Origin(turn), offset, ..still }
    });
    Ok(Fit::of_video(tool, vec![Person::new(0, frames)]))
}

/// A scene of NeuMan: `smpl_output_*.pkl`, a person {`pose` (N,72), `betas` (N,10)} without a
/// place; beside it `alignments.npy`, by picture a matrix (4,3) that takes a row (x, y, z, 1) of
/// the body to the scene, in which lengths have another unit, and COLMAP's `sparse/cameras.txt` and
/// `sparse/images.txt`. Picture `00012.png` is row 12. What lenses do beyond a pinhole is passed
/// over, as NeuMan's own reader does.
pub(super) fn neuman(path: &Path, people: &[(String, Item<'_>)], video: &Video) -> Result<Fit, CaptureError> {
    let (aligned, sparse) = (path.with_file_name("alignments.npy"), path.with_file_name("sparse"));
    let alignments = pickle::read(&aligned)?;
    let alignments = Item::new(&aligned, &alignments);
    let lenses = lenses(&sparse.join("cameras.txt"), video)?;
    let images = sparse.join("images.txt");
    let lines = text(&images)?;
    let (mut read, mut names, mut index) = (Vec::new(), Vec::new(), BTreeMap::new());
    for (id, item) in people {
        let poses = item.table(None, &[("pose", 3 * SMPL), ("betas", BETAS)])?;
        let mut frames = Vec::new();
        // Every second line has the points in a picture, and may be empty.
        for (line, fields) in rows(&lines).step_by(2).filter(|(_, fields)| !fields.is_empty()) {
            let invalid = |expected: &str, found: &str| {
                CaptureError::invalid(&images, format!("line {line}"), expected.to_owned(), found.to_owned())
            };
            let [_, numbers @ .., camera, name] = fields.as_slice() else {
                return Err(invalid("a picture: id, QW, QX, QY, QZ, TX, TY, TZ, camera, name", &fields.join(" ")));
            };
            let Some([w, x, y, z, tx, ty, tz]) = finite(numbers) else {
                return Err(invalid("a rotation (4) and a translation (3)", &numbers.join(" ")));
            };
            let lens = *lenses.get(*camera).ok_or_else(|| invalid("a camera of cameras.txt", camera))?;
            let stem = Path::new(name).file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
            let index = *index.entry(stem.to_owned()).or_insert_with(|| {
                names.push(stem.to_owned());
                names.len() - 1
            });
            let row = stem.parse::<usize>().ok().filter(|row| *row < poses.len());
            let row = row.ok_or_else(|| invalid(&format!("a number below {}, the poses", poses.len()), name))?;
            let quaternion = DQuat::from_xyzw(x, y, z, w);
            if (quaternion.length() - 1.0).abs() > 1e-2 {
                return Err(invalid("a unit quaternion", &numbers.join(" ")));
            }
            let camera = DMat3::from_quat(quaternion.normalize());
            let alignment = alignments.get(name)?;
            let a = alignment.numbers(&[Some(4), Some(3)])?;
            let column = |i: usize| DVec3::from_slice(&a[3 * i..]);
            let scaled = DMat3::from_cols(column(0), column(1), column(2));
            let scale = scaled.determinant().cbrt();
            let turn = (scaled.transpose() * scale.recip()).to_cols_array();
            let turn = alignment.rotation(&turn, ORTHONORMAL)?;
            let offset = (camera * column(3) + DVec3::new(tx, ty, tz)) / scale;
            let mut frame = FitFrame::still(index, &[&poses[row][..], &offset.to_array()].concat(), lens);
            frame.pose[0] = axis_angle(turn * rotation(frame.pose[0]));
            frames.push(FitFrame { world_to_camera: camera, about: About::Origin(camera * turn), ..frame });
        }
        read.push(Person::new(id, frames));
    }
    Ok(Fit { tool: Tool::NeuMan, people: read, names: Some(names) })
}

/// Focal lengths and principal point of each camera.
fn lenses(path: &Path, video: &Video) -> Result<BTreeMap<String, Lens>, CaptureError> {
    let mut found = BTreeMap::new();
    let lines = text(path)?;
    for (line, fields) in rows(&lines).filter(|(_, fields)| !fields.is_empty()) {
        let invalid =
            |expected: String| CaptureError::invalid(path, format!("line {line}"), expected, fields.join(" "));
        let [id, model, width, height, rest @ ..] = fields.as_slice() else {
            return Err(invalid("a camera: id, model, width, height, numbers".to_owned()));
        };
        let [wide, high] = video.sides();
        if finite(&[width, height]) != Some([wide, high]) {
            return Err(invalid(format!("{wide}×{high}, as the frames")));
        }
        let values = match *model {
            "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" => {
                rest.get(..3).and_then(finite).map(|[f, x, y]: [f64; 3]| [[f; 2], [x, y]])
            }
            "PINHOLE" | "OPENCV" => rest.get(..4).and_then(finite).map(|[f, g, x, y]: [f64; 4]| [[f, g], [x, y]]),
            _ => None,
        };
        let expected = || invalid("(SIMPLE_)PINHOLE, SIMPLE_RADIAL or OPENCV and its numbers".to_owned());
        found.insert((*id).to_owned(), values.ok_or_else(expected)?);
    }
    Ok(found)
}

/// Lines that are no comments: their numbers and words.
fn rows(text: &str) -> impl Iterator<Item = (usize, Vec<&str>)> {
    let lines = text.lines().enumerate().filter(|(_, line)| !line.starts_with('#'));
    lines.map(|(i, line)| (i + 1, line.split_whitespace().collect()))
}

/// `N` finite numbers.
fn finite<const N: usize>(fields: &[&str]) -> Option<[f64; N]> {
    let numbers = fields.iter().map(|field| field.parse().ok().filter(|x: &f64| (*x as f32).is_finite()));
    numbers.collect::<Option<Vec<f64>>>()?.try_into().ok()
}
