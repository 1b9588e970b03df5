//! Avatars: what a valid one is, how it moves, and the file it is kept in.

use crate::stand_in;

use std::path::PathBuf;

use crate::skinned;
use glam::{Vec2, Vec3};
use occnerf::bake::{Avatar, Clip, turn_upright};
use occnerf::{Config, Method, Preset, PriorColors, Scene};
use stand_in::stand_in;
use synth::{DemoConfig, demo};

fn scene() -> Scene {
    let body = smpl::BodyModel::embedded();
    let capture = demo(&DemoConfig { size: 32, frames: 4, eval_cameras: 1, ..Default::default() }, &body).unwrap();
    let mut config = Config::preset(Preset::Fast, Method::Occnerf);
    config.registration.rounds = 0;
    Scene::new(&capture, &body, &config).unwrap()
}

fn avatar(scene: &Scene) -> Avatar {
    stand_in(scene, &PriorColors::measure(scene).unwrap())
}

fn place(name: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("avatar");
    std::fs::create_dir_all(&directory).unwrap();
    directory.join(name)
}

#[test]
fn an_avatar_moves_as_the_prior_that_it_came_from() {
    let scene = scene();
    let avatar = avatar(&scene);
    avatar.validate().unwrap();
    let body = &scene.body;
    let up = occnerf::upright(body, scene.train.iter().map(|frame| &*frame.view));
    let world = turn_upright(up) * (1.0 / body.scale);
    let motion = &avatar.clips[0].motion;
    for (t, frame) in scene.train.iter().enumerate() {
        let pose = &motion.poses[t * motion.num_joints..][..motion.num_joints];
        let bones = avatar.bones(pose, motion.trans[t]);
        let (moved, _) = avatar.skin(&bones, pose);
        let expected = body.model.faces.iter().flatten().map(|&v| world * frame.view.posed.vertices[v as usize]);
        let worst = moved.iter().zip(expected).map(|(a, b)| a.distance(b)).fold(0.0, f32::max);
        // The betas of the demo's frames are the mean ones; four weights a vertex of at most four.
        assert!(worst < 2e-4, "frame {t}: {worst} m");
        // The camera sees a vertex where the capture's camera saw it.
        let (here, there) =
            (avatar.cameras[t].project(moved[0]), frame.view.posed.vertices[body.model.faces[0][0] as usize]);
        let (here, there) = (here.unwrap(), frame.view.camera.project(there).unwrap());
        assert!((here - there).truncate().length() < 0.05, "{here} {there}");
        assert!((here.z * body.scale - there.z).abs() < 1e-3);
        // At a frame's own second the clip is that frame.
        let seconds = t as f32 / motion.fps;
        let again = skinned(&avatar, seconds).0;
        let same = moved.iter().zip(&again).all(|(a, b)| a.distance(*b) < 1e-3);
        assert!(same, "frame {t}");
    }
    let still = vec![Vec3::ZERO; avatar.num_joints()];
    let (rest, _) = avatar.skin(&avatar.bones(&still, Vec3::ZERO), &still);
    assert!(rest.iter().zip(&avatar.vertices).all(|(a, b)| a.distance(*b) < 1e-5));
}

#[test]
fn a_file_holds_every_bit_and_equal_avatars_are_equal_files() {
    let mut avatar = avatar(&scene());
    avatar.light.slope = Vec3::new(0.1, 0.2, -0.3);
    let (a, b) = (place("a.safetensors"), place("b.safetensors"));
    avatar.save(&a).unwrap();
    let back = Avatar::load(&a).unwrap();
    assert_eq!(avatar, back);
    back.save(&b).unwrap();
    assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
}

#[test]
fn a_fault_of_any_part_is_named_and_never_written() {
    let good = avatar(&scene());
    let clip = good.clips[0].clone();
    type Change<'a> = &'a dyn Fn(&mut Avatar);
    let changes: [(&str, Change<'_>); 19] = [
        ("vertices", &|a| a.vertices[7].y = f32::NAN),
        ("normals", &|a| a.normals.truncate(1)),
        ("normals", &|a| a.normals[0] = Vec3::splat(3.0)),
        ("uvs", &|a| a.uvs[3] = Vec2::new(0.5, 1.5)),
        ("faces", &|a| a.faces[0][2] = 1 << 30),
        ("faces", &|a| a.faces.clear()),
        ("joints", &|a| a.joints[0][3] = 24),
        ("weights", &|a| a.weights[0][0] += 0.5),
        ("weights", &|a| a.weights[0][0] = f32::NAN),
        ("posedirs", &|a| a.posedirs.values[0].x = f32::INFINITY),
        ("posedirs", &|a| a.posedirs.offsets[1] = u32::MAX),
        ("rgb", &|a| a.atlas.rgb.truncate(3)),
        ("atlas", &|a| a.atlas.width = 0),
        ("light", &|a| a.light.slope.x = f32::NAN),
        ("skeleton", &|a| a.skeleton[3].parent = Some(3)),
        ("skeleton", &|a| a.skeleton[3].name = a.skeleton[2].name.clone()),
        ("clips", &|a| a.clips.push(clip.clone())),
        ("clip \"other\"", &|a| {
            let mut motion = clip.motion.clone();
            motion.num_joints = 23;
            a.clips.push(Clip { name: "other".to_owned(), motion });
        }),
        ("cameras", &|a| a.cameras.truncate(1)),
    ];
    let path = place("faulty.safetensors");
    for (part, change) in changes {
        let mut avatar = good.clone();
        change(&mut avatar);
        let error = avatar.save(&path).unwrap_err().to_string();
        assert!(error.contains(part) && error.contains("faulty") && error.lines().count() == 1, "{part}: {error}");
        assert!(!path.exists());
    }
}

#[test]
fn damaged_files_are_errors_of_one_line() {
    let path = place("whole.safetensors");
    avatar(&scene()).save(&path).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let broken = place("broken.safetensors");
    for cut in [0, 1, 7, 8, 100, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&broken, &whole[..cut]).unwrap();
        assert!(Avatar::load(&broken).is_err(), "{cut} bytes");
    }
    let absent = Avatar::load(&place("absent.safetensors")).unwrap_err().to_string();
    assert!(absent.contains("absent.safetensors"), "{absent}");
    std::fs::write(&broken, std::fs::read(env!("CARGO_MANIFEST_PATH")).unwrap()).unwrap();
    let other = Avatar::load(&broken).unwrap_err().to_string();
    assert!(other.contains("not a whole safetensors file"), "{other}");
}
