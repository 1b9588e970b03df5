//! Avatars: what a valid one is, and the file it is kept in.

use std::path::PathBuf;
use std::sync::OnceLock;

use glam::{Vec2, Vec3};
use occnerf::bake::{Avatar, Clip, fit};
use occnerf::{Config, Method, Preset, Scene};
use synth::{DemoConfig, demo};

fn avatar() -> Avatar {
    static AVATAR: OnceLock<Avatar> = OnceLock::new();
    let fitted = || {
        let body = smpl::BodyModel::embedded();
        let small = DemoConfig { size: 32, frames: 4, eval_cameras: 1, ..DemoConfig::default() };
        let mut config = Config::preset(Preset::Fast, Method::Surface);
        config.registration.rounds = 0;
        fit(&Scene::new(&demo(&small, &body).unwrap(), &body, &config).unwrap()).unwrap().0
    };
    AVATAR.get_or_init(fitted).clone()
}

fn place(name: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("avatar");
    std::fs::create_dir_all(&directory).unwrap();
    directory.join(name)
}

#[test]
fn a_file_holds_every_bit_and_equal_avatars_are_equal_files() {
    let mut avatar = avatar();
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
    let good = avatar();
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
    avatar().save(&path).unwrap();
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
