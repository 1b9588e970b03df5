//! GVHMR's `hmr4d_results.pt`: `smpl_params_incam` {`body_pose` (L,63), `betas` (L,10),
//! `global_orient` (L,3), `transl` (L,3)} of SMPL-X, and `K_fullimg` (L,3,3). One person in every
//! frame.

use std::io::{Read, Seek};
use std::path::Path;

use array_files::pickle::Value;
use array_files::torch::TorchFile;

use super::fit::{BETAS, Fit, FitFrame, Person, Tool};
use super::item::{Item, vectors};
use super::video::Video;
use crate::CaptureError;

/// Keys of the body's parameters, of GVHMR and of its relative GEM (`smpl_params.pt`), and of the
/// cameras.
const GVHMR: &str = "smpl_params_incam";
const GEM: &str = "body_params_incam";
pub(super) const CAMERAS: &str = "K_fullimg";
/// Joints of the body in `body_pose`.
const BODY: usize = 21;
/// Pixels by which twice the principal point may be off the frames' size.
const SIZE: f64 = 2.0;

pub(super) fn read<R: Read + Seek>(path: &Path, file: &mut TorchFile<R>, video: &Video) -> Result<Fit, CaptureError> {
    let root = file.root().clone();
    let whole = Item::new(path, &root);
    let incam = whole.find(GEM).map_or_else(|| whole.get(GVHMR), Ok)?;
    let cameras = whole.get(CAMERAS)?;
    let params = file.resolve(&incam.key, incam.value)?;
    let cameras_value = file.resolve(&cameras.key, cameras.value)?;
    frames(&Item { value: &params, ..incam }, &Item { value: &cameras_value, ..cameras }, video)
}

/// The same re-saved by numpy, nested or with joined names; `None` where it is not that.
pub(super) fn from_arrays(whole: &Item<'_>, video: &Video) -> Result<Option<Fit>, CaptureError> {
    let Some(cameras) = whole.find(CAMERAS) else { return Ok(None) };
    for name in [GVHMR, GEM] {
        if let Some(incam) = whole.find(name) {
            return frames(&incam, &cameras, video).map(Some);
        }
        let prefix = format!("{name}_");
        let entries = whole.entries()?.into_iter();
        let below = entries
            .filter_map(|(key, item)| Some((Value::Str(key.strip_prefix(&prefix)?.to_owned()), item.value.clone())));
        let below = Value::Dict(below.collect());
        if below.get("body_pose").is_some() {
            return frames(&Item { path: whole.path, key: name.to_owned(), value: &below }, &cameras, video).map(Some);
        }
    }
    Ok(None)
}

fn frames(incam: &Item<'_>, cameras: &Item<'_>, video: &Video) -> Result<Fit, CaptureError> {
    let (orient, body) = (incam.get("global_orient")?, incam.get("body_pose")?);
    let (transl, shape) = (incam.get("transl")?, incam.get("betas")?);
    let roots = orient.rows(3)?;
    let (bodies, places, shapes) = (body.rows(3 * BODY)?, transl.rows(3)?, shape.rows(BETAS)?);
    let matrices = cameras.numbers(&[None, Some(3), Some(3)])?;
    let found = [(&body, bodies.len()), (&transl, places.len()), (&shape, shapes.len()), (cameras, matrices.len() / 9)];
    for (item, found) in found {
        item.as_long(roots.len(), found)?;
    }
    let [width, height] = video.sides();
    if let Some(k) = matrices.chunks_exact(9).find(|k| (2.0 * k[2] - width).hypot(2.0 * k[5] - height) > SIZE) {
        let expected = format!("a principal point at the centre of {width}×{height}, the frames' size");
        return Err(cameras.invalid(expected, format!("({}, {})", k[2], k[5])));
    }
    let frames = (0..roots.len()).map(|index| {
        let k = &matrices[9 * index..][..9];
        let pose = [vectors(&roots[index]), vectors(&bodies[index])].concat();
        FitFrame::still(index, pose, shapes[index].clone(), &places[index], [[k[0], k[4]], [k[2], k[5]]])
    });
    let person = Person { id: "0".to_owned(), frames: frames.collect(), ..Person::default() };
    Ok(Fit { tool: Tool::Gvhmr, people: vec![person], names: None })
}
