//! A tiny body, a writer of the few pickle opcodes that captures take, and directories that go
//! away.

use glam::Vec3;
use smpl::{BodyModel, SparseRows};

use super::{Capture, CaptureError, Frame, LoadOptions, load_capture};

/// A box with a joint at either end and one beta that lengthens it.
pub fn body() -> BodyModel {
    let corner = |i: u32, axis: u32| if i >> axis & 1 == 1 { 1.0 } else { -1.0 };
    let v_template: Vec<Vec3> =
        (0..8).map(|i| Vec3::new(corner(i, 0) * 0.2, corner(i, 1) * 0.85, corner(i, 2) * 0.1)).collect();
    let face = |[a, b, c, d]: [u32; 4]| [[a, b, c], [a, c, d]];
    let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let top = |i: u32| u32::from(i >> 1 & 1 == 1);
    BodyModel {
        faces: quads.into_iter().flat_map(face).collect(),
        shapedirs: v_template.iter().map(|v| Vec3::Y * v.y * 0.1).collect(),
        posedirs: SparseRows::from_rows((0..8).map(|_| Vec::<(u32, Vec3)>::new())),
        weights: SparseRows::from_rows((0..8).map(|i| [(top(i), 1.0f32)])),
        j_regressor: SparseRows::from_rows([[0, 1, 4, 5], [2, 3, 6, 7]].map(|row: [u32; 4]| row.map(|v| (v, 0.25f32)))),
        parents: vec![None, Some(0)],
        v_template,
    }
}

pub use synth::Py;
pub use testkit::files::{Directory, damaged, shared};

/// An array as `numpy.save` writes it.
pub fn npy(shape: &[usize], values: &[f32]) -> Vec<u8> {
    testkit::files::npy("<f4", shape, &values.iter().copied().flat_map(f32::to_le_bytes).collect::<Vec<u8>>())
}

/// An array of points as `numpy.save` writes it.
pub fn points_npy(points: &[Vec3]) -> Vec<u8> {
    npy(&[points.len(), 3], &points.iter().flat_map(Vec3::to_array).collect::<Vec<_>>())
}

pub fn array(shape: &[u32], values: &[f64]) -> Py {
    Py::Array(shape.to_vec(), values.to_vec())
}

pub fn flat(points: &[Vec3]) -> Vec<f64> {
    points.iter().flat_map(|p| p.to_array()).map(f64::from).collect()
}

/// Intersection over union of the posed body's silhouette and the mask, over the pixels that no
/// known occluder covers.
pub fn overlap(frame: &Frame, body: &BodyModel) -> f32 {
    let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
    let mesh = visibility::RayMesh::new(&posed.vertices, &body.faces).unwrap();
    let (pixels, width) = (frame.pixels().unwrap(), frame.camera.width as usize);
    testkit::oracle::mask_iou(&pixels.mask, pixels.occluder.as_deref(), width, |x, y| {
        let ray = frame.camera.ray(x, y);
        mesh.first_hit(ray.origin, ray.direction).is_some()
    })
}

/// Loads a capture of the tiny body.
pub fn load(dir: &Directory) -> Result<Capture, CaptureError> {
    load_with(dir, LoadOptions::default())
}

pub fn load_with(dir: &Directory, options: LoadOptions) -> Result<Capture, CaptureError> {
    load_capture(dir.path(), &body(), &options)
}

/// Checks that a capture is refused in one line that holds all of `words`.
#[track_caller]
pub fn fails(dir: &Directory, words: &[&str]) {
    let message = load(dir).expect_err(words[0]).to_string();
    assert!(!message.contains('\n') && message.len() < 600, "{message}");
    words.iter().for_each(|word| assert!(message.contains(word), "`{word}` is not in: {message}"));
}

pub fn names(frames: &[Frame]) -> Vec<&str> {
    frames.iter().map(|frame| frame.name.as_str()).collect()
}

/// Camera and training frame of each view.
pub fn views(capture: &Capture) -> Vec<(&str, usize)> {
    capture.eval.iter().map(|view| (view.camera_name.as_str(), view.train_index)).collect()
}
