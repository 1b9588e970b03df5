//! A scene of NeuMan: `smpl_output_*.pkl`, a person {`pose` (N,72), `betas` (N,10)} without a
//! place; beside it `alignments.npy`, by picture a matrix (4,3) that takes a row (x, y, z, 1) of the
//! body to the scene, in which lengths have another unit, and COLMAP's `sparse/cameras.txt` and
//! `sparse/images.txt`. Picture `00012.png` is row 12. What lenses do beyond a pinhole is passed
//! over, as NeuMan's own reader does.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::pickle;
use glam::{DMat3, DQuat, DVec3};

use super::fit::{About, BETAS, Fit, FitFrame, Person, SMPL, Tool, axis_angle, rotation};
use super::item::{Item, text, vectors};
use super::video::Video;
use crate::CaptureError;

pub(super) fn read(path: &Path, people: &[(String, Item<'_>)], video: &Video) -> Result<Fit, CaptureError> {
    let (aligned, sparse) = (path.with_file_name("alignments.npy"), path.with_file_name("sparse"));
    let alignments = pickle::read(&aligned)?;
    let alignments = Item::new(&aligned, &alignments);
    let lenses = lenses(&sparse.join("cameras.txt"), video)?;
    let images = sparse.join("images.txt");
    let lines = text(&images)?;
    let (mut read, mut names, mut index) = (Vec::new(), Vec::new(), BTreeMap::new());
    for (id, item) in people {
        let (pose, shape) = (item.get("pose")?, item.get("betas")?);
        let (poses, shapes) = (pose.rows(3 * SMPL)?, shape.rows(BETAS)?);
        shape.as_long(poses.len(), shapes.len())?;
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
            let turn = alignment.rotation(&(scaled.transpose() * scale.recip()).to_cols_array())?;
            let mut pose = vectors(&poses[row]);
            pose[0] = axis_angle(turn * rotation(pose[0]));
            frames.push(FitFrame {
                world_to_camera: camera,
                about: About::Origin(camera * turn),
                offset: (camera * column(3) + DVec3::new(tx, ty, tz)) / scale,
                ..FitFrame::still(index, pose, shapes[row].clone(), &a, lens)
            });
        }
        read.push(Person { id: id.clone(), frames, ..Person::default() });
    }
    Ok(Fit { tool: Tool::NeuMan, people: read, names: Some(names) })
}

/// Focal lengths and principal point of each camera.
fn lenses(path: &Path, video: &Video) -> Result<BTreeMap<String, [[f64; 2]; 2]>, CaptureError> {
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

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use super::*;
    use crate::import::read;
    use crate::import::tests::{Motion, known};
    use crate::testing::{Directory, Py, array, shared};

    #[test]
    fn what_is_aligned_to_a_known_motion_is_that_motion() {
        let Some(dir) = shared("estimators") else { return };
        let motion = known(&dir);
        let Motion { k, betas, poses, pelvises, .. } = &motion;
        let joint = motion.joint;
        // Pictures are named by the rows of the poses.
        let names = (0..poses.len()).map(|i| format!("{i:05}")).collect();
        let video = Video { names, paths: motion.video.paths.clone(), size: motion.video.size };
        let out = Directory::new("import-neuman");
        // A camera that moves, and a scene in which a metre is 0.3.
        let (scale, mut images, mut alignments) = (0.3, String::from("# Image list\n"), Vec::new());
        let mut bodies = Vec::new();
        for (i, (pose, pelvis)) in poses.iter().zip(pelvises).enumerate() {
            let by = i as f64 * 0.01;
            let quaternion = DQuat::from_scaled_axis(DVec3::new(0.1 + by, -0.3, 0.2 * by));
            let (camera, moved) = (DMat3::from_quat(quaternion), DVec3::new(by, 0.2, -0.1));
            let turn = rotation(DVec3::new(2.9, by, 0.1));
            bodies.push(axis_angle((camera * turn).transpose() * rotation(pose[0])));
            bodies.extend(&pose[1..]);
            let offset = camera.transpose() * (*pelvis * scale - moved) - scale * (turn * joint);
            let matrix = [turn.x_axis * scale, turn.y_axis * scale, turn.z_axis * scale, offset];
            let values: Vec<f64> = matrix.iter().flat_map(|v| v.to_array()).collect();
            alignments.push((format!("{i:05}.png"), array(&[4, 3], &values)));
            let (q, t) = (quaternion, moved);
            writeln!(images, "{} {} {} {} {} {} {} {} 1 {i:05}.png", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z).unwrap();
            images.push_str(if i % 2 == 0 { "\n" } else { "12.5 30.25 -1 18 22 7\n" });
        }
        let count = poses.len() as u32;
        let bodies: Vec<f64> = bodies.iter().flat_map(|v| v.to_array()).collect();
        let person = Py::record([
            ("pose", array(&[count, 72], &bodies)),
            ("betas", array(&[count, 10], &betas.repeat(poses.len()))),
        ]);
        out.write("smpl_output_romp.pkl", Py::Dict(vec![("1".to_owned(), person)]).pickle());
        out.write("alignments.npy", Py::Dict(alignments).npy());
        let cameras = format!("# Camera list\n1 OPENCV 256 256 {} {} {} {} 0.01 0 0 0\n", k[0], k[4], k[2], k[5]);
        out.write("sparse/cameras.txt", &cameras);
        out.write("sparse/images.txt", &images);
        let (fit, _) = read::read(&out.path().join("smpl_output_romp.pkl"), &video).unwrap();
        assert_eq!((fit.tool, fit.people[0].id.as_str(), fit.people[0].frames.len()), (Tool::NeuMan, "1", poses.len()));
        motion.is_of(&fit.people[0]);
        let refused = |file: &str, text: &str, words: &[&str]| {
            let before = std::fs::read(out.path().join(file)).unwrap();
            out.write(file, text);
            let error = read::read(&out.path().join("smpl_output_romp.pkl"), &video).err().unwrap().to_string();
            out.write(file, before);
            assert!(words.iter().chain(&[file]).all(|word| error.contains(word)), "{error}");
        };
        refused("sparse/cameras.txt", &cameras.replace("OPENCV", "FISHEYE"), &["line 2", "PINHOLE", "FISHEYE"]);
        refused("sparse/cameras.txt", &cameras.replace("256 256", "256 512"), &["256×256, as the frames"]);
        refused("sparse/images.txt", "1 1 0 0 0 0 0 0 2 00000.png", &["line 1", "camera of cameras.txt", "found 2"]);
        refused("sparse/images.txt", "1 1 0 0 0 0 0 0 1 00099.png", &["a number below", "00099.png"]);
        refused("sparse/images.txt", "1 1 0 0 nan 0 0 0 1 00000.png", &["rotation (4)", "nan"]);
        refused("sparse/images.txt", "1 9 0 0 0 0 0 0 1 00000.png", &["unit quaternion"]);
    }
}
