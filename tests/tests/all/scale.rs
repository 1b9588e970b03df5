//! Independence of the unit of length: lengths are normalised before anything with a constant
//! in metres.

use crate::common;

use common::{bits, body, capture, tiny, train};
use occnerf::capture::{Capture, Frame};
use occnerf::{Config, Method, MotionKind, Scene};
use smpl::{BodyModel, Placement, SparseRows};

const STEPS: u64 = 6;

/// The same body with `scale` times as many units to the metre.
fn scaled_body(scale: f32) -> BodyModel {
    let mut body = body().clone();
    body.v_template.iter_mut().chain(&mut body.shapedirs).for_each(|v| *v *= scale);
    let rows = (0..body.posedirs.num_rows())
        .map(|v| body.posedirs.row(v).map(|(term, d)| (term as u32, d * scale)).collect::<Vec<_>>());
    body.posedirs = SparseRows::from_rows(rows.collect::<Vec<_>>());
    body
}

fn scaled_capture(scale: f32) -> Capture {
    let frame = |frame: &mut Frame| {
        frame.camera.world_to_camera.translation *= scale;
        let (Placement::Pelvis { translation } | Placement::Origin { translation, .. }) = &mut frame.placement;
        *translation *= scale;
    };
    let mut capture = capture().clone();
    capture.train.iter_mut().for_each(frame);
    capture.eval.iter_mut().map(|e| &mut e.frame).for_each(frame);
    capture
}

/// The scene in another unit; it does not depend on method or motion.
fn scaled_scene(scale: f32, config: &Config) -> Scene {
    Scene::new(&scaled_capture(scale), &scaled_body(scale), config).unwrap()
}

fn configs() -> [Config; 3] {
    [
        tiny(Method::Occnerf, MotionKind::Surface),
        tiny(Method::Occnerf, MotionKind::Volume),
        tiny(Method::HashPoint, MotionKind::Surface),
    ]
}

/// Powers of two scale without rounding, so that nothing at all may change.
#[test]
fn a_unit_that_is_a_power_of_two_changes_no_bit() {
    let scene = scaled_scene(128.0, &configs()[0]);
    assert_eq!(scene.body.scale * 128.0, common::scene().body.scale);
    for config in configs() {
        let (metres, ours) = train(common::scene(), &config, STEPS);
        let (units, theirs) = train(&scene, &config, STEPS);
        assert_eq!(bits(&metres), bits(&units), "{:?} {:?}", config.method, config.motion.kind);
        assert!(ours == theirs, "{:?} {:?}: checkpoints differ", config.method, config.motion.kind);
    }
}
