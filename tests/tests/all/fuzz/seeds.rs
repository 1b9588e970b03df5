//! Small real files of every kind, written by the crates themselves or by hand, and those of other
//! programs that the repository has.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use array_files::{Data, NdArray, npz};
use glam::{Affine3A, Mat3, Vec2, Vec3};
use occnerf::bake::{Atlas, Avatar, Clip, Joint};
use occnerf::capture::{Light, LoadOptions, load_capture};
use occnerf::{Config, Method, MotionKind, Person, Preset, PriorColors, Scene, Trainer};
use smpl::{BodyModel, MotionClip, SparseRows};
use synth::Py;
use testkit::files::{arm, glb, npy_of, torch};
use volrender::Camera;

use super::place;
use crate::common;

/// Files of the reader crate's own tests, written by numpy and Python.
fn fixture(name: &str) -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../smpl/array-files/tests/fixtures").join(name);
    std::fs::read(path).unwrap()
}

pub fn pickles() -> Vec<Vec<u8>> {
    (0..=5).map(|protocol| fixture(&format!("values.protocol{protocol}.pkl"))).collect()
}

/// Of `joblib.dump`: arrays behind their pickle, plain and compressed in every way that it has.
pub fn joblibs() -> Vec<Vec<u8>> {
    let kinds = ["plain", "plain", "plain", "protocol2", "protocol2", "old", "zlib", "gzip", "old_zlib"];
    kinds.iter().map(|kind| fixture(&format!("joblib.{kind}.pkl"))).collect()
}

fn array(shape: &[usize], data: Data) -> NdArray {
    NdArray { shape: shape.to_vec(), data }
}

fn floats(shape: &[usize], value: impl Fn(usize) -> f32) -> NdArray {
    array(shape, Data::F32((0..shape.iter().product()).map(value).collect()))
}

fn written(name: &str, arrays: &[(&str, NdArray)]) -> Vec<u8> {
    let path = place(name);
    npz::write(&path, arrays).unwrap();
    std::fs::read(path).unwrap()
}

pub fn archives() -> Vec<Vec<u8>> {
    let own = [
        ("a", floats(&[2, 3], |i| i as f32)),
        ("b", array(&[], Data::F64(vec![0.5]))),
        ("c", array(&[0, 4], Data::I64(vec![]))),
        ("d", array(&[3], Data::Bool(vec![true, false, true]))),
    ];
    vec![fixture("numpy.npz"), written("own.npz", &own)]
}

pub fn arrays() -> Vec<Vec<u8>> {
    vec![
        npy_of("{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }\n", &[0; 24]),
        npy_of("{'descr': '>i8', 'fortran_order': True, 'shape': (3, 2), }\n", &[1; 48]),
        npy_of("{'descr': '|b1', 'fortran_order': False, 'shape': (), }\n", &[1]),
        npy_of("{'descr': '<f2', 'fortran_order': False, 'shape': (5,), }\n", &[7; 10]),
    ]
}

pub fn body_archives() -> Vec<Vec<u8>> {
    let parts = [
        ("v_template", floats(&[4, 3], |i| (i * i % 7) as f32 * 0.3)),
        ("f", array(&[2, 3], Data::I64(vec![0, 1, 2, 1, 3, 2]))),
        ("weights", floats(&[4, 2], |i| f32::from(u8::from((i % 2 == 1) == (i >= 4))))),
        ("J_regressor", floats(&[2, 4], |_| 0.25)),
        ("kintree_table", array(&[2, 2], Data::I64(vec![-1, 0, 0, 1]))),
        ("shapedirs", floats(&[4, 3, 2], |i| i as f32 * 0.01)),
        ("posedirs", floats(&[4, 3, 9], |i| (i % 5) as f32 * 0.01)),
    ];
    vec![written("seed-body.npz", &parts)]
}

pub fn saved_bodies() -> Vec<Vec<u8>> {
    let path = place("seed-body.safetensors");
    common::tiny_body().save(&path).unwrap();
    vec![std::fs::read(path).unwrap()]
}

pub fn clips() -> Vec<Vec<u8>> {
    let clip = |joints: usize, rate: &'static str| {
        let parts = [
            ("poses", floats(&[3, 3 * joints], |i| (i % 11) as f32 * 0.1)),
            ("trans", floats(&[3, 3], |i| i as f32)),
            (rate, array(&[], Data::F64(vec![30.0]))),
        ];
        written("seed-clip.npz", &parts)
    };
    vec![clip(24, "fps"), clip(52, "mocap_framerate")]
}

/// A small rig with a texture.
pub fn characters() -> Vec<Vec<u8>> {
    let (json, binary) = arm();
    let textured = r#""materials":[{"pbrMetallicRoughness":{"baseColorTexture":{"index":0}}}],"textures":[{"source":0}],
"images":[{"uri":"data:image/png;base64,iVBORw0KGgo="}],"skins""#;
    let json = json.replace(r#""indices":7"#, r#""indices":7,"material":0"#).replace(r#""skins""#, textured);
    vec![glb(json, &binary)]
}

pub fn meshes() -> Vec<Vec<u8>> {
    let text = "# a pyramid\no thing\nv 0 0 0 1 1 1\r\nv 1 0 0\nv 1 0 1\nvt 0 0\nvn 0 1 0\nusemtl x\n\
                f 1/1/1 2//1 3 4\nv 0 0 1 # late\nv 9e0 -1.5 \\\n 2\nf -1 -2 1\n";
    vec![text.as_bytes().to_vec(), b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".to_vec()]
}

fn encoded(picture: &image::DynamicImage, format: image::ImageFormat) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    picture.write_to(&mut out, format).unwrap();
    out.into_inner()
}

pub fn pngs() -> Vec<Vec<u8>> {
    let rgb = image::RgbImage::from_fn(9, 7, |x, y| image::Rgb([x as u8 * 20, y as u8 * 30, 9]));
    let deep =
        image::ImageBuffer::<image::Rgba<u16>, _>::from_fn(5, 4, |x, y| image::Rgba([x as u16, y as u16, 9, 65535]));
    let grey = image::GrayImage::from_fn(16, 3, |x, _| image::Luma([x as u8]));
    [rgb.into(), image::DynamicImage::ImageRgba16(deep), grey.into()]
        .map(|picture| encoded(&picture, image::ImageFormat::Png))
        .into()
}

pub fn jpegs() -> Vec<Vec<u8>> {
    let rgb = image::RgbImage::from_fn(24, 17, |x, y| image::Rgb([x as u8 * 9, y as u8 * 12, 99]));
    let grey = image::GrayImage::from_fn(8, 8, |x, y| image::Luma([(x * y) as u8]));
    [rgb.into(), grey.into()].map(|picture: image::DynamicImage| encoded(&picture, image::ImageFormat::Jpeg)).into()
}

/// A capture of two frames in the wild layout: its directory, body and metadata.
pub fn wild_capture(dir: &Path) -> (PathBuf, BodyModel, Vec<u8>) {
    let body = common::tiny_body();
    let frame = serde_json::json!({
        "poses": [[0.0, 0.1, 0.0], [0.0, 0.0, 0.2]], "betas": [0.5, -0.25],
        "cam_intrinsics": [[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]],
        "cam_extrinsics": [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 5], [0, 0, 0, 1]],
        "distortions": [0.01, 0.0, 0.0, 0.0, 0.0], "more": [1, "two"],
    });
    let metadata = serde_json::json!({ "1": frame, "2": frame }).to_string().into_bytes();
    for kind in ["images", "masks"] {
        std::fs::create_dir_all(dir.join(kind)).unwrap();
        for name in ["1.png", "2.png"] {
            image::RgbImage::from_pixel(8, 8, image::Rgb([255; 3])).save(dir.join(kind).join(name)).unwrap();
        }
    }
    std::fs::write(dir.join("metadata.json"), &metadata).unwrap();
    load_capture(dir, &body, &LoadOptions::default()).unwrap();
    (dir.to_owned(), body, metadata)
}

pub fn configurations() -> Vec<Vec<u8>> {
    let text = |preset, method| toml::to_string(&Config::preset(preset, method)).unwrap().into_bytes();
    vec![text(Preset::Fast, Method::Occnerf), text(Preset::Paper, Method::HashPoint)]
}

/// A scene, a checkpoint of a training on it, and its configuration.
pub fn checkpoint() -> (&'static Scene, Vec<u8>, Config) {
    let mut config = common::tiny(Method::Occnerf, MotionKind::Surface);
    (config.field.width, config.field.depth) = (16, 1);
    (config.encoding.levels, config.encoding.log2_table_size) = (2, 6);
    let mut trainer = Trainer::new(common::scene(), config.clone()).unwrap();
    trainer.step().unwrap();
    (common::scene(), common::checkpoint(&trainer), config)
}

/// Two tensors of a state dictionary, of these names, in an archive and in the old form.
pub fn tensors(names: [&str; 2]) -> [Vec<u8>; 2] {
    let tensor = |(key, name)| (name, "FloatStorage", key, 0, vec![2, 3], vec![3, 1]);
    let (each, storages) = ([(0, names[0]), (1, names[1])].map(tensor), [[0; 24], [63; 24]]);
    let storages = storages.map(|bytes: [u8; 24]| (bytes.to_vec(), 4));
    [false, true].map(|legacy| torch(&each, &storages, legacy))
}

/// Folder of two frames of 8 × 8 pixels, which fits belong to.
pub fn video() -> PathBuf {
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
        ("global_orient", Py::Array(vec![1, 3, 3], turn.to_vec())),
        ("body_pose", Py::Array(vec![23, 3, 3], turn.repeat(23))),
        ("betas", Py::Array(vec![10], vec![0.1; 10])),
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
            ("camera", list(&[Py::Array(vec![3], vec![0.1, 0.2, 9.0])])),
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
        let points = ("pred_keypoints_3d", Py::Array(vec![70, 3], points.as_flattened().to_vec()));
        Py::List(vec![Py::record([points, ("pred_cam_t", Py::Array(vec![3], place.to_vec())), one, two])])
    };
    let first = person([
        ("focal_length", Py::Array(Vec::new(), vec![9.0])),
        ("mask", Py::Array(vec![8, 8], mask.as_flattened().to_vec())),
    ]);
    let second = person([
        ("focal_length", Py::Raw(b"N".to_vec())),
        ("pred_keypoints_2d", Py::Array(vec![70, 2], pixels.as_flattened().to_vec())),
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
    let (dir, body, _) = wild_capture(&place("person-wild"));
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
