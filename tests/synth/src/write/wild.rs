//! HumanNeRF's layout for videos from anywhere.

use glam::{Affine3A, Vec3};
use serde_json::{Map, Value, json};
use smpl::{BodyModel, rodrigues};

use super::folder::{Folder, extrinsics, frame_mask, grey, mask_rgb, origin, rows};
use crate::film::Synthetic;
use capture::{CaptureError, Frame};

pub(super) fn write(synthetic: &Synthetic, folder: &Folder<'_>) -> Result<(), CaptureError> {
    let train = &synthetic.capture.train;
    let mut metadata = Map::new();
    for (i, frame) in train.iter().enumerate() {
        metadata.insert(format!("{i:06}"), record(&synthetic.body, frame));
    }
    folder.file("metadata.json", Value::Object(metadata).to_string())?;
    for kind in ["images", "masks", "occluders", "clean/images", "clean/masks"] {
        folder.make(kind)?;
    }
    let all = |kind: &str| -> Vec<String> { (0..train.len()).map(|i| format!("{kind}/{i:06}.png")).collect() };
    folder.pictures(&all("images"), |i| synthetic.photograph(i, true))?;
    folder.pictures(&all("masks"), |i| frame_mask(&train[i]))?;
    folder.pictures(&all("occluders"), |i| {
        let clear = synthetic.clear[i].pixels()?;
        Ok(match &synthetic.objects {
            Some(objects) => grey(objects.coverage(), &clear.image),
            None => {
                let covered = |p: usize| f32::from(synthetic.hidden[i].contains(p, clear.image.width));
                grey(&(0..clear.mask.len()).map(covered).collect::<Vec<f32>>(), &clear.image)
            }
        })
    })?;
    let every = synthetic.config.eval_every;
    let kept = |kind: &str| -> Vec<String> { all(kind).into_iter().step_by(every).collect() };
    folder.pictures(&kept("clean/images"), |i| synthetic.photograph(i * every, false))?;
    folder.pictures(&kept("clean/masks"), |i| {
        let clear = synthetic.clear[i * every].pixels()?;
        Ok(mask_rgb(&clear.mask, &clear.image))
    })
}

/// Body and camera of a frame. The layout has no translation of the body, so the camera moves
/// instead.
fn record(body: &BodyModel, frame: &Frame) -> Value {
    let (rotation, translation) = origin(frame);
    // A turn about the pelvis in place of one about the origin.
    let pelvis = body.shaped(&frame.betas).joints[0];
    let trans = rodrigues(rotation) * pelvis + translation - pelvis;
    let camera = frame.camera.world_to_camera * Affine3A::from_translation(trans);
    let mut pose = frame.pose.clone();
    pose[0] = rotation;
    let poses: Vec<f32> = pose.iter().flat_map(Vec3::to_array).collect();
    json!({
        "poses": poses,
        "betas": frame.betas,
        "cam_intrinsics": rows(frame.camera.intrinsics()).chunks(3).collect::<Vec<_>>(),
        "cam_extrinsics": extrinsics(&camera).chunks(4).collect::<Vec<_>>(),
    })
}
