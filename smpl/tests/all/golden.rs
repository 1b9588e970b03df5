//! Against `smplx.lbs.lbs` in f64.

use array_files::npz::Npz;
use glam::Vec3;
use smpl::{BodyModel, Placement};
use testkit::files::shared;

fn vectors(values: &[f32]) -> Vec<Vec3> {
    values.chunks_exact(3).map(Vec3::from_slice).collect()
}

#[test]
fn posed_bodies_equal_those_of_smplx() {
    let (Some(model), Some(golden)) = (shared("body/open_body.npz"), shared("body/open_body_poses_golden.npz")) else {
        return;
    };
    let body = BodyModel::load(&model).unwrap();
    let mut golden = Npz::open(&golden).unwrap();
    let betas = golden.f32("betas", &[None, Some(10)]).unwrap().1;
    let poses = vectors(&golden.f32("poses", &[Some(8), Some(72)]).unwrap().1);
    let trans = vectors(&golden.f32("trans", &[Some(8), Some(3)]).unwrap().1);
    let vertices = vectors(&golden.f32("vertices", &[Some(8), None, Some(3)]).unwrap().1);
    let joints = vectors(&golden.f32("joints", &[Some(8), Some(24), Some(3)]).unwrap().1);
    let v = body.num_vertices();
    let mut worst = 0.0f32;
    for row in 0..8 {
        let shaped = body.shaped(&betas[10 * row..][..10]);
        let placement = Placement::Pelvis { translation: trans[row] };
        let posed = body.pose(&shaped, &poses[24 * row..][..24], placement);
        let expected = vertices[v * row..][..v].iter().chain(&joints[24 * row..][..24]);
        for (a, b) in posed.vertices.iter().chain(&posed.joints).zip(expected) {
            worst = worst.max(a.distance(*b));
        }
    }
    println!("largest difference {worst:e} m");
    assert!(worst < 2e-5, "{worst}");
}

#[test]
fn the_pickled_body_equals_the_npz_one() {
    let (Some(npz), Some(pkl)) = (shared("body/open_body.npz"), shared("body/open_body.pkl")) else {
        return;
    };
    let (a, b) = (BodyModel::load(&npz).unwrap(), BodyModel::load(&pkl).unwrap());
    assert_eq!(a, b);
}
