//! Both motion fields through their one interface: where points go, and gradients.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

mod common;

use std::sync::LazyLock;

use common::shared;
use glam::Vec3;
use proptest::prelude::*;
use smpl::{
    BodyModel, MotionField, MotionFrame, Placement, Posed, Shaped, SurfaceMotion, SurfacePoint, WeightVolume,
    WeightVolumeConfig,
};
use testkit::gradient::{Tolerance, check};
use testkit::strategy::vec3;

struct Scene {
    body: BodyModel,
    shaped: Shaped,
    posed: Posed,
    volume: MotionField,
}

impl Scene {
    fn new(body: BodyModel) -> Self {
        let shaped = body.shaped(&[]);
        let mut pose = vec![Vec3::ZERO; 24];
        for (joint, angle) in [(1, -0.5), (2, 0.35), (4, 0.35), (5, 0.7)] {
            pose[joint].x = angle;
        }
        pose[16] = Vec3::new(0.3, 0.0, -1.0);
        pose[17] = Vec3::new(-0.4, 0.0, 1.0);
        pose[18] = Vec3::new(0.0, -0.6, 0.0);
        let posed = body.pose(&shaped, &pose, Placement::Pelvis { translation: Vec3::new(0.3, 1.0, -0.2) });
        let weights = WeightVolume::diffused(&body, &shaped, &WeightVolumeConfig::default());
        Self { body, shaped, posed, volume: MotionField::Volume { weights, threshold: 1e-3 } }
    }
}

static SCENE: LazyLock<Scene> = LazyLock::new(|| Scene::new(BodyModel::embedded()));

fn unused() -> Option<SurfacePoint> {
    panic!("a volume asks for no surface point")
}

/// Median and 90th percentile of |x̂ − rest| over the vertices, in millimetres.
fn round_trip(scene: &Scene, field: &MotionField) -> [f32; 2] {
    let frame = MotionFrame::new(&scene.body, &scene.posed);
    let mut seen = vec![false; scene.body.num_vertices()];
    let mut errors = Vec::new();
    for (face, corners) in scene.body.faces.iter().enumerate() {
        for (k, &v) in corners.iter().enumerate() {
            let v = v as usize;
            if std::mem::replace(&mut seen[v], true) {
                continue;
            }
            let mut barycentric = [0.0; 3];
            barycentric[k] = 1.0;
            let nearest = || Some(SurfacePoint { face: face as u32, barycentric, signed_distance: 0.0 });
            let sample = field.map(&frame, scene.posed.vertices[v], nearest);
            errors.push(sample.map_or(f32::INFINITY, |s| 1e3 * s.canonical.distance(scene.shaped.vertices[v])));
        }
    }
    errors.sort_by(f32::total_cmp);
    [errors[errors.len() / 2], errors[errors.len() * 9 / 10]]
}

#[test]
fn posed_vertices_map_back_to_their_rest_positions() {
    let surface = MotionField::Surface(SurfaceMotion::default());
    let others = shared("body/open_body.npz").map(|path| Scene::new(BodyModel::load(&path).unwrap()));
    for scene in [&*SCENE].into_iter().chain(&others) {
        let [median, ninth] = round_trip(scene, &surface);
        assert!(median < 0.05 && ninth < 0.1, "surface kind: median {median} mm, 90 % {ninth} mm");
        let [median, ninth] = round_trip(scene, &scene.volume);
        println!("volume kind: median {median} mm, 90 % {ninth} mm");
        assert!(median < 5.0 && ninth < 50.0, "volume kind: median {median} mm, 90 % {ninth} mm");
    }
}

const STEP: f32 = 1e-3;

/// Whether no bone's weight has a cell face within the step of `x` in a cell that holds any weight,
/// and f keeps on one side of 1.
fn smooth(scene: &Scene, frame: &MotionFrame<'_>, x: Vec3) -> bool {
    let MotionField::Volume { weights: volume, .. } = &scene.volume else { return false };
    let n = volume.resolution;
    let scale = (n - 1) as f32 / (volume.max - volume.min);
    let cell_holds_weight = |bone: usize, cell: Vec3| {
        let [x, y, z] = cell.clamp(Vec3::ZERO, Vec3::splat((n - 2) as f32)).to_array().map(|c| c as usize);
        (0..8).any(|k| {
            let at = ((z + (k >> 2)) * n + y + (k >> 1 & 1)) * n + x + (k & 1);
            volume.weights[bone * n.pow(3) + at] > 0.0
        })
    };
    let cells_agree = frame.to_canonical.iter().enumerate().all(|(bone, transform)| {
        let at = (transform.transform_point3(x) - volume.min) * scale;
        let (low, high) = ((at - 2.0 * STEP * scale).floor(), (at + 2.0 * STEP * scale).floor());
        low == high
            || (0..8).all(|k| {
                let pick = |axis: usize| if k >> axis & 1 == 1 { high[axis] } else { low[axis] };
                !cell_holds_weight(bone, Vec3::new(pick(0), pick(1), pick(2)))
            })
    });
    let f = |x| scene.volume.map(frame, x, unused).map_or(-1.0, |s| s.likelihood);
    let values: Vec<f32> =
        [Vec3::X, Vec3::Y, Vec3::Z].iter().flat_map(|&e| [f(x + e * STEP), f(x - e * STEP)]).collect();
    cells_agree && (values.iter().all(|&f| f == 1.0) || values.iter().all(|&f| (0.02..0.999).contains(&f)))
}

/// Differences of f32 positions of size one, 1e-7 over twice the step; curvature within a cell is
/// mild.
const TOLERANCE: Tolerance = Tolerance { abs: 2e-3, rel: 1e-2 };

#[test]
fn the_volume_kinds_gradients_agree_with_differences() {
    let scene = &*SCENE;
    let frame = MotionFrame::new(&scene.body, &scene.posed);
    let MotionField::Volume { weights: volume, .. } = &scene.volume else { panic!() };
    let (d_canonical, d_likelihood) = (Vec3::new(0.7, -1.1, 0.4), 0.3);
    let value = |field: &MotionField, x: Vec3| {
        let s = field.map(&frame, x, unused).unwrap();
        f64::from(d_canonical.dot(s.canonical)) + f64::from(d_likelihood * s.likelihood)
    };
    let (mut points, mut soft) = (0, 0);
    for (i, v) in scene.posed.vertices.iter().enumerate().step_by(11) {
        let x = *v + 0.05 * Vec3::new((i as f32).sin(), (i as f32 * 1.7).sin(), (i as f32 * 2.3).sin());
        if !smooth(scene, &frame, x) {
            continue;
        }
        let mut d_weights = vec![0.0; volume.weights.len()];
        let d_point = scene.volume.map_backward(&frame, x, unused, d_canonical, d_likelihood, &mut d_weights);
        let at = |x: &[f32]| value(&scene.volume, Vec3::from_slice(x));
        check("point", &x.to_array(), &d_point.to_array(), STEP, TOLERANCE, at).unwrap();
        points += 1;
        // On to Δ, for a few points, in the entries that matter most.
        let blended = d_weights.iter().filter(|d| **d != 0.0).count() > 24;
        if blended && soft < 6 {
            soft += 1;
            let mut d_delta = vec![0.0; d_weights.len()];
            volume.softmax_backward(&d_weights, &mut d_delta);
            let mut entries: Vec<usize> = (0..d_delta.len()).filter(|&i| d_delta[i] != 0.0).collect();
            entries.sort_by(|&a, &b| d_delta[b].abs().total_cmp(&d_delta[a].abs()));
            entries.truncate(8);
            let analytic: Vec<f32> = entries.iter().map(|&i| d_delta[i]).collect();
            let mut moved = volume.clone();
            let at = |values: &[f32]| {
                for (&i, &value) in entries.iter().zip(values) {
                    moved.delta[i] = value;
                }
                moved.update();
                value(&MotionField::Volume { weights: moved.clone(), threshold: 1e-3 }, x)
            };
            // f is 1 at its most, a kink in the weights too; steps of 0.05 in the logarithm stay
            // off it where f < 0.9.
            if scene.volume.map(&frame, x, unused).unwrap().likelihood < 0.9 {
                let tolerance = Tolerance { abs: 2e-4, rel: 2e-2 };
                check("log-weights", &vec![0.0; entries.len()], &analytic, 5e-2, tolerance, at).unwrap();
            } else {
                soft -= 1;
            }
        }
    }
    assert!(points > 60 && soft > 2, "{points} points, {soft} with log-weights: the test tests little");
}

/// The point at `barycentric` of a posed face, and its unit normal.
fn foot(scene: &Scene, face: usize, barycentric: [f32; 3]) -> (Vec3, Vec3) {
    let p = scene.body.faces[face].map(|v| scene.posed.vertices[v as usize]);
    let normal = (p[1] - p[0]).cross(p[2] - p[0]).normalize_or_zero();
    ((0..3).map(|k| barycentric[k] * p[k]).sum(), normal)
}

/// The nearest point to `x` on the part of the face that `within` names: 3 corners the plane, 2 the
/// edge, 1 the corner.
fn nearest(scene: &Scene, face: usize, within: &[usize], x: Vec3) -> SurfacePoint {
    let p = scene.body.faces[face].map(|v| scene.posed.vertices[v as usize].as_dvec3());
    let q = x.as_dvec3();
    let mut b = [0.0f64; 3];
    match *within {
        [a] => b[a] = 1.0,
        [a, c] => {
            let s = (q - p[a]).dot(p[c] - p[a]) / (p[c] - p[a]).length_squared();
            (b[a], b[c]) = (1.0 - s, s);
        }
        _ => {
            let normal = (p[1] - p[0]).cross(p[2] - p[0]);
            let part = |i: usize, j: usize| (p[j] - p[i]).cross(q - p[i]).dot(normal) / normal.length_squared();
            b = [part(1, 2), part(2, 0), part(0, 1)];
        }
    }
    let foot: glam::DVec3 = (0..3).map(|k| b[k] * p[k]).sum();
    SurfacePoint { face: face as u32, barycentric: b.map(|b| b as f32), signed_distance: foot.distance(q) as f32 }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn the_surface_kinds_gradient_agrees_with_differences(
        face in any::<prop::sample::Index>(),
        part in 0usize..3,
        distance in prop_oneof![0.015625f32..0.0390625, 0.0625f32..0.09375],
        d_canonical in vec3(1.0),
    ) {
        let scene = &*SCENE;
        let frame = MotionFrame::new(&scene.body, &scene.posed);
        let face = face.index(scene.body.faces.len());
        let (within, barycentric): (&[usize], _) =
            [(&[0, 1, 2][..], [0.3, 0.4, 0.3]), (&[0, 1], [0.5, 0.5, 0.0]), (&[2], [0.0, 0.0, 1.0])][part];
        let (p, normal) = foot(scene, face, barycentric);
        let x = p + normal * distance;
        // A fold that leaves one bone in charge has another formula on either side of the switch.
        let field = MotionField::Surface(SurfaceMotion::default());
        let value = |x: &[f32]| {
            let x = Vec3::from_slice(x);
            let s = field.map(&frame, x, || Some(nearest(scene, face, within, x))).unwrap();
            f64::from(d_canonical.dot(s.canonical)) + f64::from(0.1 * s.likelihood)
        };
        let found = || Some(nearest(scene, face, within, x));
        let d_point = field.map_backward(&frame, x, found, d_canonical, 0.1, &mut []);
        // The way of the nearest point over a face of a few millimetres is steep: a short step, and
        // rounding to match.
        let tolerance = Tolerance { abs: 8e-3, rel: 2e-2 };
        check("point", &x.to_array(), &d_point.to_array(), 2e-4, tolerance, value).map_err(TestCaseError::fail)?;
    }
}

#[test]
fn the_slope_of_the_likelihood_agrees_with_differences() {
    let field = SurfaceMotion { margin: 0.25, falloff: 0.125 };
    for i in -8..40 {
        // Off the kinks of the second derivative at both ends of the fall.
        let (d, h) = (i as f32 / 64.0 + 1.0 / 128.0, 1.0 / 1024.0);
        let numeric = (field.likelihood(d + h) - field.likelihood(d - h)) / (2.0 * h);
        let slope = field.likelihood_slope(d);
        assert!((numeric - slope).abs() < 0.05 * (1.0 + slope.abs()), "{d}: {numeric} {slope}");
    }
    assert_eq!(SurfaceMotion { margin: 0.25, falloff: 0.0 }.likelihood_slope(0.25), 0.0);
}

#[test]
fn dead_points_have_no_gradient() {
    let scene = &*SCENE;
    let frame = MotionFrame::new(&scene.body, &scene.posed);
    let far = Vec3::splat(50.0);
    let surface = MotionField::Surface(SurfaceMotion::default());
    assert!(surface.map(&frame, far, || None).is_none());
    assert_eq!(surface.map_backward(&frame, far, || None, Vec3::ONE, 1.0, &mut []), Vec3::ZERO);
    let MotionField::Volume { weights, .. } = &scene.volume else { panic!() };
    let mut d_weights = vec![0.0; weights.weights.len()];
    for x in [far, Vec3::NAN, Vec3::splat(f32::INFINITY)] {
        assert!(scene.volume.map(&frame, x, unused).is_none());
        assert_eq!(scene.volume.map_backward(&frame, x, unused, Vec3::ONE, 1.0, &mut d_weights), Vec3::ZERO);
    }
    assert!(d_weights.iter().all(|d| *d == 0.0));
}
