//! Fits that are points: arrays of joints, and the body that is fitted to points.

use std::path::Path;

use glam::{DVec3, Vec3};
use point_fit::{Anchor, Fitted, joint_set, joint_sets};
use smpl::BodyModel;

use super::file::{array, value};
use super::fit::{Fit, FitFrame, Person, Tool, vectors};
use super::sam3d::{VERTICES, stride};
use super::video::Video;
use crate::CaptureError;
use crate::item::Item;

/// Reads joints (T,J,3) in camera axes, metres, of a `.npy` file or the only such array of an
/// `.npz`; joints that are NaN are missing. The focal length is not in it: √(W² + H²).
pub(super) fn read(path: &Path, set: &str, count: usize, video: &Video) -> Result<Fit, CaptureError> {
    let expected = format!("shape [frames, {count}, 3], as {set} has");
    let array = array(path, &expected, |shape| shape.len() == 3 && shape[1..] == [count, 3])?;
    let [focal, centre] = video.diagonal();
    let mut frames = Vec::new();
    for (index, joints) in array.to_f64().chunks_exact(3 * count).enumerate() {
        let points = vectors(joints);
        let seen: Vec<DVec3> = points.iter().copied().filter(|p| p.is_finite()).collect();
        if let Some(point) = seen.iter().find(|p| p.z <= 0.0) {
            let expected = "joints in front of the camera, in metres and its axes (x right, y down, z forward)";
            return Err(CaptureError::invalid(path, format!("frame {index}"), expected, point.to_string()));
        }
        if !seen.is_empty() {
            let offset = seen.iter().sum::<DVec3>() / seen.len() as f64;
            frames.push(FitFrame { index, points, offset, focal, centre, ..FitFrame::default() });
        }
    }
    Ok(Fit::of_video(Tool::Joints, vec![Person::new(0, frames)]))
}

/// Number of points of a joint set.
pub(super) fn count(set: &str) -> Result<usize, CaptureError> {
    let points = joint_set(&BodyModel::embedded(), set).map(|points| points.len());
    points.ok_or_else(|| CaptureError::setting("joints", joint_sets().join(", "), set))
}

/// Vertices of MHR, SAM 3D Body's mesh.
pub(super) const MHR: usize = 18439;
/// Faces of the open body on which those of MHR's vertices that are read lie: the median over four
/// people of the points nearest to `pred_vertices`, on the body fitted to their key points.
#[rustfmt::skip]
const FACES: [u16; 128] = [
    6094, 2637, 2742, 6871, 2489, 118, 24, 4835, 6042, 2526, 17, 313, 6102, 2509, 3870, 6871, 2544, 5956, 31,
    10411, 13039, 9623, 13049, 7079, 13759, 12993, 9446, 12851, 10371, 10384, 9513, 9444, 10384, 11723, 10656,
    13758, 12832, 9430, 6906, 6146, 384, 1943, 1946, 2087, 411, 1847, 2021, 3798, 12222, 12108, 8688, 10751,
    12027, 8887, 12234, 7235, 618, 4529, 4600, 4646, 4700, 5058, 4954, 1335, 4976, 4978, 943, 4487, 4393, 871,
    4299, 847, 973, 885, 4423, 4367, 981, 826, 6762, 5610, 2238, 5774, 2398, 5839, 2855, 2782, 2905, 6279,
    6405, 6497, 6480, 6794, 7539, 11740, 8052, 8111, 11609, 11769, 11696, 8448, 8233, 11160, 7725, 11383, 7931,
    11306, 11214, 11223, 11292, 7868, 7852, 11186, 11180, 11287, 9066, 12552, 13639, 12672, 13632, 9810, 9673,
    9732, 9912, 9781, 13294, 10191, 13684, 9947,
];

/// The body's points that the vertices of a person after its key points lie on, of `vertices` in
/// all: by the mapping file `map`, `triangle_ids` (V) and `baryc_coords` (V,3); without one the
/// open body's, if `model` is `open` and the mesh MHR.
pub(super) fn mapped(
    fit: &Path,
    map: Option<&Path>,
    vertices: usize,
    model: &BodyModel,
    open: bool,
) -> Result<Vec<Anchor>, CaptureError> {
    let anchor = |corners: [u32; 3], weights: &[f64]| {
        let vertices = corners.into_iter().zip(weights).map(|(v, weight)| (v as usize, *weight as f32));
        Anchor { joints: Vec::new(), vertices: vertices.collect() }
    };
    let Some(map) = map else {
        let faces = FACES.iter().filter(|_| open && vertices == MHR).filter_map(|f| model.faces.get(usize::from(*f)));
        return Ok(faces.map(|corners| anchor(*corners, &[1.0 / 3.0; 3])).collect());
    };
    if vertices == 0 {
        return Err(CaptureError::invalid(fit, VERTICES, "this key of SAM 3D Body, for the vertex map", "none"));
    }
    let value = value(map, "a vertex map (MHR's smpl2mhr_mapping.npz)")?;
    let root = Item::new(map, &value);
    let (faces, weights) = (root.get("triangle_ids")?, root.get("baryc_coords")?);
    let (ids, rows) = (faces.indices()?, weights.rows(3)?);
    if ids.len() != vertices || rows.len() != vertices {
        let expected = format!("a triangle of the body for each of {vertices} {VERTICES} (MHR's smpl2mhr_mapping.npz)");
        return Err(faces.invalid(expected, format!("{} and {} {}", ids.len(), rows.len(), "baryc_coords")));
    }
    let point = |(id, row): (&usize, &Vec<f64>)| {
        let of = || faces.invalid(format!("triangles below {}, as the body has", model.faces.len()), id.to_string());
        if (row.iter().sum::<f64>() - 1.0).abs() > 1e-3 {
            return Err(weights.invalid("weights that sum to 1", format!("{row:?}")));
        }
        Ok(anchor(*model.faces.get(*id).ok_or_else(of)?, row))
    };
    ids.iter().zip(&rows).step_by(stride(vertices)).map(point).collect()
}

/// Fits `model` to a person's points, and to the vertices after them that lie on `mapped`: poses,
/// places and one shape. Returns what to say of it.
pub(super) fn solve(
    path: &Path,
    set: &str,
    mapped: Vec<Anchor>,
    person: &mut Person,
    model: &BodyModel,
) -> Result<String, CaptureError> {
    /// Largest distance from a mesh that the map is of, beside noise, metres.
    const MAPPED: f64 = 0.06;
    let invalid =
        |expected: String, found: String| CaptureError::invalid(path, format!("person {}", person.id), expected, found);
    let is_mapped = !mapped.is_empty();
    let mut points = joint_set(model, set)
        .ok_or_else(|| invalid("a body with SMPL's joints".to_owned(), format!("{} joints", model.num_joints())))?;
    points.extend(mapped.into_iter().map(Some));
    let anchors: Vec<_> = points.iter().flatten().cloned().collect();
    let first = person.frames.first().map_or(0, |frame| frame.index);
    let last = person.frames.last().map_or(0, |frame| frame.index);
    let mut seen = vec![Vec3::NAN; (last - first + 1) * anchors.len()];
    for frame in &person.frames {
        let known = frame.points.iter().zip(&points).filter(|(_, anchor)| anchor.is_some());
        let row = &mut seen[(frame.index - first) * anchors.len()..][..anchors.len()];
        row.iter_mut().zip(known).for_each(|(to, (point, _))| *to = point.as_vec3());
    }
    let Fitted { betas, frames, noise } = point_fit::fit(model, &anchors, &seen)
        .map_err(|error| invalid("points of a body".to_owned(), error.to_string()))?;
    let mut swapped = Vec::new();
    let mut squares = Vec::new();
    for frame in &mut person.frames {
        let found = &frames[frame.index - first];
        frame.pose = found.pose.iter().map(|v| v.as_dvec3()).collect();
        frame.offset = found.translation.as_dvec3();
        frame.betas = betas.iter().map(|b| f64::from(*b)).collect();
        squares.extend(found.distance.map(|d| f64::from(d).powi(2)));
        if found.swapped {
            swapped.push(frame.index.to_string());
        }
    }
    let off = (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
    if is_mapped && off > MAPPED + 2.0 * f64::from(noise) {
        let found = format!("{:.0} mm off", 1e3 * off);
        return Err(invalid(format!("a body that the vertex map is of (--body), and {VERTICES} on it"), found));
    }
    let swapped = match swapped.len() {
        0 => String::new(),
        n => format!(
            "; left and right exchanged in {n} frames ({}{})",
            swapped[..n.min(8)].join(", "),
            if n > 8 { ", …" } else { "" }
        ),
    };
    Ok(format!(
        "fit: the body's points are {:.0} mm off (noise between frames {:.0} mm){swapped}",
        1e3 * off,
        1e3 * noise
    ))
}
