//! A thousand frames fitted to noisy points: SAM 3D Body's key points alone, and with 128 vertices.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use glam::Vec3;
use point_fit::{Anchor, fit, joint_set};
use smpl::{BodyModel, Placement};
use testkit::body::Random;

const FRAMES: usize = 1000;
/// Noise of a coordinate, uniform, in metres.
const NOISE: f32 = 0.025;

fn main() {
    divan::main();
}

#[divan::bench(args = [0, 128], sample_count = 3)]
fn a_thousand_frames(bencher: Bencher<'_, '_>, vertices: usize) {
    let body = BodyModel::embedded();
    let set = joint_set(&body, "mhr70").into_iter().flatten().flatten();
    let vertex = |i: usize| Anchor { vertices: vec![(53 * i, 1.0)], ..Anchor::default() };
    let anchors: Vec<Anchor> = set.chain((0..vertices).map(vertex)).collect();
    let (shaped, mut random, mut seen) = (body.shaped(&[0.5, -0.5]), Random(5), Vec::new());
    for t in 0..FRAMES {
        let mut pose = vec![Vec3::ZERO; 24];
        let swing = (0.2 * t as f32).sin();
        pose[0].y = 0.05 * t as f32;
        for (side, leg, arm) in [(1.0, 1, 16), (-1.0, 2, 17)] {
            pose[leg].x = -0.5 * side * swing;
            pose[leg + 3].x = 0.5 - 0.4 * side * swing;
            pose[arm].z = -1.2 * side;
            pose[arm + 2].y = -side * (0.5 + 0.3 * swing);
        }
        let posed = body.pose(&shaped, &pose, Placement::Pelvis { translation: Vec3::new(0.0, 0.0, 4.0) });
        for anchor in &anchors {
            let joints = anchor.joints.iter().map(|(j, w)| *w * posed.joints[*j]);
            let at: Vec3 = joints.chain(anchor.vertices.iter().map(|(v, w)| *w * posed.vertices[*v])).sum();
            seen.push(at + random.vec3(NOISE));
        }
    }
    bencher.counter(ItemsCount::new(FRAMES)).bench(|| fit(black_box(&body), &anchors, &seen));
}
