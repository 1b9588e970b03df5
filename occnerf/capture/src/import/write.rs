//! Writing of an imported capture.

use std::io::Write;
use std::path::{Path, PathBuf};

use glam::DVec3;
use image::{GrayImage, ImageFormat};
use rayon::prelude::*;
use serde_json::{Map, Value, json};
use smpl::BodyModel;

use super::fit::{FitFrame, OwnMask};
use super::masks::Masks;
use super::options::ImportOptions;
use super::video::Video;
use crate::image::picture_error;
use crate::{CaptureError, Keypoint};

/// A frame in the capture's form.
pub(super) struct Placed {
    /// Axis-angle of every joint of the body model.
    pub pose: Vec<DVec3>,
    pub frame: FitFrame,
    /// The extrinsics' translation.
    pub translation: DVec3,
    pub keypoints: Vec<Keypoint>,
}

/// Writes `images`, `masks`, `occluders` and `metadata.json`; without `masks` those of the fit.
pub(super) fn capture(
    options: &ImportOptions,
    video: &Video,
    placed: &[Placed],
    betas: &[f64],
    masks: Option<&Masks>,
    out: &Path,
) -> Result<(), CaptureError> {
    let occluders = (!options.occluder_objects.is_empty()).then_some("occluders");
    for name in ["images", "masks"].into_iter().chain(occluders) {
        let path = out.join(name);
        std::fs::create_dir_all(&path).map_err(CaptureError::io(&path))?;
    }
    // Collected as results first: the first error in order is reported.
    let frames: Vec<Result<(), CaptureError>> =
        placed.par_iter().map(|placed| frame(options, video, &placed.frame, masks, out)).collect();
    frames.into_iter().collect::<Result<(), CaptureError>>()?;
    let records = placed.iter().map(|placed| (video.names[placed.frame.index].clone(), record(placed, betas)));
    let path = out.join("metadata.json");
    let text = Value::Object(records.collect::<Map<_, _>>()).to_string();
    array_files::replace_file(&path, |to| to.write_all(text.as_bytes())).map_err(CaptureError::io(&path))
}

/// Writes the body model for [`crate::own_body`].
pub(super) fn body(model: &BodyModel, out: &Path) -> Result<(), CaptureError> {
    Ok(model.save(&out.join("body.safetensors"))?)
}

fn frame(
    options: &ImportOptions,
    video: &Video,
    frame: &FitFrame,
    masks: Option<&Masks>,
    out: &Path,
) -> Result<(), CaptureError> {
    let (name, source) = (&video.names[frame.index], &video.paths[frame.index]);
    let extension = source.extension().map_or("png".into(), |e| e.to_string_lossy());
    linked(source, &out.join("images").join(format!("{name}.{extension}")), options.copy)?;
    let (mask, front) = match (masks, &frame.mask) {
        (Some(masks), _) => masks.levels(frame.index, video)?,
        (None, Some(own)) => (own_levels(own, video.size, &options.fit, name)?, None),
        (None, None) => return Err(CaptureError::missing(&options.fit, format!("mask of frame {name}"))),
    };
    let file = format!("{name}.png");
    save(mask, video.size, &out.join("masks").join(&file))?;
    front.map_or(Ok(()), |front| save(front, video.size, &out.join("occluders").join(&file)))
}

/// The fit's own mask at the frames' size, resampled by nearest neighbour if its aspect ratio fits.
pub(super) fn own_levels(mask: &OwnMask, size: (u32, u32), fit: &Path, name: &str) -> Result<Vec<u8>, CaptureError> {
    let (height, width, pixels) = match mask {
        OwnMask::Runs(rle) => (rle.height, rle.width, rle.pixels()),
        OwnMask::Pixels(height, width, pixels) => (*height, *width, pixels.clone()),
    };
    let (to_width, to_height) = (size.0 as usize, size.1 as usize);
    let (across, down) = (width as f64 / to_width as f64, height as f64 / to_height as f64);
    let scaled = matches!(mask, OwnMask::Pixels(..)) && across > 0.0 && (across / down - 1.0).abs() < 0.01;
    if !scaled && (width, height) != (to_width, to_height) {
        let expected = format!("{to_width}×{to_height}, as the frames");
        return Err(CaptureError::invalid(fit, format!("mask of {name}"), expected, format!("{width}×{height}")));
    }
    let nearest = |i: usize, scale: f64, most: usize| (((i as f64 + 0.5) * scale) as usize).min(most.saturating_sub(1));
    let level = |i: usize| {
        let (x, y) = (nearest(i % to_width, across, width), nearest(i / to_width, down, height));
        if pixels[y * width + x] { 255 } else { 0 }
    };
    Ok((0..to_width * to_height).map(level).collect())
}

fn save(levels: Vec<u8>, size: (u32, u32), path: &Path) -> Result<(), CaptureError> {
    let found = levels.len();
    let picture = GrayImage::from_raw(size.0, size.1, levels).ok_or_else(|| {
        CaptureError::invalid(path, "size", format!("{}×{} values", size.0, size.1), found.to_string())
    })?;
    picture.save_with_format(path, ImageFormat::Png).map_err(|source| picture_error(path, source))
}

/// `target` as seen from `folder`, both absolute; `target` itself where they share only the root.
#[cfg(unix)]
fn relative(target: &Path, folder: &Path) -> PathBuf {
    let shared = target.components().zip(folder.components()).take_while(|(a, b)| a == b).count();
    if shared < 2 {
        return target.to_owned();
    }
    let up = folder.components().skip(shared).map(|_| std::path::Component::ParentDir);
    up.chain(target.components().skip(shared)).collect()
}

/// Links a picture, or copies it if `copy` or where links fail.
fn linked(from: &Path, to: &Path, copy: bool) -> Result<(), CaptureError> {
    let whole: PathBuf = from.canonicalize().map_err(CaptureError::io(from))?;
    // A copy through an existing link would truncate its target.
    if to.symlink_metadata().is_ok() {
        let source = std::io::Error::from(std::io::ErrorKind::AlreadyExists);
        return Err(CaptureError::Io { path: to.to_owned(), source });
    }
    #[cfg(unix)]
    if !copy {
        let folder = to.parent().unwrap_or(to);
        let folder = folder.canonicalize().map_err(CaptureError::io(folder))?;
        if std::os::unix::fs::symlink(relative(&whole, &folder), to).is_ok() {
            return Ok(());
        }
    }
    let _ = copy;
    std::fs::copy(&whole, to).map_err(CaptureError::io(from)).map(drop)
}

/// A frame of `metadata.json`.
fn record(placed: &Placed, betas: &[f64]) -> Value {
    let frame = &placed.frame;
    let poses: Vec<f64> = placed.pose.iter().flat_map(|v| v.to_array()).collect();
    let (r, t) = (frame.world_to_camera.transpose(), placed.translation);
    let row = |axis: usize| [r.col(axis).x, r.col(axis).y, r.col(axis).z, t[axis]];
    let mut record = json!({
        "poses": poses,
        "betas": betas,
        "cam_intrinsics": [[frame.focal[0], 0.0, frame.centre[0]], [0.0, frame.focal[1], frame.centre[1]], [0.0, 0.0, 1.0]],
        "cam_extrinsics": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
    });
    if !placed.keypoints.is_empty() {
        let row = |p: &Keypoint| json!([p.joint, p.place.x, p.place.y, p.confidence]);
        record["keypoints"] = placed.keypoints.iter().map(row).collect();
    }
    record
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_relative_and_broken_ones_are_called_so() {
        assert_eq!(relative(Path::new("/a/b/x.png"), Path::new("/a/c/images")), Path::new("../../b/x.png"));
        assert_eq!(relative(Path::new("/a/x.png"), Path::new("/b/images")), Path::new("/a/x.png"));
        let dir = crate::testing::Directory::new("import-links");
        dir.picture("frames/1.png", (4, 2), |_, _| 200);
        std::fs::create_dir_all(dir.path().join("capture/images")).unwrap();
        let (from, to) = (dir.path().join("frames/1.png"), dir.path().join("capture/images/1.png"));
        linked(&from, &to, false).unwrap();
        // Both moved together.
        let moved = dir.path().with_extension("moved");
        std::fs::rename(dir.path(), &moved).unwrap();
        let picture = moved.join("capture/images/1.png");
        assert!(crate::Image::load(&picture).is_ok());
        std::fs::remove_file(moved.join("frames/1.png")).unwrap();
        let error = crate::Image::load(&picture).unwrap_err().to_string();
        std::fs::remove_dir_all(&moved).unwrap();
        assert!(error.contains("broken link") && error.contains("../../frames/1.png"), "{error}");
    }
}
