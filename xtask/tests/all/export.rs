//! `export` and `view` of a run, and one clear line for whatever is wrong.

use crate::common;
use std::path::{Path, PathBuf};

use array_files::{Data, NdArray, npz};
use common::{done, folder, refused, text};
use glam::Vec3;
use occnerf::bake::fit;
use occnerf::{Config, Method, Preset, Scene};
use synth::{DemoConfig, demo};

const HOSTILE: &str = "</script><img src=x onerror=alert(1)>\" onload='";

/// A run that has been baked, under a name that wants to be more than text.
fn run(name: &str) -> PathBuf {
    let directory = folder(name);
    let body = smpl::BodyModel::embedded();
    let capture = demo(&DemoConfig { size: 24, frames: 3, eval_cameras: 1, ..Default::default() }, &body).unwrap();
    let scene = Scene::new(&capture, &body, &Config::preset(Preset::Fast, Method::Occnerf)).unwrap();
    let (mut avatar, _) = fit(&scene).unwrap();
    avatar.name = HOSTILE.to_owned();
    avatar.clips[0].name = HOSTILE.to_owned();
    avatar.save(&directory.join("avatar.safetensors")).unwrap();
    directory
}

/// Motion capture of this many joints.
pub fn clip(path: &Path, joints: usize) {
    let poses = Data::F32(vec![0.1; 4 * 3 * joints]);
    let arrays = [
        ("poses", NdArray { shape: vec![4, 3 * joints], data: poses }),
        ("trans", NdArray { shape: vec![4, 3], data: Data::F32(vec![0.5; 12]) }),
        ("fps", NdArray { shape: vec![], data: Data::F64(vec![25.0]) }),
    ];
    npz::write(path, &arrays).unwrap();
}

#[test]
fn an_avatar_and_a_mesh_take_a_motion_and_are_read_back() {
    let run = run("export-formats");
    let motion = run.join("dance.npz");
    clip(&motion, 52);
    let out = |name: &str| run.join(name);
    let glb = out("person.glb");
    let said = done(&["export", text(&run), "--format", "glb", "--out", text(&glb), "--motion", text(&motion)]);
    assert!(said.contains("person.glb") && said.contains("dance"), "{said}");
    let character = rigged::Character::load(&glb).unwrap();
    let names: Vec<&str> = character.animations.iter().map(|a| a.name.as_str()).collect();
    assert_eq!(names, [HOSTILE, "dance"]);
    assert!((character.animations[1].duration - 3.0 / 25.0).abs() < 1e-6);

    let ply = out("person.ply");
    done(&["export", text(&run), "--format", "ply", "--out", text(&ply), "--frame", "2"]);
    assert!(std::fs::read(&ply).unwrap().starts_with(b"ply\nformat binary_little_endian 1.0\n"));

    let obj = out("person.obj");
    done(&["export", text(&run), "--format", "obj", "--out", text(&obj), "--frame", "1"]);
    assert!(out("person.mtl").exists() && out("person.png").exists());
    let first = rigged::load_mesh(&obj).unwrap();
    done(&["export", text(&run), "--format", "obj", "--out", text(&obj), "--frame", "1", "--motion", text(&motion)]);
    let danced = rigged::load_mesh(&obj).unwrap();
    assert_eq!(first.faces, danced.faces);
    assert!(first.vertices[0].distance(danced.vertices[0]) > 0.01);
}

#[test]
fn what_others_drive_is_named_as_asked_stands_and_comes_back() {
    let run = run("export-driven");
    let export = |name: &str, more: &[&str]| {
        let out = run.join(name);
        let said = done(&[&["export", text(&run), "--out", text(&out)], more].concat());
        (out, said)
    };
    let json = |glb: &Path| {
        let bytes = std::fs::read(glb).unwrap();
        let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
        serde_json::from_slice::<serde_json::Value>(&bytes[20..20 + length]).unwrap()
    };
    let meta = ["--author", "A. Person", "--licence", "https://example.org/by"];
    let small = ["--bones", "vrm", "--texture", "32", "--jpeg", "80"];
    let (vrm, _) = export("person.vrm", &[&meta[..], &small].concat());
    let root = json(&vrm);
    let extension = &root["extensions"]["VRMC_vrm"];
    assert_eq!((&extension["specVersion"], &extension["meta"]["authors"][0]), (&"1.0".into(), &"A. Person".into()));
    assert_eq!(extension["meta"]["licenseUrl"], "https://vrm.dev/licenses/1.0/");
    assert_eq!(extension["meta"]["otherLicenseUrl"], "https://example.org/by");
    let bones = extension["humanoid"]["humanBones"].as_object().unwrap();
    assert_eq!(bones.len(), 22);
    for (name, bone) in bones {
        assert_eq!(root["nodes"][bone["node"].as_u64().unwrap() as usize]["name"], name.as_str());
    }
    assert_eq!(root["images"][0]["mimeType"], "image/jpeg");
    let side = image::load_from_memory(&rigged::Character::load(&vrm).unwrap().textures[0].bytes).unwrap().width();
    assert!((17..=32).contains(&side), "{side}");
    assert_eq!(json(&export("mixamo.glb", &["--bones", "mixamo"]).0)["nodes"][0]["name"], "mixamorig:Hips");

    let (bvh, _) = export("person.bvh", &["--bones", "mixamo"]);
    let (poses, _) = export("poses.npz", &[]);
    let (again, said) = export("again.npz", &["--motion", text(&bvh)]);
    assert!(said.contains("24 joints, lengths taken for centimetres"), "{said}");
    let [own, read] = [&poses, &again].map(|path| smpl::MotionClip::load(path).unwrap());
    assert_eq!((own.num_frames(), own.num_joints), (3, 24));
    assert!(own.poses.iter().any(|pose| *pose != Vec3::ZERO));
    assert!(own.trans.iter().zip(&read.trans).all(|(a, b)| a.distance(*b) < 1e-4));
    assert!(own.poses[..22].iter().zip(&read.poses).all(|(a, b)| a.distance(*b) < 1e-3));
    // A pose that is held for four frames stands where it is.
    let still = run.join("still.npz");
    clip(&still, 24);
    let (floor, said) = export("floor.npz", &["--motion", text(&still), "--ground"]);
    assert!(said.contains("still: standing feet") && said.contains("now 0.0"), "{said}");
    assert!(smpl::MotionClip::load(&floor).unwrap().trans[0].distance(Vec3::splat(0.5)) > 0.1);
    let tail = std::fs::read_to_string(&bvh).unwrap().replace("mixamorig:LeftUpLeg", "Tail");
    std::fs::write(&bvh, tail).unwrap();
    let glb = run.join("tail.glb");
    refused(&["export", text(&run), "--out", text(&glb), "--motion", text(&bvh)], &["person.bvh", "left upper leg"]);
    let materials = |name: &str, more: &[&str]| {
        let root = json(&export(name, more).0);
        (root["extensionsUsed"].clone(), root["materials"][0].clone())
    };
    let (used, material) = materials("lit.glb", &["--lit"]);
    assert!(used.is_null() && material["extensions"].is_null(), "{used} {material}");
    assert_eq!(material["pbrMetallicRoughness"]["metallicFactor"], 0.0);
    assert_eq!(materials("lit.vrm", &["--lit"]).0, serde_json::json!(["VRMC_vrm"]));
    assert_eq!(materials("unlit.glb", &[]).0, serde_json::json!(["KHR_materials_unlit"]));
    let faces = |glb: &Path| rigged::Character::load(glb).unwrap().faces.len();
    // What the seams of the texture allow.
    let least = run.join("least.glb");
    let output = common::xtask(&["export", text(&run), "--out", text(&least), "--triangles", "1"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains(&format!("{} are left", faces(&least))), "{said}");
    export("move.ply", &["--frames"]);
    assert!((0..3).all(|frame| run.join(format!("move-{frame:04}.ply")).exists()) && !run.join("move.ply").exists());
    for option in [
        &["--author", "x"][..],
        &["--jpeg", "80"],
        &["--texture", "64"],
        &["--lit"],
        &["--frames"],
        &["--triangles", "9"],
    ] {
        refused(&[&["export", text(&run), "--out", text(&bvh)], option].concat(), &[option[0]]);
    }
}

#[test]
fn the_page_is_one_file_that_asks_for_nothing_and_shows_names_as_text() {
    let run = run("view-page");
    let motion = run.join("dance.npz");
    clip(&motion, 24);
    let said = done(&["view", text(&run), "--motion", text(&motion), "--motion", text(&motion)]);
    assert!(said.contains("person.html"), "{said}");
    let page = std::fs::read_to_string(run.join("person.html")).unwrap();
    assert!(page.len() < 10_000_000, "{}", page.len());
    assert!(page.contains("default-src 'none'") && !page.contains("unsafe-"));
    // Addresses of other places: none, but for the data that is inlined.
    for word in ["http://", "https://", "src=\"/", "@import", "url(", "fetch(", "XMLHttpRequest"] {
        assert!(!page.contains(word), "{word}");
    }
    assert!(!page.contains("<img") && page.contains("&lt;img"));
    let ends = page.matches("</script>").count();
    assert_eq!((ends, page.matches("<script").count()), (3, 3));
    let again = run.join("again.html");
    done(&["view", text(&run), "--motion", text(&motion), "--motion", text(&motion), "--out", text(&again)]);
    assert_eq!(std::fs::read_to_string(again).unwrap(), page, "the same run gives the same page");
}

#[test]
fn whatever_is_wrong_is_said_in_one_line() {
    let run = run("export-wrong");
    let run_text = text(&run);
    let out = run.join("person.glb");
    let out = text(&out);
    let glb = |run: &str, out: &str, more: &[&str], words: &[&str]| {
        refused(&[&["export", run, "--format", "glb", "--out", out], more].concat(), words);
    };
    glb("/no/such/run", out, &[], &["/no/such/run", "no such run"]);
    let empty = folder("export-empty");
    glb(text(&empty), out, &[], &["is not a run", "export-empty"]);
    refused(&["view", text(&empty)], &["is not a run"]);
    glb(run_text, text(&run.join("person.obj")), &[], &["--out", "person.obj", "another format", "Glb"]);
    refused(
        &["export", run_text, "--out", text(&run.join("person"))],
        &["--out", ".glb, .vrm, .ply, .obj, .npz or .bvh"],
    );
    glb(run_text, run_text, &[], &["--out", "is a folder"]);
    let motion = run.join("other.npz");
    clip(&motion, 31);
    glb(run_text, out, &["--motion", text(&motion)], &["other.npz", "another skeleton", "24", "31"]);
    refused(&["view", run_text, "--motion", text(&motion)], &["other.npz", "another skeleton"]);
    glb(run_text, out, &["--motion", text(&run.join("absent.npz"))], &["absent.npz"]);
    glb(run_text, out, &["--frame", "1"], &["--frame", "ply or obj"]);
    let obj = run.join("a.obj");
    let frame = ["export", run_text, "--format", "obj", "--out", text(&obj), "--frame", "3"];
    refused(&frame, &["--frame 3", "0 to 2"]);
    for size in ["0x0", "100000x100000", "512x0", "many", "1x-1"] {
        refused(&["render", run_text, "tpose", "--size", size], &["--size"]);
    }
    let png = run.join("person.png");
    refused(&["export", run_text, "--format", "obj", "--out", text(&png)], &["person.png", "texture"]);
    // A file that was cut, and one that is something else.
    let whole = std::fs::read(run.join("avatar.safetensors")).unwrap();
    std::fs::write(run.join("avatar.safetensors"), &whole[..whole.len() / 2]).unwrap();
    glb(run_text, out, &[], &["avatar.safetensors", "not a whole"]);
    std::fs::write(run.join("avatar.safetensors"), b"{}").unwrap();
    refused(&["view", run_text], &["avatar.safetensors"]);
}
