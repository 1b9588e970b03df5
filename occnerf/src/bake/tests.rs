//! A bake of fields that are known, and of a person in training.

use std::sync::Arc;

use glam::{Affine3A, Mat3, Vec2, Vec3, Vec4};
use synth::{DemoConfig, Outfit, demo};
use visibility::Samples;

use super::charts::{AtlasLayout, PADDING};
use super::draw::BakedRenderer;
use super::make::{Relief, add_motion, assemble, bake, fit, surface};
use super::refine::equations;
use super::surface::{CanonicalField, Place, Texel};
use super::{Avatar, BakeReport, skirted, turn_upright};
use crate::capture::{Capture, Light};
use crate::config::{Config, Method, Preset};
use crate::model::trained::upright;
use crate::render::{FieldRenderer, Renderer};
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::train::trainer::Trainer;

/// Height of the known field over the prior.
const HEIGHT: f32 = 0.0123;

fn known_colour(at: Vec3) -> Vec3 {
    Vec3::new((3.0 * at.y).sin(), (4.0 * at.x).cos(), (5.0 * at.z).sin()) * 0.4 + 0.5
}

/// The avatar of a field with this density, in a colour that changes from place to place.
fn known(scene: &Scene, density: impl Fn(Vec3, f32) -> f32 + Sync) -> (Avatar, BakeReport) {
    let evaluate =
        |places: &[Place]| places.iter().map(|p| (density(p.closest, p.distance), known_colour(p.closest))).collect();
    let field = CanonicalField { evaluate: &evaluate, grazing: 0.0, reach: 0.06 };
    let seen = vec![1.0; scene.body.canonical.vertices.len()];
    surface(&scene.body, &field, &seen, 0.012).unwrap()
}

fn scene(config: &Config) -> Scene {
    let body = smpl::BodyModel::embedded();
    let demo_config = DemoConfig { size: 48, frames: 4, eval_cameras: 1, ..DemoConfig::default() };
    Scene::new(&demo(&demo_config, &body).unwrap(), &body, config).unwrap()
}

fn baked(density: impl Fn(Vec3, f32) -> f32 + Sync) -> (Scene, Avatar, BakeReport) {
    let scene = scene(&Config::preset(Preset::Fast, Method::Occnerf));
    let (avatar, report) = known(&scene, density);
    avatar.validate().unwrap();
    (scene, avatar, report)
}

/// Whether each vertex of an avatar moves with no hand, foot or head: surfaces are smoothed across
/// the folds of fingers, toes, eyes and lips.
fn off_folds(avatar: &Avatar) -> Vec<bool> {
    let folded = |joint: u16| matches!(joint, 7 | 8 | 10 | 11 | 15 | 20..);
    let weight = |(joints, weights): (&[u16; 4], &[f32; 4])| -> f32 {
        joints.iter().zip(weights).filter(|(joint, _)| folded(**joint)).map(|(_, w)| w).sum()
    };
    avatar.joints.iter().zip(&avatar.weights).map(|skin| weight(skin) < 0.5).collect()
}

/// Canonical distances of an avatar's vertices from the prior, normalised metres.
fn distances(scene: &Scene, avatar: &Avatar) -> Vec<f32> {
    let distance = |v: &Vec3| scene.body.surface.closest(scene.body.scale * v).signed_distance;
    avatar.vertices.iter().map(distance).collect()
}

#[test]
fn the_surface_is_where_a_known_field_becomes_opaque_and_has_its_colours() {
    let (scene, avatar, report) = baked(|_, d| if d < HEIGHT { 5000.0 } else { 0.0 });
    let mut off: Vec<f32> = (distances(&scene, &avatar).iter().zip(off_folds(&avatar)))
        .filter(|(_, off_folds)| *off_folds)
        .map(|(d, _)| (d - HEIGHT).abs())
        .collect();
    off.sort_by(f32::total_cmp);
    // Folds, where two parts of the prior are equally near, are smoothed.
    assert!(off[off.len() * 9 / 10] < 0.002, "{:?}", &off[off.len() * 9 / 10..][..5]);
    assert_eq!(report.holes, 0);
    // Texels at the vertices show the colours of the points of the prior below.
    let size = avatar.atlas.width as f32;
    let mut errors: Vec<f32> = (avatar.vertices.iter().zip(&avatar.uvs))
        .map(|(v, uv)| {
            let [x, y] = (*uv * size).to_array().map(|x| (x as usize).min(size as usize - 1));
            let texel = 3 * (y * size as usize + x);
            let found = Vec3::from([0, 1, 2].map(|c| f32::from(avatar.atlas.rgb[texel + c]) / 255.0));
            let below = scene.body.surface.closest(scene.body.scale * v).point;
            (found - known_colour(below)).abs().max_element()
        })
        .collect();
    errors.sort_by(f32::total_cmp);
    assert!(errors[errors.len() * 9 / 10] < 0.03, "{}", errors[errors.len() * 9 / 10]);
}

/// Four rays a pixel tell which pixels show the surface, and at what slant.
#[test]
fn textures_are_fitted_to_pixels_of_surface_that_does_not_graze() {
    let (body, config) = (smpl::BodyModel::embedded(), Config::preset(Preset::Fast, Method::Surface));
    let large = demo(&DemoConfig { size: 160, frames: 2, eval_cameras: 0, ..DemoConfig::default() }, &body).unwrap();
    let scene = Scene::new(&large, &body, &config).unwrap();
    let (avatar, _) = known(&scene, |_, d| if d < HEIGHT { 5000.0 } else { 0.0 });
    let mut renderer = BakedRenderer::new(&avatar, scene.body.scale, Light::default(), Samples::Four);
    let (_, reliability, _) = scene.lighting().unwrap();
    let [mut found, mut expected, mut grazing] = [0; 3];
    for frame in &scene.train {
        found += equations(&avatar, &mut renderer, frame, 1, (reliability, None)).unwrap().len();
        let (vertices, camera) = (renderer.skin(&frame.view.posed.bones).0.to_vec(), &frame.view.camera);
        let mesh = visibility::RayMesh::new(&vertices, &avatar.faces).unwrap();
        let mask = &frame.pixels().unwrap().mask;
        for i in (0..mask.len()).filter(|&i| frame.labels.at(i as u32) == Label::Subject && mask[i] >= 0.99) {
            let (x, y) = ((i as u32 % camera.width) as f32, (i as u32 / camera.width) as f32);
            let cosine = |(u, v): (f32, f32)| {
                let ray = camera.ray(x + u, y + v);
                let [a, b, c] = avatar.faces[mesh.first_hit(ray.origin, ray.direction)?.face as usize]
                    .map(|v| vertices[v as usize]);
                Some((b - a).cross(c - a).normalize_or_zero().dot(-ray.direction.normalize_or_zero()))
            };
            let Some(cosines) = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)]
                .map(cosine)
                .into_iter()
                .collect::<Option<Vec<f32>>>()
            else {
                continue;
            };
            let is_grazing = cosines.iter().sum::<f32>() < 4.0 * 0.3;
            [expected, grazing] = [expected + usize::from(!is_grazing), grazing + usize::from(is_grazing)];
        }
    }
    assert!(
        grazing > 10 && found.abs_diff(expected) <= 6,
        "{found} equations, {expected} pixels, {grazing} that graze"
    );
}

#[test]
fn holes_take_the_height_of_what_is_about_them() {
    // Nothing over the left half of the head.
    let holed = |p: Vec3, d| if d < HEIGHT && !(p.y > 0.5 && p.x > 0.02) { 5000.0 } else { 0.0 };
    let (scene, avatar, report) = baked(holed);
    assert!(report.holes > 10, "{report:?}");
    assert!(distances(&scene, &avatar).iter().all(|d| (-0.031..0.061).contains(d)));
    let (scene, avatar, report) = baked(|_, _| 0.0);
    assert!(report.holes > 0 && distances(&scene, &avatar).iter().all(|d| d.abs() < 1e-3));
}

/// Texels of a square atlas whose centres lie inside a triangle, by the signs of three areas.
fn covered(corners: [Vec2; 3], side: u32) -> Vec<usize> {
    let [a, b, c] = corners.map(|c| c.as_dvec2());
    let (low, high) = (a.min(b).min(c).floor(), a.max(b).max(c).ceil());
    let turn = (b - a).perp_dot(c - a).signum();
    let mut out = Vec::new();
    for y in low.y as usize..(high.y as usize).min(side as usize) {
        for x in low.x as usize..(high.x as usize).min(side as usize) {
            let p = glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            if [(a, b), (b, c), (c, a)].iter().all(|(s, e)| turn * (e - s).perp_dot(p - s) > 0.0) {
                out.push(y * side as usize + x);
            }
        }
    }
    out
}

#[test]
fn no_two_faces_share_a_texel_and_charts_keep_their_distance() {
    let scene = scene(&Config::preset(Preset::Fast, Method::Occnerf));
    let (vertices, faces) = (&scene.body.canonical.vertices, &scene.body.model.faces);
    let layout = AtlasLayout::new(vertices, faces, 0.006, 1024).unwrap();
    let side = layout.side;
    let mut owner = vec![None; (side * side) as usize];
    let mut doubles = 0;
    for (face, &chart) in faces.iter().zip(&layout.charts) {
        let corners = face.map(|v| layout.place(chart, vertices[v as usize]));
        let inside = |c: &Vec2| c.min_element() >= 0.0 && c.max_element() <= side as f32;
        assert!(corners.iter().all(inside), "{corners:?} in {side}");
        for i in covered(corners, side) {
            doubles += usize::from(owner[i].is_some_and(|of| of == chart));
            assert!(owner[i].is_none_or(|of| of == chart), "two charts at {i}");
            owner[i] = Some(chart);
        }
    }
    let used = owner.iter().flatten().count();
    // Charts of a body fill about a ninth of the square.
    assert!(doubles * 1000 <= used && used * 10 > owner.len(), "{doubles} of {used} in {}", owner.len());
    // Within the padding of a texel there is none of another chart.
    let side = side as usize;
    for i in (0..owner.len()).filter(|&i| owner[i].is_some()) {
        let ahead = (1..PADDING as usize).filter(|k| i % side + k < side).map(|k| i + k);
        for j in ahead {
            assert!(owner[j].is_none_or(|of| Some(of) == owner[i]), "charts {:?} {:?}", owner[i], owner[j]);
        }
    }
}

#[test]
fn an_atlas_that_is_too_small_has_wider_texels_and_degenerate_meshes_have_one_too() {
    let scene = scene(&Config::preset(Preset::Fast, Method::Occnerf));
    let layout = AtlasLayout::new(&scene.body.canonical.vertices, &scene.body.model.faces, 1e-3, 512).unwrap();
    assert!(layout.side <= 512);
    // As from pictures of millions of pixels, in no more memory.
    let finest = AtlasLayout::new(&scene.body.canonical.vertices, &scene.body.model.faces, 1e-6, 512).unwrap();
    assert!(finest.side <= 512 && finest.charts == layout.charts);
    for (name, points) in testkit::strategy::degenerate_clouds() {
        if points.iter().all(|p| p.is_finite() && p.abs().max_element() < 1e6) {
            let n = points.len() as u32;
            let faces: Vec<[u32; 3]> = (0..n.saturating_sub(2)).map(|i| [i, i + 1, i + 2]).collect();
            assert!(AtlasLayout::new(&points, &faces, 0.01, 512).is_some_and(|l| l.side <= 512), "{name}");
        }
    }
}

/// A square of two triangles, 2 wide, at z = 0, seen from +z, with a joint.
fn square(rgb: &[[u8; 3]], width: u32) -> Avatar {
    let corners = [(-1.0, 1.0), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)];
    Avatar {
        name: "square".to_owned(),
        source: "of a test".to_owned(),
        vertices: corners.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec(),
        normals: vec![Vec3::Z; 4],
        uvs: corners.map(|(x, y)| Vec2::new(0.5 + 0.5 * x, 0.5 - 0.5 * y)).to_vec(),
        faces: vec![[0, 2, 1], [1, 2, 3]],
        joints: vec![[0; 4]; 4],
        weights: vec![[1.0, 0.0, 0.0, 0.0]; 4],
        posedirs: smpl::SparseRows::from_rows(vec![Vec::<(u32, Vec3)>::new(); 4]),
        atlas: super::Atlas {
            width,
            height: rgb.len() as u32 / width,
            rgb: rgb.as_flattened().to_vec(),
            confidence: vec![255; rgb.len()],
        },
        skeleton: smpl::skeleton(smpl::BoneNames::Smpl, &[None], &[Vec3::ZERO]),
        light: Light::default(),
        betas: Vec::new(),
        clips: Vec::new(),
        cameras: Vec::new(),
    }
}

/// From 4 in front of the origin, in which the square fills the picture.
fn in_front(size: u32) -> volrender::Camera {
    let (focal, middle) = (2.0 * size as f32, 0.5 * size as f32);
    let intrinsics = Mat3::from_cols(Vec3::X * focal, Vec3::Y * focal, Vec3::new(middle, middle, 1.0));
    let flip = Mat3::from_cols(Vec3::X, -Vec3::Y, -Vec3::Z);
    volrender::Camera::new(intrinsics, Affine3A::from_mat3_translation(flip, Vec3::Z * 4.0), size, size).unwrap()
}

fn picture(avatar: &Avatar, bones: &[Affine3A], size: u32, samples: Samples) -> Vec<Vec4> {
    let mut renderer = BakedRenderer::new(avatar, 1.0, Light::default(), samples);
    renderer.draw(bones, &in_front(size)).unwrap().to_vec()
}

#[test]
fn a_square_shows_its_texels_interpolated_between_their_middles() {
    let texels: Vec<[u8; 3]> = (0..16).map(|i| [i * 16, 255 - i * 7, i * 3]).collect();
    let value = |x: usize, y: usize| Vec3::from(texels[4 * y + x].map(|byte| f32::from(byte) / 255.0)).extend(1.0);
    let avatar = square(&texels, 4);
    // A texel a pixel: their middles coincide.
    for (i, pixel) in picture(&avatar, &[Affine3A::IDENTITY], 4, Samples::One).into_iter().enumerate() {
        assert!((pixel - value(i % 4, i / 4)).abs().max_element() < 1e-3, "{i}: {pixel}");
    }
    // Against interpolation written out.
    for (i, pixel) in picture(&avatar, &[Affine3A::IDENTITY], 32, Samples::One).into_iter().enumerate() {
        let at = |p: usize| ((p as f32 + 0.5) / 8.0 - 0.5).clamp(0.0, 3.0);
        let (x, y) = (at(i % 32), at(i / 32));
        let mut expected = Vec4::ZERO;
        for (ty, tx) in (0..4).flat_map(|ty| (0..4).map(move |tx| (ty, tx))) {
            let share = (1.0 - (x - tx as f32).abs()).max(0.0) * (1.0 - (y - ty as f32).abs()).max(0.0);
            expected += share * value(tx, ty);
        }
        assert!((pixel - expected).abs().max_element() < 2e-3, "{i}: {pixel} {expected}");
    }
}

#[test]
fn an_atlas_of_one_texel_and_a_back_that_is_not_drawn() {
    let avatar = square(&[[51, 102, 204]], 1);
    let expected = Vec4::new(0.2, 0.4, 0.8, 1.0);
    for pixel in picture(&avatar, &[Affine3A::IDENTITY], 8, Samples::Four) {
        assert!((pixel - expected).abs().max_element() < 1e-4, "{pixel}");
    }
    let turned = Affine3A::from_rotation_y(std::f32::consts::PI);
    assert!(picture(&avatar, &[turned], 8, Samples::One).iter().all(|p| *p == Vec4::ZERO));
}

#[test]
fn a_light_is_as_bright_as_the_surface_is_turned_to_it_and_no_brighter_than_white() {
    let avatar = square(&[[51, 102, 204]], 1);
    let albedo = Vec3::new(0.2, 0.4, 0.8);
    for (degrees, slope) in [(0.0f32, 0.5), (0.0, -0.5), (40.0, 0.5), (-40.0, 0.5), (0.0, 0.0)] {
        let turned = Affine3A::from_rotation_y(degrees.to_radians());
        let light = Light { slope: Vec3::new(0.0, 0.0, slope) };
        let mut renderer = BakedRenderer::new(&avatar, 1.0, light, Samples::One);
        let found = renderer.draw(&[turned], &in_front(9)).unwrap()[40];
        let along = degrees.to_radians().cos();
        let brightness = 1.0 + slope * along + 0.5 * slope.abs() * (along * along - 1.0 / 3.0);
        let expected = (albedo * brightness).min(Vec3::ONE).extend(1.0);
        assert!((found - expected).abs().max_element() < 1e-4, "{degrees} {slope}: {found} {expected}");
    }
}

#[test]
fn a_person_in_training_is_baked_refined_and_drawn_alike_on_any_number_of_threads() {
    let mut config = Config { steps: 60, ..Config::preset(Preset::Fast, Method::Occnerf) };
    config.surface.surface_term = true;
    let scene = scene(&config);
    let mut trainer = Trainer::new(&scene, config).unwrap();
    for _ in 0..60 {
        trainer.step().unwrap();
    }
    let make = || {
        let (avatar, report) = bake(trainer.model(), Some(&scene)).unwrap();
        let mut renderer = BakedRenderer::new(&avatar, scene.body.scale, trainer.model().light(), Samples::Four);
        let rendering = renderer.render(&scene.train[1].view, Vec3::ZERO).unwrap();
        (avatar, report, rendering)
    };
    let [one, three] = [1, 3].map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(make));
    assert!(one.0 == three.0 && one.2.image == three.2.image);
    let (avatar, report, rendering) = one;
    avatar.validate().unwrap();
    assert!(report.errors[1] < report.errors[0], "{report:?}");
    // What is drawn is where the field is.
    let field = FieldRenderer::new(trainer.model()).unwrap().render(&scene.train[1].view, Vec3::ZERO).unwrap();
    let pairs = || rendering.opacity.iter().zip(&field.opacity).map(|(baked, field)| (*baked > 0.5, *field > 0.5));
    let (both, either) = (pairs().filter(|(b, f)| *b && *f).count(), pairs().filter(|(b, f)| *b || *f).count());
    assert!(both * 10 > either * 6 && either > 50, "{both} of {either}");
    // Skinned as the avatar's own types say.
    let clip = &avatar.clips[0].motion;
    let pose = &clip.poses[..avatar.num_joints()];
    let bones = avatar.bones(pose, clip.trans[0]);
    let mut renderer = BakedRenderer::new(&avatar, 1.0, Light::default(), Samples::Four);
    for (found, expected) in renderer.skin(&bones).0.iter().zip(avatar.skin(&bones, pose).0) {
        assert!(found.distance(expected) < 1e-4);
    }
    assert!(renderer.draw(&bones[1..], &scene.train[0].view.camera).unwrap_err().to_string().contains("joints"));
}

#[test]
fn an_avatar_moves_as_the_prior_that_it_came_from() {
    let mut config = Config::preset(Preset::Fast, Method::Surface);
    config.registration.rounds = 0;
    let scene = scene(&config);
    let (body, faces) = (&scene.body, &scene.body.model.faces);
    // For pixels so wide that nothing is subdivided.
    let relief = Relief::new(&body.canonical.vertices, faces, 1.0);
    let flat = vec![0.0; body.canonical.vertices.len()];
    let paint = |texels: &[Texel]| vec![Vec3::ZERO; texels.len()];
    let (mut avatar, _) = assemble(body, &relief, &flat, &flat, 0.012, paint).unwrap();
    let frames: Vec<_> = scene.train.iter().map(|frame| Arc::clone(&frame.view)).collect();
    add_motion(&mut avatar, body, &frames, Light::default());
    avatar.validate().unwrap();
    let world = turn_upright(upright(body, frames.iter().map(Arc::as_ref))) * (1.0 / body.scale);
    let motion = &avatar.clips[0].motion;
    for (t, view) in frames.iter().enumerate() {
        let pose = &motion.poses[t * motion.num_joints..][..motion.num_joints];
        let (moved, _) = avatar.skin(&avatar.bones(pose, motion.trans[t]), pose);
        for (of_avatar, of_prior) in avatar.faces.as_flattened().iter().zip(faces.as_flattened()) {
            let (here, there) = (moved[*of_avatar as usize], view.posed.vertices[*of_prior as usize]);
            // The betas of the demo's frames are the mean ones; four weights a vertex of at most
            // four.
            assert!(here.distance(world * there) < 2e-4, "frame {t}: {here}");
            // The camera sees it where the capture's camera saw it.
            let [here, there] = [avatar.cameras[t].project(here).unwrap(), view.camera.project(there).unwrap()];
            assert!((here - there).truncate().length() < 0.05, "{here} {there}");
            assert!((here.z * body.scale - there.z).abs() < 1e-3);
        }
    }
    let still = vec![Vec3::ZERO; avatar.num_joints()];
    let (rest, _) = avatar.skin(&avatar.bones(&still, Vec3::ZERO), &still);
    assert!(rest.iter().zip(&avatar.vertices).all(|(a, b)| a.distance(*b) < 1e-5));
}

/// Intersection over union of a drawn person and the mask, in the mean over frames.
fn overlap(scene: &Scene, avatar: &Avatar) -> f32 {
    let light = scene.colors().unwrap().light;
    let mut renderer = BakedRenderer::new(avatar, scene.body.scale, light, Samples::Four);
    let one = |frame: &PreparedFrame| {
        let rendering = renderer.render(&frame.view, Vec3::ZERO).unwrap();
        let mask = frame.pixels().unwrap().mask;
        let both: f32 = rendering.opacity.iter().zip(&mask).map(|(a, b)| a.min(*b)).sum();
        let either: f32 = rendering.opacity.iter().zip(&mask).map(|(a, b)| a.max(*b)).sum();
        both / either
    };
    let all: Vec<f32> = scene.eval.iter().map(one).collect();
    all.iter().sum::<f32>() / all.len() as f32
}

#[test]
fn a_fitted_surface_covers_unseen_views_better_than_the_prior_alike_on_any_number_of_threads() {
    let body = smpl::BodyModel::embedded();
    let config = DemoConfig { size: 128, frames: 24, eval_cameras: 2, eval_every: 8, ..DemoConfig::default() };
    let mut capture = demo(&config, &body).unwrap();
    let scene = |capture: &Capture| Scene::new(capture, &body, &Config::preset(Preset::Fast, Method::Surface)).unwrap();
    let given = scene(&capture);
    let make = || fit(&given).unwrap();
    let [one, three] = [1, 3].map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(make));
    assert!(one.0 == three.0);
    let (avatar, report) = one;
    avatar.validate().unwrap();
    assert!(report.errors[1] < report.errors[0], "{report:?}");
    let (prior, _) = known(&given, |_, d| if d < 0.0 { 5000.0 } else { 0.0 });
    let mut fewer = avatar.clone();
    fewer.simplify(avatar.faces.len() / 3).unwrap();
    let [fitted, bare, fewer] = [&avatar, &prior, &fewer].map(|avatar| overlap(&given, avatar));
    assert!(1.0 - fitted < 0.8 * (1.0 - bare), "{fitted} for {bare}");
    assert!(fewer > fitted - 0.005, "{fewer} for {fitted} with a third of the triangles");
    // Empty masks change nothing and are no error.
    for frame in &mut capture.train {
        let mut pixels = frame.pixels().unwrap();
        pixels.mask.iter_mut().skip(3).for_each(|m| *m = 0.0);
        pixels.mask[..3].fill(1.0);
        frame.source = pixels.into();
    }
    fit(&scene(&capture)).unwrap().0.validate().unwrap();
}

#[test]
fn a_skirt_is_added_where_masks_show_one_and_follows_the_joints_of_other_shapes() {
    let (body, config) = (smpl::BodyModel::embedded(), Config::preset(Preset::Fast, Method::Surface));
    let capture = |outfit| {
        let demo_config = DemoConfig { size: 96, frames: 40, eval_cameras: 1, outfit, ..DemoConfig::default() };
        demo(&demo_config, &body).unwrap()
    };
    let plain = Scene::new(&capture(Outfit::Plain), &body, &config).unwrap();
    let found = skirted(&plain).unwrap();
    assert!(found.is_none(), "{:?}", found.map(|model| model.v_template[body.num_vertices()..].to_vec()));
    let capture = capture(Outfit::Skirt);
    let scene = Scene::new(&capture, &body, &config).unwrap();
    let model = skirted(&scene).unwrap().unwrap();
    model.validate("skirt").unwrap();
    let mesh = testkit::TriMesh { vertices: model.v_template.clone(), faces: model.faces.clone() };
    assert!(mesh.is_closed());
    let wider = Scene::new(&capture, &model, &config).unwrap();
    let [before, after] = [&scene, &wider].map(|scene| scene.covered().unwrap());
    assert!(after > 0.95 && before < 0.9, "{before} {after}");
    let offsets = |betas: &[f32]| -> Vec<Vec3> {
        let shaped = model.shaped(betas);
        let centre = |v: usize| model.weights.row(v).map(|(joint, w)| w * shaped.joints[joint]).sum::<Vec3>();
        (body.num_vertices()..model.num_vertices()).map(|v| shaped.vertices[v] - centre(v)).collect()
    };
    for (a, b) in offsets(&[]).into_iter().zip(offsets(&[2.0, -1.0, 0.5])) {
        assert!(a.distance(b) < 1e-4, "{a} {b}");
    }
}
