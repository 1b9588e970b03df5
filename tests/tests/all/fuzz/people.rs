//! Small files of what is known of people: estimators' fits, tensors, and what a run keeps.

use std::path::Path;

use glam::{Affine3A, Mat3, Vec2, Vec3};
use occnerf::bake::{Atlas, Avatar, Clip, Joint};
use occnerf::capture::{Light, LoadOptions, load_capture};
use occnerf::{Config, Method, Person, Preset, PriorColors};
use smpl::{MotionClip, SparseRows};
use synth::Py;
use volrender::Camera;

use super::{place, seeds};

fn array(shape: &[u32], values: &[f64]) -> Py {
    Py::Array(shape.to_vec(), values.to_vec())
}

/// Folder of two frames of 8 × 8 pixels, which fits belong to.
pub fn video() -> std::path::PathBuf {
    let dir = place("video");
    std::fs::create_dir_all(&dir).unwrap();
    for name in ["1.png", "2.png"] {
        image::RgbImage::from_pixel(8, 8, image::Rgb([9; 3])).save(dir.join(name)).unwrap();
    }
    dir
}

/// PHALP's tracks, whose masks are COCO's run lengths: compressed, and as numbers.
pub fn phalp() -> Vec<Vec<u8>> {
    let turn = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let smpl = Py::record([
        ("global_orient", array(&[1, 3, 3], &turn)),
        ("body_pose", array(&[23, 3, 3], &turn.repeat(23))),
        ("betas", array(&[10], &[0.1; 10])),
    ]);
    let number = |n: u8| Py::Raw(vec![b'K', n]);
    let list = |items: &[Py]| Py::List(items.to_vec());
    let frame = |counts: Py| {
        let mask = Py::record([("size", list(&[number(8), number(8)])), ("counts", counts)]);
        Py::record([
            ("tid", list(&[number(1)])),
            ("tracked_time", list(&[number(0)])),
            ("size", list(&[list(&[number(8), number(8)])])),
            ("smpl", list(std::slice::from_ref(&smpl))),
            ("camera", list(&[array(&[3], &[0.1, 0.2, 9.0])])),
            ("mask", list(&[list(&[mask])])),
        ])
    };
    // 20 + 30 + 14 pixels: six bits a character, five of them the number's.
    let compressed = Py::Raw(b"B\x05\0\0\0d0n0>".to_vec());
    let plain = list(&[number(20), number(30), number(14)]);
    [compressed, plain]
        .map(|counts| Py::record([("1.png", frame(counts.clone())), ("2.png", frame(counts))]).pickle())
        .into()
}

/// SAM 3D Body's people of two frames as JSON and as a pickle: one with a focal length and a mask, one
/// with pixels.
pub fn sam3d() -> Vec<Vec<u8>> {
    let points: Vec<[f64; 3]> = (0..70).map(|i| [f64::from(i % 7) * 0.125, f64::from(i / 7) * 0.125, 0.5]).collect();
    let pixels: Vec<[f64; 2]> = points.iter().map(|p| [p[0] * 2.0 + 4.0, p[1] * 2.0 + 4.0]).collect();
    let (place, mask) = ([0.0, 0.0, 4.0], [[1.0; 8]; 8]);
    let json = serde_json::json!([
        [{ "pred_keypoints_3d": points, "pred_cam_t": place, "focal_length": 9.0, "mask": mask.map(Vec::from) }],
        [{ "pred_keypoints_3d": points, "pred_cam_t": place, "pred_keypoints_2d": pixels }],
    ]);
    let person = |[one, two]: [(&str, Py); 2]| {
        let points = ("pred_keypoints_3d", array(&[70, 3], points.as_flattened()));
        Py::List(vec![Py::record([points, ("pred_cam_t", array(&[3], &place)), one, two])])
    };
    let first = person([("focal_length", array(&[], &[9.0])), ("mask", array(&[8, 8], mask.as_flattened()))]);
    let second = person([
        ("focal_length", Py::Raw(b"N".to_vec())),
        ("pred_keypoints_2d", array(&[70, 2], pixels.as_flattened())),
    ]);
    vec![json.to_string().into_bytes(), Py::List(vec![first, second]).pickle()]
}

/// EasyMocap's file of a frame, and one of cameras that serves as both of them.
pub fn easymocap() -> [Vec<u8>; 2] {
    let row = |count: usize| vec![vec![0.125; count]];
    let person = serde_json::json!([{ "id": 0, "Rh": row(3), "Th": row(3), "poses": row(72), "shapes": row(10) }]);
    let matrix = |name: &str, rows: usize, data: &str| {
        format!("{name}: !!opencv-matrix\n  rows: {rows}\n  cols: {rows}\n  dt: d\n  data: [ {data} ]\n")
    };
    let cameras =
        ["%YAML:1.0\n---\nnames:\n  - \"1\"\n".to_owned(), matrix("K_1", 3, "9., 0., 4., 0., 9.,\n   4., 0, 0, 1")]
            .concat()
            + "H_1: 8\nW_1: 8\n"
            + &matrix("dist_1", 1, "0, 0, 0, 0, 0")
            + &matrix("R_1", 3, "0.1, 0.2, 0.3")
            + &matrix("T_1", 3, "0, 0, 5e0");
    [person.to_string().into_bytes(), cameras.into_bytes()]
}

/// What a run keeps of a person of four vertices: its settings, and `person.safetensors` beside
/// `body.safetensors` in the folder `run`.
pub fn person(run: &Path) -> (Config, Vec<u8>) {
    let (dir, body, _) = seeds::wild_capture(&place("person-wild"));
    let capture = load_capture(&dir, &body, &LoadOptions::default()).unwrap();
    let colors = PriorColors::of_vertices(vec![Vec3::splat(0.5); 4], &body.faces);
    std::fs::create_dir_all(run).unwrap();
    Person::save(run, &capture.into(), &body, &colors).unwrap();
    (Config::preset(Preset::Fast, Method::HashPoint), std::fs::read(run.join("person.safetensors")).unwrap())
}

/// A baked person of four vertices, two joints and two frames.
pub fn avatars() -> Vec<Vec<u8>> {
    let intrinsics = Mat3::from_cols(Vec3::X * 9.0, Vec3::Y * 9.0, Vec3::new(4.0, 4.0, 1.0));
    let camera = Camera::new(intrinsics, Affine3A::from_translation(Vec3::Z * 5.0), 8, 8).unwrap();
    let joint = |name: &str, parent, rest| Joint { name: name.to_owned(), parent, rest };
    let motion = MotionClip { num_joints: 2, fps: 30.0, poses: vec![Vec3::splat(0.1); 4], trans: vec![Vec3::Y; 2] };
    let avatar = Avatar {
        name: "tiny".to_owned(),
        source: String::new(),
        vertices: (0..4).map(|i| Vec3::new((i & 1) as f32, (i >> 1) as f32, 0.0)).collect(),
        normals: vec![Vec3::Z; 4],
        uvs: (0..4).map(|i| Vec2::new((i & 1) as f32, (i >> 1) as f32)).collect(),
        faces: vec![[0, 1, 2], [1, 3, 2]],
        joints: vec![[0, 1, 0, 0]; 4],
        weights: vec![[0.5, 0.5, 0.0, 0.0]; 4],
        posedirs: SparseRows::from_rows((0..4).map(|i| vec![(i as u32, Vec3::splat(0.02))])),
        atlas: Atlas { width: 2, height: 2, rgb: vec![200; 12], confidence: vec![255; 4] },
        skeleton: vec![joint("root", None, Vec3::ZERO), joint("knee", Some(0), Vec3::Y)],
        betas: vec![0.5],
        clips: vec![Clip { name: "video".to_owned(), motion }],
        cameras: vec![camera; 2],
        light: Light { slope: 0.2 * Vec3::Z },
    };
    let path = place("seed-avatar.safetensors");
    avatar.save(&path).unwrap();
    vec![std::fs::read(path).unwrap()]
}
