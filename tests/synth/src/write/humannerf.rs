//! HumanNeRF's prepared layout.

use smpl::{BodyModel, Placement};

use super::folder::{Folder, extrinsics, flat, frame_mask, origin, rows, unmixed};
use super::pickle::Py;
use crate::film::Synthetic;
use capture::{CaptureError, Frame};

pub(super) fn write(synthetic: &Synthetic, folder: &Folder<'_>) -> Result<(), CaptureError> {
    let Synthetic { capture, body, .. } = synthetic;
    let train: Vec<&Frame> = capture.train.iter().collect();
    view(body, folder, "", &train)?;
    let names = |kind: &str, below: &str, frames: &[&Frame]| -> Vec<String> {
        frames.iter().map(|f| format!("{below}{kind}/{}.png", f.name)).collect()
    };
    folder.pictures(&names("images", "", &train), |i| synthetic.photograph(i, true))?;
    folder.pictures(&names("masks", "", &train), |i| frame_mask(train[i]))?;
    let shaped = body.shaped(&capture.mean_betas);
    let canonical = Py::record([
        ("joints", Py::floats(&[shaped.joints.len(), 3], &flat(&shaped.joints))),
        ("avg_betas", Py::floats(&[capture.mean_betas.len()], &capture.mean_betas)),
    ]);
    folder.file("canonical_joints.pkl", canonical.pickle())?;
    // Views are in the order of their cameras.
    for frames in capture.eval.chunk_by(|a, b| a.camera_name == b.camera_name) {
        let below = format!("eval/{}/", frames[0].camera_name);
        let frames: Vec<&Frame> = frames.iter().map(|e| &e.frame).collect();
        view(body, folder, &below, &frames)?;
        let picture = |i: usize| frames[i].pixels().map(|p| unmixed(&p.image, &p.mask));
        folder.pictures(&names("images", &below, &frames), picture)?;
        folder.pictures(&names("masks", &below, &frames), |i| frame_mask(frames[i]))?;
    }
    Ok(())
}

/// Cameras and bodies of one camera's frames, and folders for its pictures.
fn view(body: &BodyModel, folder: &Folder<'_>, below: &str, frames: &[&Frame]) -> Result<(), CaptureError> {
    for kind in ["images", "masks"] {
        folder.make(&format!("{below}{kind}"))?;
    }
    let cameras = frames.iter().map(|frame| {
        let camera = Py::record([
            ("intrinsics", Py::floats(&[3, 3], &rows(frame.camera.intrinsics()))),
            ("extrinsics", Py::floats(&[4, 4], &extrinsics(&frame.camera.world_to_camera))),
            ("distortions", Py::floats(&[5], &[0.0; 5])),
        ]);
        (frame.name.clone(), camera)
    });
    folder.file(&format!("{below}cameras.pkl"), Py::Dict(cameras.collect()).pickle())?;
    let infos = frames.iter().map(|frame| {
        let shaped = body.shaped(&frame.betas);
        let (rh, th) = origin(frame);
        let posed = body.pose(&shaped, &frame.pose, Placement::default());
        let info = Py::record([
            ("Rh", Py::floats(&[3], &rh.to_array())),
            ("Th", Py::floats(&[3], &th.to_array())),
            ("poses", Py::floats(&[3 * frame.pose.len()], &flat(&frame.pose))),
            ("betas", Py::floats(&[frame.betas.len()], &frame.betas)),
            ("joints", Py::floats(&[posed.joints.len(), 3], &flat(&posed.joints))),
            ("tpose_joints", Py::floats(&[shaped.joints.len(), 3], &flat(&shaped.joints))),
        ]);
        (frame.name.clone(), info)
    });
    folder.file(&format!("{below}mesh_infos.pkl"), Py::Dict(infos.collect()).pickle())
}
