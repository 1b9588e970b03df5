//! HumanNeRF's prepared layout (Weng et al. 2022), with OccNeRF's `eval` cameras.
//!
//! ```text
//! images/frame_000000.png …   masks/frame_000000.png …   (PNG or JPEG)
//! cameras.pkl                 {frame: {intrinsics (3,3), extrinsics (4,4), distortions (5)?}}
//! mesh_infos.pkl              {frame: {Rh (3), Th (3), poses (3J), betas (≤ B), tpose_joints (J,3), …}}
//! canonical_joints.pkl        {joints (J,3), avg_betas (≤ B)}
//! eval/Camera_…/              images, masks, cameras.pkl and mesh_infos.pkl again, nothing occluded
//! ```

mod checks;
mod records;
#[cfg(test)]
mod tests;
mod undistort;
mod view;

use std::path::{Path, PathBuf};

use smpl::{BodyModel, Placement};

use self::records::Records;
use super::{Capture, DataError, EvalFrame};

/// What a capture's files leave open.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoadOptions {
    /// Where the intrinsics put the centre of the first pixel: 0.5 where they count from the image's corner, 0
    /// where they count from the first pixel's centre, as HumanNeRF's own rays do.
    pub pixel_centre: f32,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self { pixel_centre: 0.5 }
    }
}

/// Reads a capture in HumanNeRF's prepared layout.
///
/// Frames are the entries of `cameras.pkl` in the order of their names. Images are multiplied by their masks.
/// Lens distortion is taken out of both. A frame without any subject pixel is kept (the subject may be wholly
/// hidden for a while); a camera without any in all its frames is an error. A missing `eval` directory leaves
/// [`Capture::eval`] empty.
///
/// # Errors
/// The first problem, training view before evaluation views: files that are missing, unreadable or truncated;
/// frames that have an image but no camera or body parameters, or the other way round; images and masks of unequal
/// sizes or above 8192 pixels; arrays of the wrong shape, or not finite; cameras that no projection fits, or that
/// see nothing of the body in any frame; a body model whose joints are not the file's; evaluation frames that
/// training lacks.
pub fn load_humannerf(dir: &Path, body: &BodyModel, options: &LoadOptions) -> Result<Capture, DataError> {
    if !options.pixel_centre.is_finite() {
        let expected = "a finite number (0 or 0.5)";
        return Err(DataError::setting("pixel_centre", expected, options.pixel_centre));
    }
    let train = view::load_view(dir, body, options)?;
    let mean_betas = mean_betas(dir, body)?;
    let mut eval = Vec::new();
    for camera in eval_directories(dir)? {
        let camera_name = view::file_name(&camera);
        for frame in view::load_view(&camera, body, options)? {
            let train_index = train.binary_search_by(|t| t.name.cmp(&frame.name));
            eval.push(EvalFrame {
                camera_name: camera_name.clone(),
                train_index: train_index.map_err(|_| {
                    DataError::invalid(
                        &camera.join("cameras.pkl"),
                        &frame.name,
                        format!("the name of a frame of {}", dir.join("cameras.pkl").display()),
                        "no such training frame",
                    )
                })?,
                frame,
            });
        }
    }
    Ok(Capture { name: view::file_name(dir), train, eval, mean_betas })
}

/// The shape of the canonical body, `avg_betas` of `canonical_joints.pkl`, its joints checked against the model's.
fn mean_betas(dir: &Path, body: &BodyModel) -> Result<Vec<f32>, DataError> {
    let records = Records::load(&dir.join("canonical_joints.pkl"))?;
    let canonical = records.whole();
    let betas = checks::betas(&canonical, "avg_betas", body)?;
    checks::joints(&canonical, "joints", &betas, body)?;
    Ok(betas)
}

/// `eval/*/` in the order of their names; none where there is no `eval`.
fn eval_directories(dir: &Path) -> Result<Vec<PathBuf>, DataError> {
    let root = dir.join("eval");
    if !root.exists() {
        return Ok(Vec::new());
    }
    let mut found = Vec::new();
    for entry in std::fs::read_dir(&root).map_err(DataError::io(&root))? {
        let path = entry.map_err(DataError::io(&root))?.path();
        if path.is_dir() {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The body model that belongs to the capture in `scene`: its own `body.npz`, else the first `.npz` with a body in
/// a directory `body` beside it or beside the nearest of the directories above it. `None` where there is none.
#[must_use]
pub fn find_body(scene: &Path) -> Option<PathBuf> {
    let own = scene.join("body.npz");
    if own.is_file() {
        return Some(own);
    }
    // Ancestors of a relative path end where the path does, not at the root of the file system.
    let scene = scene.canonicalize().ok()?;
    scene.ancestors().find_map(|above| {
        let mut files: Vec<PathBuf> = std::fs::read_dir(above.join("body"))
            .ok()?
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(|path| path.extension().is_some_and(|e| e == "npz"))
            .collect();
        files.sort();
        files.into_iter().find(|path| is_body(path))
    })
}

/// Whether an archive holds a template; poses and reference values may lie beside the body.
fn is_body(path: &Path) -> bool {
    smpl::npz::Npz::open(path).is_ok_and(|npz| npz.keys().iter().any(|key| key == "v_template"))
}

/// ZJU-MoCap's way of placing a body: rotation and translation about the origin.
fn placement(rotation: glam::Vec3, translation: glam::Vec3) -> Placement {
    Placement::Origin { rotation, translation }
}
