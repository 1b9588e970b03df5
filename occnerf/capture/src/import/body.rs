//! The body model that a fit belongs to.

use std::path::{Path, PathBuf};

use glam::DVec3;
use smpl::BodyModel;

use super::file::value;
use super::fit::{SMPL, SMPLX, Tool, vectors};
use crate::CaptureError;
use crate::find::near_bodies;
use crate::item::Item;

/// Joints of a hand, and numbers of its pose.
const HAND: usize = 15;

/// Reads the body of a fit by `tool`: `given`, or the first that fits of the `.npz` and `.pkl`
/// files in folders `body` beside `near` or above; without a path the embedded body, where there is
/// none.
pub(super) fn find(
    tool: Tool,
    given: Option<&Path>,
    near: &[&Path],
) -> Result<(Option<PathBuf>, BodyModel), CaptureError> {
    if let Some(path) = given {
        let model = BodyModel::load(path)?;
        return match fits(tool, &model) {
            true => Ok((Some(path.to_owned()), model)),
            false => {
                let expected = format!("{} joints: {} fits {}", tool.joints(), tool.name(), download(tool));
                Err(CaptureError::invalid(path, "kintree_table", expected, format!("{} joints", model.num_joints())))
            }
        };
    }
    let whole = near.iter().filter_map(|place| place.canonicalize().ok());
    for path in whole.flat_map(|place| near_bodies(&place, &["npz", "pkl"])) {
        if let Some(model) = BodyModel::load(&path).ok().filter(|model| fits(tool, model)) {
            return Ok((Some(path), model));
        }
    }
    Ok((None, BodyModel::embedded()))
}

fn fits(tool: Tool, model: &BodyModel) -> bool {
    let joints = model.num_joints();
    (joints == tool.joints() || tool.is_points() && joints == SMPLX) && model.num_betas() >= super::fit::BETAS
}

/// Download hint for an unsuitable body.
fn download(tool: Tool) -> &'static str {
    match tool.joints() {
        SMPL => "SMPL; download SMPL_NEUTRAL.pkl (SMPL_python_v.1.1.0) from smpl.is.tue.mpg.de and give it as --body",
        SMPLX => {
            "SMPL-X; download SMPLX_NEUTRAL.npz (models_smplx_v1_1) from smpl-x.is.tue.mpg.de and give it as --body"
        }
        _ => "a body that this program does not know",
    }
}

/// The pose of both hands at rest, left first: 15 joints each. From `hands_meanl` and `hands_meanr`
/// of an SMPL-X file.
pub(super) fn mean_hands(path: &Path) -> Result<Vec<DVec3>, CaptureError> {
    let value = value(path, "a body model")?;
    let root = Item::new(path, &value);
    let of = |key: &str| Ok(vectors(&root.get(key)?.numbers(&[Some(3 * HAND)])?));
    let hands: Result<Vec<Vec<DVec3>>, CaptureError> = ["hands_meanl", "hands_meanr"].into_iter().map(of).collect();
    Ok(hands?.concat())
}
