use rigged::Character;
use smpl::MotionClip;

use super::*;
use crate::{DemoConfig, Obstacle, demo};
use testkit::files::{glb, shared};

fn small() -> SynthConfig {
    SynthConfig { size: 64, frames: 6, eval_cameras: 1, eval_every: 3, ..SynthConfig::default() }
}

fn make(config: &SynthConfig) -> Synthetic {
    synthesise(None, None, config, &|_| {}).unwrap()
}

fn character(name: &str) -> Option<Character> {
    shared("character").map(|dir| Character::load(&dir.join(name)).unwrap())
}

fn clip(name: &str) -> Option<MotionClip> {
    shared("mocap").map(|dir| MotionClip::load(&dir.join(name)).unwrap())
}

#[test]
fn the_default_is_the_demo() {
    let demo_config = DemoConfig { size: 64, frames: 6, eval_cameras: 1, eval_every: 3, ..DemoConfig::default() };
    let made = make(&small());
    let expected = demo(&demo_config, &made.body).unwrap();
    assert_eq!(format!("{expected:?}"), format!("{:?}", made.capture));
}

#[test]
fn the_fraction_hidden_is_the_one_asked_for() {
    for fraction in [0.2, 0.5, 0.7] {
        let obstacle = Obstacle { fraction, ..Obstacle::default() };
        let objects = Occlusion::Objects { fraction, position: 0.0 };
        for occlusion in [Occlusion::Rectangle(obstacle), objects] {
            let made = make(&SynthConfig { occlusion, ..small() });
            // A column of 64 is some 5 % of a person.
            assert!((made.hidden_fraction - fraction).abs() < 0.05, "{occlusion:?}: {}", made.hidden_fraction);
        }
    }
    let share = |frames: &[Frame], clear: &[PixelSource]| {
        frames
            .iter()
            .zip(clear)
            .filter(|(frame, clear)| frame.pixels().unwrap().mask != clear.pixels().unwrap().mask)
            .count()
    };
    let half = Obstacle { share: 0.5, ..Obstacle::default() };
    let made = make(&SynthConfig { occlusion: Occlusion::Rectangle(half), ..small() });
    assert_eq!(share(&made.capture.train, &made.clear), 3);
}

#[test]
fn objects_move_where_they_are_told_and_cover_what_they_hide() {
    let made = |position| make(&SynthConfig { occlusion: Occlusion::Objects { fraction: 0.3, position }, ..small() });
    let mean = |s: &Synthetic| {
        let cover = s.objects.as_ref().unwrap().coverage();
        let (sum, all) = cover.iter().enumerate().fold((0.0, 0.0), |(s, a), (i, c)| (s + c * (i % 64) as f32, a + c));
        sum / all
    };
    let (left, right) = (made(-0.1), made(0.1));
    assert!(mean(&right) > mean(&left) + 3.0, "{} {}", mean(&left), mean(&right));
    for (frame, clear) in right.capture.train.iter().zip(&right.clear) {
        let clear = clear.pixels().unwrap();
        let (image, mask) = (&clear.image, &clear.mask);
        let (pixels, cover) = (frame.pixels().unwrap(), right.objects.as_ref().unwrap().coverage());
        for (i, &c) in cover.iter().enumerate() {
            assert_eq!(pixels.mask[i], mask[i] * (1.0 - c));
            assert_eq!(pixels.image.pixels[3 * i], image.pixels[3 * i] * (1.0 - c));
            assert_eq!(pixels.occluder.as_ref().unwrap()[i], c > 0.5);
        }
    }
    let none = make(&SynthConfig { occlusion: Occlusion::Objects { fraction: 0.0, position: 0.0 }, ..small() });
    assert_eq!(none.hidden_fraction, 0.0);
    assert!(none.objects.unwrap().coverage().iter().all(|c| *c == 0.0));
}

#[test]
fn settings_that_cannot_be_are_named() {
    let behind = |obstacle| SynthConfig { occlusion: Occlusion::Rectangle(obstacle), ..small() };
    for (word, config) in [
        ("lamp", SynthConfig { lamp: f32::NAN, ..small() }),
        ("shape_noise", SynthConfig { shape_noise: f32::NAN, ..small() }),
        ("turns", SynthConfig { turns: f32::INFINITY, ..small() }),
        (
            "occlusion.fraction",
            SynthConfig { occlusion: Occlusion::Objects { fraction: 1.0, position: 0.0 }, ..small() },
        ),
        (
            "occlusion.position",
            SynthConfig { occlusion: Occlusion::Objects { fraction: 0.5, position: 2.0 }, ..small() },
        ),
        ("32 GiB", SynthConfig { size: 2048, frames: 10_000, ..small() }),
        ("occlusion.share", behind(Obstacle { share: 2.0, ..Obstacle::default() })),
        ("occlusion.travel", behind(Obstacle { travel: f32::INFINITY, ..Obstacle::default() })),
        ("occlusion.height", behind(Obstacle { height: 0.0, ..Obstacle::default() })),
    ] {
        let message = synthesise(None, None, &config, &|_| {}).err().expect(word).to_string();
        assert!(message.contains(word) && message.contains("expected"), "{message}");
    }
}

#[test]
fn a_character_without_errors_is_its_own_prior() {
    let exact = SynthConfig { pose_noise_degrees: 0.0, shape_noise: 0.0, ..small() };
    for name in ["makehuman_walk.glb", "CesiumMan.glb"] {
        let Some(character) = character(name) else { return };
        let made = synthesise(Some(&character), None, &exact, &|_| {}).unwrap();
        assert_eq!(made.body.num_joints(), character.num_joints(), "{name}");
        assert_eq!(made.capture.mean_betas, [0.0]);
        let views = made.capture.eval.iter().map(|e| &e.frame);
        for frame in views {
            let overlap = overlap(frame, &made.body);
            // The translation noise of 5 mm, and edges of pixels of 4 cm.
            assert!(overlap > 0.85, "{name} {}: {overlap}", frame.name);
        }
    }
}

#[test]
fn motion_capture_drives_the_person_and_characters_with_known_names() {
    let (Some(clip), Some(makehuman), Some(cesium)) =
        (clip("walk.npz"), character("makehuman_walk.glb"), character("CesiumMan.glb"))
    else {
        return;
    };
    let exact = SynthConfig { pose_noise_degrees: 0.0, shape_noise: 0.0, ..small() };
    for actor in [None, Some(&makehuman)] {
        let made = synthesise(actor, Some(&clip), &exact, &|_| {}).unwrap();
        for view in &made.capture.eval {
            let overlap = overlap(&view.frame, &made.body);
            // Clothes are wider than the body.
            assert!(overlap > if actor.is_some() { 0.85 } else { 0.6 }, "{overlap}");
        }
        let poses: Vec<_> = made.capture.train.iter().map(|f| &f.pose).collect();
        assert_ne!(poses[0], poses[3]);
    }
    // The character's own animation is the same take: its limbs must go where the clip takes them.
    let (own, driven) = (
        synthesise(Some(&makehuman), None, &exact, &|_| {}).unwrap(),
        synthesise(Some(&makehuman), Some(&clip), &exact, &|_| {}).unwrap(),
    );
    for (a, b) in own.capture.train.iter().zip(&driven.capture.train) {
        let joints = |f: &Frame| own.body.pose(&own.body.shaped(&[0.0]), &f.pose, f.placement).joints;
        let (p, q) = (joints(a), joints(b));
        let mean = p.iter().zip(&q).map(|(p, q)| p.distance(*q)).sum::<f32>() / p.len() as f32;
        assert!(mean < 0.06, "{}: {mean}", a.name);
    }
    let message = synthesise(Some(&cesium), Some(&clip), &exact, &|_| {}).err().unwrap().to_string();
    assert!(message.contains("motion") && message.contains("hips"), "{message}");
}

/// Two triangles over four positions on one joint, as a .glb.
fn plate(matrix: &str, positions: &[[f32; 3]]) -> Character {
    let mut bytes: Vec<u8> = positions.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    let (faces, count) = (bytes.len(), positions.len());
    bytes.extend([0u16, 1, 2, 0, 2, 3].iter().flat_map(|v| v.to_le_bytes()));
    let all = bytes.len();
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
        "nodes":[{{"mesh":0,"matrix":{matrix}}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
        "buffers":[{{"byteLength":{all}}}],
        "bufferViews":[{{"buffer":0,"byteLength":{faces}}},{{"buffer":0,"byteOffset":{faces},"byteLength":12}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":{count},"type":"VEC3","min":[0,0,0],"max":[0,0,0]}},
        {{"bufferView":1,"componentType":5123,"count":6,"type":"SCALAR"}}]}}"#
    );
    Character::from_bytes("plate.glb", &glb(json, &bytes)).unwrap()
}

const UNIT: &str = "[1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]";

#[test]
fn characters_that_are_no_bodies_are_refused() {
    let square = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
    for (word, character) in [
        ("flat", plate(UNIT, &square)),
        ("height", plate(UNIT, &[[0.0; 3], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])),
        ("height", plate(UNIT, &[[1.0; 3]; 4])),
        ("inverted", plate("[0,0,0,0, 0,0,0,0, 0,0,0,0, 0,0,0,1]", &square)),
        ("character", plate("[1e30,0,0,0, 0,1e30,0,0, 0,0,1e30,0, 0,0,0,1]", &square)),
    ] {
        let message = synthesise(Some(&character), None, &small(), &|_| {}).err().expect(word).to_string();
        assert!(message.contains(word) && message.contains("expected"), "{word}: {message}");
    }
}

#[test]
fn a_body_of_one_rigid_part_without_a_texture_is_filmed() {
    let tetrahedron = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.7, 0.0], [0.0, 0.0, 1.0]];
    let made = synthesise(Some(&plate(UNIT, &tetrahedron)), None, &small(), &|_| {}).unwrap();
    assert_eq!((made.body.num_joints(), made.body.num_vertices()), (1, 4));
    assert!(made.clear.iter().all(|clear| clear.pixels().unwrap().mask.iter().any(|m| *m > 0.5)));
}

#[test]
fn what_lies_behind_a_hole_is_seen_through_it() {
    // A plate, green to the right and a hole to the left, before a red one of half its size.
    let texture = image::RgbaImage::from_fn(64, 4, |x, _| image::Rgba([0, 255, 0, if x < 32 { 0 } else { 255 }]));
    let mut png = std::io::Cursor::new(Vec::new());
    texture.write_to(&mut png, image::ImageFormat::Png).unwrap();
    let plate = |half: f32, z: f32| [-half, -half, z, half, -half, z, half, half, z, -half, half, z];
    let uvs = [0.0f32, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0];
    let floats = [&plate(0.5, 0.0)[..], &plate(0.25, -0.05), &uvs].concat();
    let mut bytes: Vec<u8> = floats.iter().flat_map(|v| v.to_le_bytes()).collect();
    bytes.extend([0u16, 1, 2, 0, 2, 3].iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend(png.get_ref());
    let (all, image) = (bytes.len(), png.get_ref().len());
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":2}},"indices":3,"material":0}},
        {{"attributes":{{"POSITION":1}},"indices":3,"material":1}}]}}],
        "materials":[{{"alphaMode":"MASK","pbrMetallicRoughness":{{"baseColorTexture":{{"index":0}}}}}},
        {{"pbrMetallicRoughness":{{"baseColorFactor":[1,0,0,1]}}}}],
        "textures":[{{"source":0}}],"images":[{{"bufferView":2,"mimeType":"image/png"}}],
        "buffers":[{{"byteLength":{all}}}],"bufferViews":[{{"buffer":0,"byteLength":128}},
        {{"buffer":0,"byteOffset":128,"byteLength":12}},{{"buffer":0,"byteOffset":140,"byteLength":{image}}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3"}},
        {{"bufferView":0,"byteOffset":48,"componentType":5126,"count":4,"type":"VEC3"}},
        {{"bufferView":0,"byteOffset":96,"componentType":5126,"count":4,"type":"VEC2"}},
        {{"bufferView":1,"componentType":5123,"count":6,"type":"SCALAR"}}]}}"#
    );
    let character = Character::from_bytes("hole.glb", &glb(json, &bytes)).unwrap();
    let config = SynthConfig { turns: 0.0, ..small() };
    let made = synthesise(Some(&character), None, &config, &|_| {}).unwrap();
    let pixels = made.clear[0].pixels().unwrap();
    let mut counts = [0; 3];
    for (i, mask) in pixels.mask.iter().enumerate().filter(|(_, mask)| **mask > 0.99) {
        let left = 2 * (i as u32 % pixels.image.width) < pixels.image.width;
        let [red, green] = [0, 1].map(|channel| pixels.image.pixels[3 * i + channel]);
        counts[if green > red { usize::from(left) } else { 2 }] += 1;
        assert!(*mask < 0.99 || red.max(green) > 0.2);
    }
    let [right, wrong, behind] = counts;
    assert!(wrong == 0 && right > 200 && (6..10).contains(&(behind * 32 / right)), "{counts:?}");
}

/// Intersection over union of the posed body's silhouette and the mask, over the pixels that no
/// known occluder covers.
fn overlap(frame: &Frame, body: &BodyModel) -> f32 {
    let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
    let mesh = visibility::RayMesh::new(&posed.vertices, &body.faces).unwrap();
    let (pixels, width) = (frame.pixels().unwrap(), frame.camera.width as usize);
    testkit::oracle::mask_iou(&pixels.mask, pixels.occluder.as_deref(), width, |x, y| {
        let ray = frame.camera.ray(x, y);
        mesh.first_hit(ray.origin, ray.direction).is_some()
    })
}
