//! One camera's directory.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::{Affine3A, Mat3, Vec3};
use rayon::prelude::*;
use smpl::BodyModel;
use volrender::{Camera, Distortion};

use super::records::{Record, Records, triples};
use super::undistort::undistort;
use super::{LoadOptions, checks, placement};
use crate::data::image::load_mask;
use crate::data::{DataError, Frame, Image};

/// Largest |R Rᵀ − I| of an extrinsic rotation; files written in `f32` or with a few decimals stay far below.
const ORTHONORMAL: f32 = 1e-3;

/// Last component of a path.
pub(super) fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}

/// All frames of a directory, sorted by name; checked one by one and together.
pub(super) fn load_view(dir: &Path, body: &BodyModel, options: &LoadOptions) -> Result<Vec<Frame>, DataError> {
    if !dir.is_dir() {
        return Err(DataError::missing(dir, "directory"));
    }
    let cameras = Records::load(&dir.join("cameras.pkl"))?;
    let bodies = Records::load(&dir.join("mesh_infos.pkl"))?;
    let names = cameras.names()?;
    same_names(&names, &cameras, &bodies)?;
    let images = pictures(&dir.join("images"))?;
    let masks = pictures(&dir.join("masks"))?;
    if let Some((name, path)) = images.iter().find(|(name, _)| !names.contains(&name.as_str())) {
        let expected = format!("an entry `{name}` in {}", cameras.path().display());
        return Err(DataError::invalid(path, "camera of the image", expected, "none"));
    }

    // Collected as results first, so that the error reported is the first in order whatever finishes first.
    let frames: Vec<Result<Frame, DataError>> = names
        .par_iter()
        .map(|&name| {
            let picture = |of: &BTreeMap<String, PathBuf>, kind: &str| {
                of.get(name).cloned().ok_or_else(|| {
                    let path = dir.join(kind).join(format!("{name}.png"));
                    let what = format!("picture (nor .jpg) of `{name}` in {}", cameras.path().display());
                    DataError::missing(&path, what)
                })
            };
            let (image, mask) = (picture(&images, "images")?, picture(&masks, "masks")?);
            let (camera, pose) = (cameras.record(name)?, bodies.record(name)?);
            load_frame(name, &image, &mask, &camera, &pose, body, options)
        })
        .collect();
    let frames: Vec<Frame> = frames.into_iter().collect::<Result<_, _>>()?;

    let size = |frame: &Frame| (frame.image.width, frame.image.height);
    if let Some(odd) = frames.iter().find(|frame| size(frame) != size(&frames[0])) {
        return Err(DataError::invalid(
            &images[&odd.name],
            "size",
            format!("{}×{}, as of `{}`", size(&frames[0]).0, size(&frames[0]).1, frames[0].name),
            format!("{}×{}", size(odd).0, size(odd).1),
        ));
    }
    checks::subject_is_seen(&dir.join("masks"), &frames)?;
    checks::body_is_seen(cameras.path(), &frames, body)?;
    Ok(frames)
}

/// Both pickles have the same frames.
fn same_names(names: &[&str], cameras: &Records, bodies: &Records) -> Result<(), DataError> {
    let others = bodies.names()?;
    let only = |a: &[&str], b: &[&str]| a.iter().find(|name| !b.contains(name)).map(|n| (*n).to_owned());
    for (odd, has, lacks) in [(only(names, &others), cameras, bodies), (only(&others, names), bodies, cameras)] {
        if let Some(name) = odd {
            let expected = format!("an entry, as in {}", has.path().display());
            return Err(DataError::invalid(lacks.path(), name, expected, "no such key"));
        }
    }
    Ok(())
}

/// PNG and JPEG files of a directory by name without extension.
fn pictures(dir: &Path) -> Result<BTreeMap<String, PathBuf>, DataError> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(dir).map_err(DataError::io(dir))? {
        let path = entry.map_err(DataError::io(dir))?.path();
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        if !matches!(extension.as_deref(), Some("png" | "jpg" | "jpeg")) {
            continue;
        }
        let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned());
        let stem = stem.unwrap_or_default();
        if let Some(other) = found.insert(stem.clone(), path.clone()) {
            let actual = format!("{} and {}", file_name(&other), file_name(&path));
            return Err(DataError::invalid(dir, stem, "one picture", actual));
        }
    }
    Ok(found)
}

fn load_frame(
    name: &str,
    image_path: &Path,
    mask_path: &Path,
    camera: &Record<'_>,
    parameters: &Record<'_>,
    body: &BodyModel,
    options: &LoadOptions,
) -> Result<Frame, DataError> {
    let mut image = Image::load(image_path)?;
    let (width, height, mut mask) = load_mask(mask_path)?;
    if (width, height) != (image.width, image.height) {
        return Err(DataError::invalid(
            mask_path,
            "size",
            format!("{}×{}, as of its image", image.width, image.height),
            format!("{width}×{height}"),
        ));
    }
    let (camera, distortion) = load_camera(camera, width, height, options)?;
    // Masked first, or interpolation would draw hidden colours into the mask's edge.
    image.multiply(&mask);
    undistort(&mut image, &mut mask, &camera, &distortion);

    let betas = checks::betas(parameters, "betas", body)?;
    checks::joints(parameters, "tpose_joints", &betas, body)?;
    let joints = body.num_joints();
    let why = format!(", 3 for each of the body model's {joints} joints");
    let pose = triples(&parameters.shaped("poses", &[3 * joints], &why)?);
    if pose.first().is_some_and(|root| *root != Vec3::ZERO) {
        let expected = "a zero root (the global rotation is Rh)";
        return Err(parameters.invalid("poses", expected, format!("{} for joint 0", pose[0])));
    }
    Ok(Frame {
        name: name.to_owned(),
        image,
        mask,
        camera,
        pose,
        placement: placement(parameters.vec3("Rh")?, parameters.vec3("Th")?),
        betas,
        occluder: None,
    })
}

fn load_camera(
    record: &Record<'_>,
    width: u32,
    height: u32,
    options: &LoadOptions,
) -> Result<(Camera, Distortion), DataError> {
    let k = record.shaped("intrinsics", &[3, 3], "")?;
    let mut intrinsics = Mat3::from_cols_slice(&k).transpose();
    // The camera's own convention has the first pixel's centre at 0.5.
    intrinsics.z_axis += Vec3::new(1.0, 1.0, 0.0) * (0.5 - options.pixel_centre);

    let (shape, e) = record.array("extrinsics")?;
    if shape != [4, 4] && shape != [3, 4] {
        return Err(record.invalid("extrinsics", "shape [4, 4]", format!("shape {shape:?}")));
    }
    let row = |i: usize| Vec3::new(e[4 * i], e[4 * i + 1], e[4 * i + 2]);
    let rotation = Mat3::from_cols(row(0), row(1), row(2)).transpose();
    let product = (rotation * rotation.transpose() - Mat3::IDENTITY).to_cols_array();
    let skewed = product.iter().any(|x| x.abs() > ORTHONORMAL) || rotation.determinant() < 0.0;
    if skewed || e.get(12..).is_some_and(|last| !last.is_empty() && last != [0.0, 0.0, 0.0, 1.0]) {
        let expected = "a rotation and a translation, with a last row of 0 0 0 1";
        return Err(record.invalid("extrinsics", expected, format!("{e:?}")));
    }
    let translation = Vec3::new(e[3], e[7], e[11]);
    let extrinsics = Affine3A::from_mat3_translation(rotation, translation);
    let camera = Camera::new(intrinsics, extrinsics, width, height)
        .map_err(|error| record.invalid("intrinsics", "a pinhole camera", error.to_string()))?;

    let mut distortion = Distortion::default();
    if record.has("distortions") {
        // Raw files store a column.
        let (shape, d) = record.array("distortions")?;
        let five: [f32; 5] = d
            .try_into()
            .map_err(|_| record.invalid("distortions", "5 numbers (k1 k2 p1 p2 k3)", format!("shape {shape:?}")))?;
        distortion = Distortion::from_opencv(five);
    }
    Ok((camera, distortion))
}
