//! Priors that are wrong, and what becomes of them.

use super::*;
use crate::capture::{Image, Pixels};
use glam::{Affine3A, Mat3, Vec2};
use smpl::Placement;
use surface_query::vertex_normals;
use synth::{DemoConfig, Perturbation, demo};

/// A frame without a subject.
pub(super) fn frame(pose: Vec<Vec3>, placement: Placement) -> Frame {
    let camera = volrender::Camera::new(Mat3::IDENTITY, Affine3A::IDENTITY, 1, 1).unwrap();
    let pixels = Pixels { image: Image::new(1, 1), mask: vec![0.0], occluder: None };
    Frame {
        name: String::new(),
        source: pixels.into(),
        camera,
        pose,
        placement,
        betas: Vec::new(),
        keypoints: Vec::new(),
    }
}

fn registered(capture: &Capture, body: &BodyModel, rounds: usize) -> Capture {
    register(Mended::from(capture.clone()), body, rounds).unwrap().capture
}

fn small() -> DemoConfig {
    DemoConfig { size: 96, frames: 60, eval_cameras: 1, eval_every: 30, ..Default::default() }
}

/// Without noise in the bodies that are given.
fn exact() -> DemoConfig {
    DemoConfig { pose_noise_degrees: 0.0, translation_noise: 0.0, beta_noise: 0.0, ..small() }
}

/// Root mean square distance between the joints of two captures in the training image, pixels.
fn apart(a: &Capture, b: &Capture, body: &BodyModel) -> f32 {
    let joints = |frame: &Frame| -> Vec<Vec3> {
        let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
        posed.joints.iter().filter_map(|&joint| frame.camera.project(joint)).collect()
    };
    let (mut sum, mut count) = (0.0, 0);
    for (a, b) in a.train.iter().zip(&b.train) {
        for (a, b) in joints(a).iter().zip(joints(b)) {
            sum += a.truncate().distance_squared(b.truncate());
            count += 1;
        }
    }
    (sum / count as f32).sqrt()
}

#[test]
fn a_frame_that_the_body_is_not_in_changes_nothing_and_leaves_the_focal_length_unknown() {
    let body = BodyModel::embedded();
    let mut given = demo(&DemoConfig { frames: 6, ..small() }, &body).unwrap();
    given.eval.clear();
    let aside = |placement: Placement| match placement {
        Placement::Pelvis { translation } => Placement::Pelvis { translation: translation + Vec3::X * 40.0 },
        Placement::Origin { rotation, translation } => {
            Placement::Origin { rotation, translation: translation + Vec3::X * 40.0 }
        }
    };
    given.train[3].placement = aside(given.train[3].placement);
    let found = registered(&given, &body, 4);
    assert_ne!(found.train[0].placement, given.train[0].placement);
    assert!(found.train.iter().all(|frame| frame.pose.iter().all(|angle| angle.is_finite())));
    // The body is nowhere to be seen.
    given.train.iter_mut().for_each(|frame| frame.placement = aside(frame.placement));
    registered(&given, &body, 4);
}

#[test]
fn what_is_wrong_with_a_prior_is_mostly_mended_whatever_the_number_of_threads() {
    let body = BodyModel::embedded();
    let truth = demo(&exact(), &body).unwrap();
    for (noise, most) in [
        (Perturbation { pose_degrees: 4.0, ..Perturbation::default() }, 0.8),
        (Perturbation { shape: 1.0, ..Perturbation::default() }, 0.4),
    ] {
        let mut given = demo(&small(), &body).unwrap();
        noise.apply(&mut given, &body).unwrap();
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| registered(&given, &body, 8))
        };
        let (found, again) = (run(1), run(2));
        let (before, after) = (apart(&truth, &given, &body), apart(&truth, &found, &body));
        assert!(after < most * before, "{noise:?}: {before} pixels before, {after} after");
        assert_eq!(found.mean_betas, again.mean_betas);
        for (a, b) in found.train.iter().zip(&again.train) {
            assert!(a.pose == b.pose && a.placement == b.placement && a.betas == b.betas);
        }
        let view = &found.eval[0];
        assert_eq!(view.frame.pose, found.train[view.train_index].pose);
    }
}

#[test]
fn key_points_mend_poses_that_outlines_do_not_show() {
    let body = BodyModel::embedded();
    let truth = demo(&exact(), &body).unwrap();
    let mut given = demo(&small(), &body).unwrap();
    Perturbation { pose_degrees: 5.0, ..Perturbation::default() }.apply(&mut given, &body).unwrap();
    let without = registered(&given, &body, 8);
    for (frame, truth) in given.train.iter_mut().zip(&truth.train) {
        let posed = body.pose(&body.shaped(&truth.betas), &truth.pose, truth.placement);
        let point = |joint: usize| {
            // The detector's joints lie 2 cm beside the body's.
            let place = truth.camera.project(posed.joints[joint] + 0.02 * Vec3::X)?.truncate();
            Some(Keypoint { joint, place, confidence: 0.9 })
        };
        frame.keypoints = [1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21].into_iter().filter_map(point).collect();
    }
    let with = registered(&given, &body, 8);
    let [given, without, with] = [&given, &without, &with].map(|capture| apart(&truth, capture, &body));
    assert!(with < 0.92 * without, "{given} pixels before, {without} without key points, {with} with them");
}

#[test]
fn fists_are_found_and_flat_hands_stay_flat() {
    let body = BodyModel::embedded();
    for fist in [false, true] {
        let config = DemoConfig { size: 192, frames: 32, fist, occluded_fraction: 0.0, ..small() };
        let given = demo(&config, &body).unwrap();
        let fists = register(Mended::from(given), &body, 12).unwrap().fists;
        assert!(fists.iter().all(|&curl| if fist { curl >= 0.5 } else { curl == 0.0 }), "{fist}: {fists:?}");
    }
}

#[test]
fn errors_of_fast_motion_are_forgotten_in_fewer_frames() {
    let body = BodyModel::embedded();
    let capture = demo(&DemoConfig { size: 16, ..small() }, &body).unwrap();
    let frames: Vec<usize> = (0..capture.train.len()).collect();
    let slow = rate(&capture, &frames);
    // A frame in four: up to four times the turn between neighbours, no more a frame of the video.
    let quarter: Vec<usize> = frames.iter().copied().step_by(4).collect();
    let apart = rate(&capture, &quarter);
    assert!(apart > 0.5 * slow && apart < 1.01 * slow, "{slow} {apart}");
    let fast = Capture { train: quarter.iter().map(|&f| capture.train[f].clone()).collect(), ..capture.clone() };
    let [slow, fast] = [slow, rate(&fast, &frames[..15])].map(|rate| PoseErrorModel::of_motion(rate).frames);
    assert!(fast < 0.6 * slow && fast >= 1.0, "{slow} {fast}");
    assert!(PoseErrorModel::of_motion(rate(&capture, &[3])).frames >= slow);
}

#[test]
fn limbs_of_a_rig_that_are_too_long_or_too_short_are_mended() {
    let rig = BodyModel { shapedirs: Vec::new(), ..BodyModel::embedded() };
    let truth = demo(&DemoConfig { size: 192, ..exact() }, &rig).unwrap();
    let mut longer = rig.clone();
    Perturbation { limbs_percent: 8.0, ..Perturbation::default() }.corrupt_body(&mut longer);
    let longer = longer.with_limb_lengths();
    let found = registered(&truth, &longer, 12);
    let longest = |body: &BodyModel, betas: &[f32]| -> Vec<f32> {
        let (limbs, joints) = (rig.limbs(), body.shaped(betas).joints);
        let pairs = limbs.pairs().into_iter().take(3);
        pairs.map(|j| joints[j].distance(joints[rig.parents[j].unwrap()])).collect()
    };
    let (right, before, after) = (longest(&rig, &[]), longest(&longer, &[]), longest(&longer, &found.mean_betas));
    let error = |lengths: &[f32]| lengths.iter().zip(&right).map(|(a, b)| (a / b - 1.0).abs()).sum::<f32>() / 3.0;
    assert!(error(&before) > 0.03 && error(&after) < 0.4 * error(&before), "{right:?} {before:?} {after:?}");
}

#[test]
fn a_wrong_depth_is_found_from_how_large_the_person_is() {
    let body = BodyModel::embedded();
    let truth = demo(&DemoConfig { size: 192, ..exact() }, &body).unwrap();
    let mut given = truth.clone();
    Perturbation { depth_percent: 3.0, ..Perturbation::default() }.apply(&mut given, &body).unwrap();
    let found = registered(&given, &body, 12);
    let apart = |capture: &Capture| -> f32 {
        let root = |frame: &Frame| body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement).joints[0];
        let each = truth.train.iter().zip(&capture.train).map(|(a, b)| root(a).distance_squared(root(b)));
        (each.sum::<f32>() / truth.train.len() as f32).sqrt()
    };
    assert!(apart(&found) < 0.3 * apart(&given), "{} of {} m are left", apart(&found), apart(&given));
}

#[test]
fn a_right_prior_stays_as_it_is() {
    let body = BodyModel::embedded();
    let truth = demo(&exact(), &body).unwrap();
    let found = registered(&truth, &body, 8);
    let moved = apart(&truth, &found, &body);
    assert!(moved < 0.4, "{moved} pixels");
}

#[test]
fn nothing_is_changed_where_nothing_is_seen() {
    let body = BodyModel::embedded();
    let mut given = demo(&small(), &body).unwrap();
    for frame in &mut given.train {
        frame.source.edit(|pixels| pixels.mask.fill(0.0));
    }
    let found = registered(&given, &body, 3);
    assert!(apart(&given, &found, &body) < 1e-3);
}

#[test]
fn clothes_are_found_as_far_out_as_they_are_and_an_occluder_is_no_outline() {
    let body = BodyModel::embedded();
    let mut capture = demo(&DemoConfig { frames: 1, occluded_share: 0.0, size: 256, ..small() }, &body).unwrap();
    let frame = &mut capture.train[0];
    let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
    let normals = vertex_normals(&posed.vertices, &body.faces);
    let thick = 0.02;
    let dressed: Vec<Vec3> =
        posed.vertices.iter().zip(&normals).map(|(v, n)| *v + thick * n.normalize_or_zero()).collect();
    let mesh = visibility::RayMesh::new(&dressed, &body.faces).unwrap();
    let hidden = |column: u32| column >= 128;
    let (camera, shared_edges) = (frame.camera, shared_edges(&body.faces));
    let mut distances = [false, true].map(|occluded| {
        let see = |pixels: &mut Pixels| {
            for i in 0..256 * 256u32 {
                let ray = camera.ray((i % 256) as f32 + 0.5, (i / 256) as f32 + 0.5);
                let shows = mesh.first_hit(ray.origin, ray.direction).is_some() && !(occluded && hidden(i % 256));
                pixels.mask[i as usize] = f32::from(u8::from(shows));
            }
        };
        let mut pixels = frame.pixels().unwrap();
        see(&mut pixels);
        frame.source = pixels.into();
        let crop = Crop::new(&frame.camera, &frame.pixels().unwrap(), &posed.vertices).unwrap();
        let options = ObservationOptions { reach: 10.0, blur: 0.0, unit: 1.0 };
        let found = observe(&crop, &posed.vertices, (&body.faces, &shared_edges), options).unwrap();
        let each = found.edges.iter().map(|edge| {
            let column = camera.project(posed.vertices[edge.vertex as usize]).unwrap().x;
            (edge.distance / edge.scale, column)
        });
        each.collect::<Vec<_>>()
    });
    assert!(distances[0].len() > 100 && distances[1].len() > 30);
    assert!(distances[1].iter().all(|&(_, column)| column < 132.0), "an edge at the occluder");
    for found in &mut distances {
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        let median = found[found.len() / 2].0;
        assert!((median - thick).abs() < 0.004, "{median}");
    }
}

/// Spheres of a few pixels, whose masks are counted on a grid of 16 × 16 samples a pixel: half the
/// coverage lies inside their outline, the rendered coverage on it.
#[test]
fn outlines_of_small_things_are_found_without_bias() {
    let sphere = testkit::mesh::icosphere(4);
    let camera = Camera::new(Mat3::from_diagonal(Vec3::new(1e3, 1e3, 1.0)), Affine3A::IDENTITY, 32, 32).unwrap();
    for radius in [2.2, 3.0, 5.0] {
        let centre = Vec2::new(15.37, 15.71);
        let placed: Vec<Vec3> = sphere.vertices.iter().map(|v| centre.extend(1e3) + radius * *v).collect();
        for off in [0.0, 0.6] {
            let inside = |x: f32, y: f32| f32::from(u8::from(Vec2::new(x, y).distance(centre) < radius + off));
            let mask = |i: usize| {
                let grid = (0..256).map(|k| (k % 16, k / 16));
                let sample = |(x, y)| {
                    inside((i % 32) as f32 + (x as f32 + 0.5) / 16.0, (i / 32) as f32 + (y as f32 + 0.5) / 16.0)
                };
                grid.map(sample).sum::<f32>() / 256.0
            };
            let mask: Vec<f32> = (0..32 * 32).map(mask).collect();
            let image = Image { width: 32, height: 32, pixels: mask.iter().flat_map(|m| [*m; 3]).collect() };
            let corners = [Vec3::new(0.0, 0.0, 1e3), Vec3::new(32.0, 32.0, 1e3)];
            let crop = Crop::new(&camera, &Pixels { image, mask, occluder: None }, &corners).unwrap();
            let options = ObservationOptions { reach: 4.0, blur: 0.0, unit: 1.0 };
            let found = observe(&crop, &placed, (&sphere.faces, &shared_edges(&sphere.faces)), options).unwrap().edges;
            let mean = found.iter().map(|edge| edge.distance).sum::<f32>() / found.len() as f32;
            assert!(found.len() >= 30, "{}", found.len());
            assert!((mean - off).abs() < 0.03 + 0.1 * off, "{radius} {off}: {mean}");
        }
    }
}

/// The middle of an antialiased edge is where its coverage says, wherever it falls between pixels.
#[test]
fn edges_of_antialiased_masks_are_found_without_bias() {
    let mut errors = Vec::new();
    for step in 0..20 {
        let edge = 8.0 + step as f32 / 20.0;
        let mask: Vec<f32> = (0..256).map(|i| (edge - (i % 16) as f32).clamp(0.0, 1.0)).collect();
        let image = Image { width: 16, height: 16, pixels: mask.iter().flat_map(|m| [*m; 3]).collect() };
        let camera = volrender::Camera::new(Mat3::IDENTITY, Affine3A::IDENTITY, 16, 16).unwrap();
        let corners = [Vec3::new(0.0, 0.0, 1.0), Vec3::new(16.0, 16.0, 1.0)];
        let crop = Crop::new(&camera, &Pixels { image, mask, occluder: None }, &corners).unwrap();
        let at = |x: f32| crop.coverage_at(Vec2::new(x, 8.0)).unwrap();
        let mut found = 4.0;
        while at(found) >= 0.5 {
            found += 0.01;
        }
        errors.push(found - edge);
    }
    let mean = errors.iter().sum::<f32>() / errors.len() as f32;
    assert!(mean.abs() < 0.02, "{mean}");
    assert!(errors.iter().all(|error| error.abs() < 0.15), "{errors:?}");
}

#[test]
fn a_wrong_focal_length_is_mostly_mended_where_no_other_camera_says_what_it_is() {
    let body = BodyModel::embedded();
    let mut truth = demo(&DemoConfig { size: 192, frames: 30, ..exact() }, &body).unwrap();
    truth.eval.clear();
    for (factor, most) in [(0.5, 0.25), (4.0, 0.3)] {
        let mut given = truth.clone();
        for frame in &mut given.train {
            frame.placement = rescaled(frame.placement, root_depth(frame, &body).unwrap(), 1.0 / factor);
            frame.camera.focal *= factor;
        }
        let registered = registered(&given, &body, 12);
        let (found, true_focal) = (registered.train[0].camera.focal.x, truth.train[0].camera.focal.x);
        let left = (true_focal / found - 1.0).abs() / (factor.recip() - 1.0).abs();
        assert!(left < most, "{factor}: {found} for {true_focal}");
        assert!(registered.train.iter().all(|f| f.camera.focal.x == found));
    }
}

#[test]
fn the_picture_moves_with_the_perspective_as_by_finite_differences() {
    let body = BodyModel::embedded();
    let truth = demo(&small(), &body).unwrap();
    let frame = &truth.train[0];
    let way = root_depth(frame, &body).unwrap();
    let posed = |inverse_depth: f32| {
        let mut camera = frame.camera;
        camera.focal /= inverse_depth;
        let placement = rescaled(frame.placement, way, inverse_depth);
        (body.pose(&body.shaped(&frame.betas), &frame.pose, placement), camera)
    };
    for inverse_depth in [0.6, 1.0, 1.7] {
        let (here, camera) = posed(inverse_depth);
        let perspective = equations::Perspective { inverse_depth, depth: way.length() };
        let ([more, less], h) = ([posed(inverse_depth + 0.01), posed(inverse_depth - 0.01)], 0.02);
        let project =
            |(posed, camera): &(Posed, Camera), v: usize| camera.project(posed.vertices[v]).unwrap().truncate();
        for v in (0..body.num_vertices()).step_by(11) {
            let numeric = (project(&more, v) - project(&less, v)) / h;
            let shift = perspective.derivative(&camera, here.vertices[v]);
            let at = |h: f32| camera.project(here.vertices[v] + h * shift).unwrap().truncate();
            let analytic = (at(0.01) - at(-0.01)) / 0.02;
            assert!((numeric - analytic).length() < 0.02 + 0.02 * numeric.length(), "{numeric} {analytic}");
        }
    }
}
