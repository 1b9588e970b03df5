//! CLIFF's `NAME_cliff_hr48.npz`, a row a person of a picture: `pose` (N,72) or (N,24,3,3), `shape`
//! (N,10), `global_t` (N,3), `focal_l` (N), and `detection_all` (N, K), whose first column is the
//! picture's index. People are told apart by their places.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::npz::Npz;
use array_files::pickle::Value;
use glam::DVec3;

use super::fit::{BETAS, Fit, FitFrame, Person, SMPL, Tool, axis_angle};
use super::item::{Item, vectors};
use super::romp::tracked;
use super::video::Video;
use crate::CaptureError;

/// Names of the arrays that are read.
pub(super) const KEYS: [&str; 5] = ["pose", "shape", "global_t", "focal_l", "detection_all"];

pub(super) fn read(path: &Path, npz: &mut Npz, video: &Video) -> Result<Fit, CaptureError> {
    let entries = KEYS.iter().map(|key| Ok((Value::Str((*key).to_owned()), npz.value(key)?)));
    let root = Value::Dict(entries.collect::<Result<_, array_files::Error>>()?);
    let root = Item::new(path, &root);
    let (pose, detected) = (root.get("pose")?, root.get("detection_all")?);
    let places = root.get("global_t")?.rows(3)?;
    let shapes = root.get("shape")?.numbers(&[Some(places.len()), Some(BETAS)])?;
    let focals = root.get("focal_l")?.numbers(&[Some(places.len())])?;
    let poses: Vec<DVec3> = match pose.array()?.shape.len() {
        4 => {
            let matrices = pose.numbers(&[Some(places.len()), Some(SMPL), Some(3), Some(3)])?;
            matrices.chunks_exact(9).map(|m| Ok(axis_angle(pose.rotation(m)?))).collect::<Result<_, CaptureError>>()?
        }
        _ => vectors(&pose.numbers(&[Some(places.len()), Some(3 * SMPL)])?),
    };
    let columns = detected.array()?.shape.last().copied().unwrap_or(0).max(1);
    let mut pictures: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (row, detection) in detected.numbers(&[Some(places.len()), Some(columns)])?.chunks_exact(columns).enumerate() {
        let index = detection[0];
        if !(index >= 0.0 && index.fract() == 0.0 && index < 1e9) {
            return Err(detected.invalid("indices of pictures in the first column", format!("{index} at {row}")));
        }
        pictures.entry(index as usize).or_default().push(row);
    }
    let mut people: BTreeMap<i64, Person> = BTreeMap::new();
    let mut last = BTreeMap::new();
    for (index, rows) in pictures {
        let here: Vec<Vec<f64>> = rows.iter().map(|&row| places[row].clone()).collect();
        for (row, id) in rows.into_iter().zip(tracked(&here, &mut last)) {
            let (pose, betas) = (poses[SMPL * row..][..SMPL].to_vec(), shapes[BETAS * row..][..BETAS].to_vec());
            let frame = FitFrame::still(index, pose, betas, &places[row], [[focals[row]; 2], video.middle()]);
            people.entry(id).or_insert_with(|| Person { id: id.to_string(), ..Person::default() }).frames.push(frame);
        }
    }
    Ok(Fit { tool: Tool::Cliff, people: people.into_values().collect(), names: None })
}

#[cfg(test)]
mod tests {
    use array_files::{Data, NdArray, npz};

    use super::*;
    use crate::import::fit::rotation;
    use crate::import::read;
    use crate::import::tests::{Motion, known};
    use crate::testing::{Directory, shared};

    #[test]
    fn rows_of_two_people_in_any_order_are_two_people() {
        let Some(dir) = shared("estimators") else { return };
        let Motion { video, betas, poses, pelvises, joint, .. } = known(&dir);
        let out = Directory::new("import-cliff");
        let path = out.path().join("clip_cliff_hr48.npz");
        let array = |shape: &[usize], values: Vec<f64>| NdArray { shape: shape.to_vec(), data: Data::F64(values) };
        // Another person three metres behind, named first in odd pictures, away in the fifth.
        let rows: Vec<(usize, bool)> = (0..poses.len())
            .flat_map(|i| if i % 2 == 0 { [(i, false), (i, true)] } else { [(i, true), (i, false)] })
            .filter(|row| *row != (5, true))
            .collect();
        let n = rows.len();
        let of = |row: &(usize, bool)| pelvises[row.0] - joint + DVec3::Z * if row.1 { 3.0 } else { 0.0 };
        for matrices in [false, true] {
            let values = |(i, _): &(usize, bool)| -> Vec<f64> {
                match matrices {
                    true => poses[*i].iter().flat_map(|v| rotation(*v).transpose().to_cols_array()).collect(),
                    false => poses[*i].iter().flat_map(|v| v.to_array()).collect(),
                }
            };
            let write = |first: f64| {
                let detected = rows.iter().flat_map(|row| [row.0 as f64 * first, 1.0, 2.0, 3.0, 4.0, 0.9, 0.9, 0.0]);
                let shape: &[usize] = if matrices { &[n, 24, 3, 3] } else { &[n, 72] };
                let arrays = [
                    ("pose", array(shape, rows.iter().flat_map(values).collect())),
                    ("shape", array(&[n, 10], betas.repeat(n))),
                    ("global_t", array(&[n, 3], rows.iter().flat_map(|row| of(row).to_array()).collect())),
                    ("pred_joints", array(&[n, 2, 3], vec![0.0; 6 * n])),
                    ("focal_l", array(&[n], vec![362.0; n])),
                    ("detection_all", array(&[n, 8], detected.collect())),
                ];
                npz::write(&path, &arrays).unwrap();
            };
            write(1.0);
            let (fit, _) = read::read(&path, &video).unwrap();
            let counts: Vec<usize> = fit.people.iter().map(|person| person.frames.len()).collect();
            assert_eq!((fit.tool, counts), (Tool::Cliff, vec![poses.len(), poses.len() - 1]));
            for (i, frame) in fit.people[0].frames.iter().enumerate() {
                assert_eq!((frame.index, frame.focal), (i, [362.0; 2]));
                assert!(frame.pelvis(joint).distance(pelvises[i]) < 1e-5);
                let turns = frame.pose.iter().zip(&poses[i]).map(|(a, b)| (rotation(*a), rotation(*b)));
                turns.for_each(|(a, b)| assert!(a.abs_diff_eq(b, 1e-6)));
            }
            write(0.5);
            let error = read::read(&path, &video).err().unwrap().to_string();
            assert!(error.contains("detection_all") && error.contains("0.5"), "{error}");
        }
    }
}
