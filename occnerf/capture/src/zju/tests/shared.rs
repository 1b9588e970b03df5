//! The shared capture, against its prepared twin.

use smpl::BodyModel;

use crate::testing::{overlap, shared};
use crate::{Frame, LoadOptions, find_body, load_capture};

/// Largest difference of two cameras' calibration and extrinsics, in pixels and metres.
fn camera_difference(a: &Frame, b: &Frame) -> f32 {
    let extrinsics = |f: &Frame| f.camera.world_to_camera.to_cols_array();
    let moved = extrinsics(a).iter().zip(extrinsics(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let lens = (a.camera.focal - b.camera.focal).abs().max((a.camera.centre - b.camera.centre).abs());
    moved.max(lens.max_element())
}

#[test]
fn the_raw_capture_is_the_prepared_one() {
    let (Some(raw), Some(prepared)) = (shared("captures/zju_demo"), shared("captures/humannerf_demo")) else { return };
    let body = BodyModel::load(&find_body(&raw).unwrap()).unwrap();
    let options = LoadOptions::default();
    let (raw, prepared) =
        (load_capture(&raw, &body, &options).unwrap(), load_capture(&prepared, &body, &options).unwrap());
    assert_eq!((raw.train.len(), raw.eval.len()), (100, 100));
    for (a, b) in raw.mean_betas.iter().zip(&prepared.mean_betas) {
        assert!((a - b).abs() < 1e-5, "{a} {b}");
    }
    let views = raw.eval.iter().map(|e| &e.frame).zip(prepared.eval.iter().map(|e| &e.frame));
    for (i, (a, b)) in raw.train.iter().zip(&prepared.train).chain(views).enumerate() {
        assert_eq!(a.name, b.name);
        assert!(camera_difference(a, b) < 1e-4, "{}", a.name);
        let posed = |f: &Frame| body.pose(&body.shaped(&f.betas), &f.pose, f.placement);
        let (p, q) = (posed(a), posed(b));
        let pairs = p.joints.iter().zip(&q.joints).chain(p.vertices.iter().zip(&q.vertices));
        assert!(pairs.map(|(a, b)| a.distance(*b)).fold(0.0, f32::max) < 1e-4, "{}", a.name);
        // The occlusion too: the same subject pixels.
        assert_eq!(a.pixels().unwrap().mask, b.pixels().unwrap().mask, "{i}: {}", a.name);
        assert_eq!(a.pixels().unwrap().image, b.pixels().unwrap().image, "{i}: {}", a.name);
    }
    for (a, b) in raw.eval.iter().zip(&prepared.eval) {
        assert_eq!((&a.camera_name, a.train_index), (&b.camera_name, b.train_index));
    }
}

#[test]
fn posed_bodies_are_the_files_vertices_and_cover_the_subject() {
    let Some(scene) = shared("captures/zju_demo") else { return };
    let body = BodyModel::load(&find_body(&scene).unwrap()).unwrap();
    let capture = load_capture(&scene, &body, &LoadOptions { stride: 5, ..LoadOptions::default() }).unwrap();
    assert_eq!((capture.train.len(), capture.eval.len()), (20, 100));
    for (i, frame) in capture.train.iter().enumerate() {
        let path = scene.join(format!("new_vertices/{}.npy", 5 * i));
        let expected = array_files::npz::read_npy(&path).unwrap().to_f64();
        let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
        for (v, e) in posed.vertices.iter().zip(expected.chunks(3)) {
            let off = v.as_dvec3().distance(glam::DVec3::from_slice(e));
            assert!(off < 1e-4, "{}: {off}", frame.name);
        }
    }
    // The recorded obstacle stands before the first four fifths.
    let views = capture.eval.iter().step_by(9).map(|e| &e.frame).chain(&capture.train[16..]);
    for frame in views {
        assert!(overlap(frame, &body) > 0.6, "{}: {}", frame.name, overlap(frame, &body));
    }
}
