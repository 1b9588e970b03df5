//! Gradients of shaping and posing against central differences.

use std::sync::LazyLock;

use glam::Vec3;
use proptest::prelude::*;
use smpl::{BodyModel, Placement, SparseRows};
use testkit::gradient::{Tolerance, check};
use testkit::strategy::vec3;

/// Every tenth vertex of the embedded body, with a pose blend shape for every term and a regressor
/// of its own.
static BODY: LazyLock<BodyModel> = LazyLock::new(|| {
    let full = BodyModel::embedded();
    let kept: Vec<usize> = (0..full.num_vertices()).step_by(10).collect();
    let pick = |values: &[Vec3]| kept.iter().map(|&v| values[v]).collect::<Vec<_>>();
    let wave = |a: usize, b: usize| ((a * 31 + b * 17) as f32 * 0.618).sin();
    let body =
        BodyModel {
            v_template: pick(&full.v_template),
            faces: vec![[0, 1, 2]],
            shapedirs: full.shapedirs.chunks_exact(full.num_vertices()).flat_map(pick).collect(),
            posedirs: SparseRows::from_rows((0..kept.len()).map(|v| {
                (0..207).map(move |t| (t as u32, 0.02 * Vec3::new(wave(v, t), wave(v + 1, t), wave(v, t + 1))))
            })),
            weights: SparseRows::from_rows(kept.iter().map(|&v| full.weights.row(v).map(|(j, w)| (j as u32, w)))),
            j_regressor: SparseRows::from_rows((0..24).map(|j| {
                let first = j * kept.len() / 24;
                (first..first + 4).map(|v| (v as u32, 0.25))
            })),
            parents: full.parents.clone(),
        };
    body.validate("the test's body").unwrap();
    body
});

/// A fixed, generic cotangent of n vectors.
fn cotangent(n: usize, phase: f32) -> Vec<Vec3> {
    let wave = |i: usize, s: f32| (i as f32 * s + phase).sin();
    (0..n).map(|i| Vec3::new(wave(i, 1.3), wave(i, 0.7), wave(i, 2.1)) / (n as f32).sqrt()).collect()
}

fn dot(a: &[Vec3], b: &[Vec3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a.as_dvec3().dot(b.as_dvec3())).sum()
}

/// Rotation of every joint but the root, then rotation and translation of the placement, then
/// betas: 81 + 10 numbers.
fn unpack(x: &[f32], origin: bool) -> (Vec<Vec3>, Placement, &[f32]) {
    let vectors: Vec<Vec3> = x[..75].chunks_exact(3).map(Vec3::from_slice).collect();
    let (rotation, translation) = (vectors[0], vectors[24]);
    let placement =
        if origin { Placement::Origin { rotation, translation } } else { Placement::Pelvis { translation } };
    (vectors[..24].to_vec(), placement, &x[75..])
}

fn compare(pose: &[Vec3], translation: Vec3, betas: &[f32], origin: bool) -> Result<(), String> {
    let x: Vec<f32> =
        (pose.iter().chain([&translation])).flat_map(|v| v.to_array()).chain(betas.iter().copied()).collect();
    let (d_vertices, d_joints) = (cotangent(BODY.num_vertices(), 0.3), cotangent(24, 1.1));
    let value = |x: &[f32]| {
        let (pose, placement, betas) = unpack(x, origin);
        let posed = BODY.pose(&BODY.shaped(betas), &pose, placement);
        dot(&posed.vertices, &d_vertices) + dot(&posed.joints, &d_joints)
    };
    let (pose, placement, betas) = unpack(&x, origin);
    let shaped = BODY.shaped(betas);
    let posed = BODY.pose(&shaped, &pose, placement);
    let gradient = BODY.pose_backward(&shaped, &pose, placement, &posed, &d_vertices, &d_joints);
    let mut vectors = gradient.pose.clone();
    match gradient.placement {
        Placement::Pelvis { translation } => vectors.push(translation),
        Placement::Origin { rotation, translation } => {
            assert_eq!(vectors[0], Vec3::ZERO);
            vectors[0] = rotation;
            vectors.push(translation);
        }
    }
    let d_betas = BODY.shaped_backward(&gradient.shaped);
    let analytic: Vec<f32> = vectors.iter().flat_map(|v| v.to_array()).chain(d_betas).collect();
    // Values are sums of a few units in f32 positions: rounding 1e-6 over the step, and a third
    // derivative of a few units.
    check("pose", &x, &analytic, 1e-2, Tolerance { abs: 2e-3, rel: 5e-3 }, value)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn the_gradient_of_posing_agrees_with_differences(
        pose in prop::collection::vec(vec3(0.5), 24),
        translation in vec3(1.0),
        betas in prop::collection::vec(-2.0f32..2.0, 10),
        origin in any::<bool>(),
    ) {
        compare(&pose, translation, &betas, origin).map_err(TestCaseError::fail)?;
    }
}

#[test]
fn the_gradient_holds_at_rest_and_at_half_turns() {
    let betas = [0.0; 10];
    for origin in [false, true] {
        compare(&[Vec3::ZERO; 24], Vec3::ZERO, &betas, origin).unwrap();
        let mut pose = [Vec3::ZERO; 24];
        pose[0] = Vec3::Y * std::f32::consts::PI;
        pose[1] = Vec3::new(0.6, 0.8, 0.0) * (std::f32::consts::PI - 1e-4);
        pose[16] = Vec3::Z * std::f32::consts::PI;
        compare(&pose, Vec3::ONE, &betas, origin).unwrap();
    }
}

#[test]
fn gradients_do_not_depend_on_the_number_of_threads() {
    let body = BodyModel::embedded();
    let shaped = body.shaped(&[1.0]);
    let pose: Vec<Vec3> = (0..24).map(|i| Vec3::new(0.1, -0.05, 0.02) * i as f32).collect();
    let posed = body.pose(&shaped, &pose, Placement::default());
    let d_vertices = cotangent(body.num_vertices(), 0.0);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let gradient = body.pose_backward(&shaped, &pose, Placement::default(), &posed, &d_vertices, &[]);
            (body.shaped_backward(&gradient.shaped), gradient)
        })
    };
    let one = on(1);
    assert!(one.0.iter().all(|d| *d != 0.0), "a shape parameter without derivative: the test tests nothing");
    assert_eq!(one, on(5));
}

#[test]
#[should_panic(expected = "pose_backward: d_vertices")]
fn cotangents_of_another_length_panic() {
    let shaped = BODY.shaped(&[]);
    let posed = BODY.pose(&shaped, &[Vec3::ZERO; 24], Placement::default());
    let _ = BODY.pose_backward(&shaped, &[Vec3::ZERO; 24], Placement::default(), &posed, &[Vec3::ZERO; 3], &[]);
}
