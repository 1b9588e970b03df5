//! Properties of the embedded body, of shaping, posing and the surface motion field.

use std::collections::HashSet;
use std::sync::LazyLock;

use array_files::npz::Npz;
use glam::{Affine3A, Quat, Vec3};
use proptest::prelude::*;
use smpl::{BodyModel, MotionFrame, Placement, Posed, SparseRows, SurfaceMotion, SurfacePoint, rodrigues};
use testkit::files::shared;
use testkit::strategy::{rotation, vec3};

static BODY: LazyLock<BodyModel> = LazyLock::new(BodyModel::embedded);

/// Rotations of all joints, up to about 0.9 rad each; the root's can be anything.
fn pose() -> impl Strategy<Value = Vec<Vec3>> {
    (prop::collection::vec(vec3(0.5), 24), rotation()).prop_map(|(mut pose, root)| {
        pose[0] = root.to_scaled_axis();
        pose
    })
}

fn betas() -> impl Strategy<Value = Vec<f32>> {
    prop::collection::vec(-2.0f32..2.0, 0..=10)
}

fn pelvis(translation: Vec3) -> Placement {
    Placement::Pelvis { translation }
}

fn largest(a: &[Vec3], b: &[Vec3]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

fn moved(points: &[Vec3], by: Affine3A) -> Vec<Vec3> {
    points.iter().map(|&p| by.transform_point3(p)).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_rigid_motion_of_the_placement_moves_the_body_rigidly(
        mut pose in pose(),
        turn in rotation(),
        shift in vec3(2.0),
    ) {
        pose[0] = Vec3::ZERO;
        let shaped = BODY.shaped(&[1.0, -1.0]);
        let plain = BODY.pose(&shaped, &pose, Placement::Origin { rotation: Vec3::ZERO, translation: Vec3::ZERO });
        let axis = turn.to_scaled_axis();
        let placed = BODY.pose(&shaped, &pose, Placement::Origin { rotation: axis, translation: shift });
        let by = Affine3A::from_rotation_translation(turn, shift);
        prop_assert!(largest(&placed.vertices, &moved(&plain.vertices, by)) < 5e-6);
        prop_assert!(largest(&placed.joints, &moved(&plain.joints, by)) < 5e-6);
    }

    #[test]
    fn the_two_placements_agree_where_they_should(pose in pose(), translation in vec3(2.0)) {
        // R (x − p) + p + t = R x + (p − R p + t)
        let shaped = BODY.shaped(&[0.3]);
        let a = BODY.pose(&shaped, &pose, pelvis(translation));
        let root = shaped.joints[0];
        let th = root - rodrigues(pose[0]) * root + translation;
        let b = BODY.pose(&shaped, &pose, Placement::Origin { rotation: pose[0], translation: th });
        prop_assert!(largest(&a.vertices, &b.vertices) < 5e-6);
    }

    #[test]
    fn vertices_are_the_blend_of_bones_that_the_documentation_says(pose in pose(), betas in betas()) {
        let shaped = BODY.shaped(&betas);
        let posed = BODY.pose(&shaped, &pose, pelvis(Vec3::X));
        for v in (0..BODY.num_vertices()).step_by(37) {
            let rest = shaped.vertices[v] + posed.pose_offsets[v];
            let expected: Vec3 = BODY.weights.row(v)
                .map(|(joint, w)| w * posed.bones[joint].transform_point3(rest))
                .sum();
            prop_assert!(posed.vertices[v].distance(expected) < 3e-6);
        }
    }

    #[test]
    fn bones_carry_rest_joints_to_posed_joints(pose in pose(), betas in betas()) {
        let shaped = BODY.shaped(&betas);
        let posed = BODY.pose(&shaped, &pose, Placement::default());
        let to_canonical = posed.to_canonical();
        for joint in 0..24 {
            let carried = posed.bones[joint].transform_point3(shaped.joints[joint]);
            prop_assert!(carried.distance(posed.joints[joint]) < 3e-6);
            let back = to_canonical[joint].transform_point3(posed.joints[joint]);
            prop_assert!(back.distance(shaped.joints[joint]) < 3e-6);
        }
    }

    #[test]
    fn points_near_the_posed_surface_map_back_to_where_they_are_at_rest(
        pose in pose(),
        face in any::<prop::sample::Index>(),
        shares in prop::array::uniform3(0.01f32..1.0),
        away in vec3(0.05),
    ) {
        let shaped = BODY.shaped(&[0.5, 0.5]);
        let posed = BODY.pose(&shaped, &pose, pelvis(Vec3::new(1.0, 2.0, 3.0)));
        let face = face.index(BODY.faces.len());
        let barycentric = shares.map(|share| share / shares.iter().sum::<f32>());
        let corners = || BODY.faces[face].iter().map(|&v| v as usize).zip(barycentric);
        let rest = away + corners().map(|(v, b)| b * shaped.vertices[v]).sum::<Vec3>();
        let moved = rest + corners().map(|(v, b)| b * posed.pose_offsets[v]).sum::<Vec3>();
        let bones = || corners().flat_map(|(v, b)| BODY.weights.row(v).map(move |(joint, w)| (joint, b * w)));
        let point = bones().map(|(joint, w)| w * posed.bones[joint].transform_point3(moved)).sum();
        let blended = bones().fold(glam::Mat3A::ZERO, |sum, (joint, w)| sum + posed.bones[joint].matrix3 * w);
        // One bone takes over below: not an inverse, but still a finite point.
        prop_assume!(blended.determinant() > 0.06);
        let nearest = SurfacePoint { face: face as u32, barycentric, signed_distance: 0.0 };
        let sample = SurfaceMotion::default().map(&MotionFrame::new(&BODY, &posed), point, nearest).unwrap();
        prop_assert_eq!(sample.likelihood, 1.0);
        let error = sample.canonical.distance(rest);
        prop_assert!(error < 1e-4, "{}", error);
    }
}

fn determinant(posed: &Posed, v: usize) -> f32 {
    let mut sum = glam::Mat3A::ZERO;
    for (joint, w) in BODY.weights.row(v) {
        sum += posed.bones[joint].matrix3 * w;
    }
    sum.determinant()
}

#[test]
fn dense_rows_are_summed_like_any_other() {
    // Full rows, which go four at a time, with a sparse and an empty one among them.
    let mut body = BODY.clone();
    let wave = |i: usize| (i as f32 * 0.618).sin();
    body.posedirs = SparseRows::from_rows((0..body.num_vertices()).map(|v| {
        let kept = move |t: &usize| v % 11 != 5 || (v & 1 == 0 && t.is_multiple_of(3));
        (0..207).filter(kept).map(move |t| (t as u32, 0.01 * Vec3::new(wave(v + t), wave(v * t), wave(t))))
    }));
    body.validate("dense").unwrap();
    let shaped = body.shaped(&[]);
    let poses: Vec<Vec<Vec3>> =
        (0..9).map(|f| (0..24).map(|j| 0.3 * Vec3::new(wave(f + j), wave(2 * f + j), wave(f * j))).collect()).collect();
    let on = |threads: usize, pose: &[Vec3]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| body.pose(&shaped, pose, pelvis(Vec3::Z)))
    };
    for pose in &poses {
        let posed = on(1, pose);
        assert_eq!(posed, on(3, pose));
        for v in (0..body.num_vertices()).step_by(7) {
            let mut expected = glam::DVec3::ZERO;
            for (term, direction) in body.posedirs.row(v) {
                let entry = rodrigues(pose[1 + term / 9]).transpose().to_cols_array()[term % 9];
                let identity = f32::from(u8::from(term % 9 % 4 == 0));
                expected += f64::from(entry - identity) * direction.as_dvec3();
            }
            assert!(posed.pose_offsets[v].as_dvec3().distance(expected) < 1e-6);
        }
    }
}

#[test]
#[should_panic(expected = "11 betas, the model has 10")]
fn betas_that_are_not_given_are_zero_and_too_many_panic() {
    assert_eq!(BODY.shaped(&[0.0; 10]), BODY.shaped(&[]));
    let _ = BODY.shaped(&[0.0; 11]);
}

#[test]
fn likelihood_is_one_inside_then_falls_smoothly_to_zero() {
    let field = SurfaceMotion { margin: 0.05, falloff: 0.1 };
    for d in [-1.0, -0.01, 0.0, 0.05] {
        assert_eq!(field.likelihood(d), 1.0);
    }
    for d in [0.15, 0.2, f32::INFINITY] {
        assert_eq!(field.likelihood(d), 0.0);
    }
    let mut last = (1.0f32, 0.0f32);
    for i in 0..=1000 {
        let f = field.likelihood(0.04 + 0.12 * i as f32 / 1000.0);
        let slope = f - last.0;
        assert!(slope <= 1e-6, "rises at {i}");
        // The largest slope is 1.5 / falloff, the largest change of slope 6 / falloff².
        assert!((slope - last.1).abs() < 6.0 / 0.01 * 0.00012f32.powi(2) * 1.1 + 1e-6);
        last = (f, slope);
    }
    let step = SurfaceMotion { margin: 0.05, falloff: 0.0 };
    assert_eq!((step.likelihood(0.05), step.likelihood(0.0501)), (1.0, 0.0));
}

#[test]
fn dead_and_broken_samples_are_none() {
    let shaped = BODY.shaped(&[]);
    let posed = BODY.pose(&shaped, &[Vec3::ZERO; 24], Placement::default());
    let (field, frame) = (SurfaceMotion::default(), MotionFrame::new(&BODY, &posed));
    let nearest = |signed_distance| SurfacePoint { face: 0, barycentric: [1.0, 0.0, 0.0], signed_distance };
    let map = |p, d| field.map(&frame, p, nearest(d));
    assert!(map(Vec3::ZERO, 0.0).is_some());
    assert!(map(Vec3::ZERO, 0.11).is_none());
    assert!(map(Vec3::ZERO, f32::NAN).is_none());
    assert!(map(Vec3::NAN, 0.0).is_none());
    assert!(map(Vec3::splat(f32::INFINITY), 0.0).is_none());
}

#[test]
fn a_fold_gives_finite_points_of_the_heaviest_bone() {
    let shaped = BODY.shaped(&[]);
    let mut pose = vec![Vec3::ZERO; 24];
    pose[18] = Quat::from_rotation_y(-3.1).to_scaled_axis();
    let posed = BODY.pose(&shaped, &pose, Placement::default());
    let (frame, mut folded) = (MotionFrame::new(&BODY, &posed), 0);
    for (i, face) in BODY.faces.iter().enumerate() {
        let v = face[0] as usize;
        folded += usize::from(determinant(&posed, v) < 0.05);
        let nearest = SurfacePoint { face: i as u32, barycentric: [1.0, 0.0, 0.0], signed_distance: 0.0 };
        let sample = SurfaceMotion::default().map(&frame, posed.vertices[v], nearest).unwrap();
        assert!(sample.canonical.distance(shaped.vertices[v]) < 0.15);
    }
    assert!(folded > 0, "the fold reaches no vertex: the test tests nothing");
}

/// Against `smplx.lbs.lbs` in f64.
#[test]
fn posed_bodies_equal_those_of_smplx() {
    let (Some(model), Some(golden)) = (shared("body/open_body.npz"), shared("body/open_body_poses_golden.npz")) else {
        return;
    };
    let body = BodyModel::load(&model).unwrap();
    let mut golden = Npz::open(&golden).unwrap();
    let vectors = |values: Vec<f32>| values.chunks_exact(3).map(Vec3::from_slice).collect::<Vec<_>>();
    let betas = golden.f32("betas", &[None, Some(10)]).unwrap().1;
    let poses = vectors(golden.f32("poses", &[Some(8), Some(72)]).unwrap().1);
    let trans = vectors(golden.f32("trans", &[Some(8), Some(3)]).unwrap().1);
    let vertices = vectors(golden.f32("vertices", &[Some(8), None, Some(3)]).unwrap().1);
    let joints = vectors(golden.f32("joints", &[Some(8), Some(24), Some(3)]).unwrap().1);
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
fn the_embedded_body_is_valid_and_has_the_promised_size() {
    BODY.validate("embedded").unwrap();
    assert_eq!((BODY.num_joints(), BODY.num_betas()), (24, 10));
    assert_eq!((BODY.num_vertices(), BODY.faces.len()), (6890, 13776));
    let (low, high) = BODY.v_template.iter().fold((Vec3::MAX, Vec3::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let size = high - low;
    assert!((1.6..1.8).contains(&size.y) && (1.6..1.8).contains(&size.x), "{size}");
}

#[test]
fn the_embedded_body_is_closed_and_has_no_handles() {
    let mesh = testkit::TriMesh { vertices: BODY.v_template.clone(), faces: BODY.faces.clone() };
    assert!(mesh.is_closed());
    let v = BODY.num_vertices() as i64;
    let f = BODY.faces.len() as i64;
    assert_eq!(v - f * 3 / 2 + f, 2, "Euler characteristic of a sphere");
    assert_eq!(BODY.faces.iter().flatten().collect::<HashSet<_>>().len() as i64, v, "a stray vertex");
}
