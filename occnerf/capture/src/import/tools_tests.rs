//! A known motion in the forms of tools and data sets whose files are not among the shared ones.

use std::fmt::Write as _;

use array_files::pickle::Value;
use array_files::{Data, NdArray, npz};
use glam::{DMat3, DQuat, DVec3};
use testkit::files::zip;

use super::fit::{axis_angle, rotation};
use super::tests::{Motion, extrinsics, known, video};
use super::*;
use crate::testing::{self, Directory, Py, shared};

fn array(shape: &[usize], values: impl IntoIterator<Item = f64>) -> NdArray {
    NdArray { shape: shape.to_vec(), data: Data::F64(values.into_iter().collect()) }
}

fn dictionary<const N: usize>(entries: [(&str, NdArray); N]) -> Value {
    nested(entries.map(|(key, array)| (key, Value::Array(array))))
}

fn nested<const N: usize>(entries: [(&str, Value); N]) -> Value {
    Value::Dict(entries.map(|(key, value)| (Value::Str(key.to_owned()), value)).into())
}

fn flat(vectors: impl IntoIterator<Item = DVec3>) -> Vec<f64> {
    vectors.into_iter().flat_map(|v| v.to_array()).collect()
}

fn parse(value: &Value, video: &Video) -> Result<fit::Fit, CaptureError> {
    read::parse(Path::new("the.pkl"), value, video)
}

#[track_caller]
fn refused(fit: Result<fit::Fit, CaptureError>, words: &[&str]) {
    let error = fit.err().unwrap().to_string();
    assert!(words.iter().all(|word| error.contains(word)), "{error}");
}

#[test]
fn a_weak_perspective_camera_of_vibe_and_ours_agree_near_the_body() {
    let (scale, tx, ty) = (0.8, 0.1, -0.25);
    // The vertical scale is the horizontal one times W/H.
    let camera = [scale, scale * 640.0 / 480.0, tx, ty];
    // The same in a square of 200 pixels about (350, 180).
    let crop = [scale * 640.0 / 200.0, tx - (350.0 - 320.0) / 320.0 / scale, ty - (180.0 - 240.0) / 240.0 / camera[1]];
    let video = video((0..6).map(|i| format!("{i:06}")), (640, 480));
    let square = array(&[2, 4], [350.0, 180.0, 200.0, 200.0].repeat(2));
    for cameras in [
        [("orig_cam", array(&[2, 4], camera.repeat(2))), ("more", square.clone())],
        [("pred_cam", array(&[2, 3], crop.repeat(2))), ("bboxes", square.clone())],
    ] {
        let [one, two] = cameras;
        let (pose, betas) = (array(&[2, 72], [0.1; 144]), array(&[2, 10], [0.5; 20]));
        let person = dictionary([("frame_ids", array(&[2], [3.0, 4.0])), ("pose", pose), ("betas", betas), one, two]);
        let fit = parse(&nested([("7", person)]), &video).unwrap();
        assert_eq!((fit.tool, fit.people[0].id.as_str()), (Tool::Vibe, "7"));
        let frame = &fit.people[0].frames[0];
        assert_eq!(frame.index, 3);
        for p in [DVec3::ZERO, DVec3::new(0.3, -0.6, 0.0)] {
            let q = p + frame.pelvis(DVec3::ZERO);
            let found = [0, 1].map(|i| frame.focal[i] * q[i] / q.z + frame.centre[i]);
            let expected = [320.0 * (1.0 + camera[0] * (p.x + tx)), 240.0 * (1.0 + camera[1] * (p.y + ty))];
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3), "{found:?} {expected:?}");
        }
    }
}

#[test]
fn what_glamr_writes_of_a_known_motion_is_that_motion() {
    let Some(dir) = shared("estimators") else { return };
    let motion = known(&dir);
    let Motion { video, k, betas, poses, pelvises, .. } = &motion;
    let n = poses.len();
    let (mut cameras, mut roots, mut places, mut lenses) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (i, (pose, pelvis)) in poses.iter().zip(pelvises).enumerate() {
        let turn = rotation(DVec3::new(1.7, 0.02 * i as f64, -0.4));
        let moved = DVec3::new(0.3, -0.2, 0.1 * i as f64);
        cameras.extend(extrinsics(turn, moved));
        roots.push(axis_angle(turn.transpose() * rotation(pose[0])));
        places.push(turn.transpose() * (*pelvis - moved));
        // Hidden in the third frame, not there in the last.
        lenses.extend(if i == 2 { vec![0.0; 9] } else { k.clone() });
    }
    let with = |count: usize| {
        let person = dictionary([
            ("exist_frames", array(&[n], (0..n).map(|i| f64::from(i + 1 < n)))),
            ("smpl_pose", array(&[n, 69], flat(poses.iter().flat_map(|pose| pose[1..].to_vec())))),
            ("smpl_beta", array(&[n, count], betas[..count].repeat(n))),
            ("smpl_orient_world", array(&[n, 3], flat(roots.clone()))),
            ("root_trans_world", array(&[n, 3], flat(places.clone()))),
            ("cam_K", array(&[n, 3, 3], lenses.clone())),
        ]);
        let cameras = Value::Array(array(&[n, 4, 4], cameras.clone()));
        parse(&nested([("cam_pose", cameras), ("person_data", nested([("0", person)]))]), video)
    };
    let fit = with(10).unwrap();
    assert_eq!((fit.tool, fit.people[0].frames.len()), (Tool::Glamr, n - 1));
    motion.is_of(&fit.people[0]);
    refused(with(9), &["the.pkl", "person_data.0.smpl_beta", "10]", "9]"]);
}

#[test]
fn rows_of_two_people_of_cliff_in_any_order_are_two_people() {
    let Some(dir) = shared("estimators") else { return };
    let Motion { video, betas, poses, pelvises, joint, .. } = known(&dir);
    // Another person three metres behind, named first in odd pictures, away in the fifth.
    let rows: Vec<(usize, bool)> = (0..poses.len())
        .flat_map(|i| if i % 2 == 0 { [(i, false), (i, true)] } else { [(i, true), (i, false)] })
        .filter(|row| *row != (5, true))
        .collect();
    let n = rows.len();
    let out = Directory::new("import-cliff");
    let path = out.path().join("clip_cliff_hr48.npz");
    let of = |row: &(usize, bool)| pelvises[row.0] - joint + DVec3::Z * if row.1 { 3.0 } else { 0.0 };
    for matrices in [false, true] {
        let values = |(i, _): &(usize, bool)| match matrices {
            true => poses[*i].iter().flat_map(|v| rotation(*v).transpose().to_cols_array()).collect(),
            false => flat(poses[*i].clone()),
        };
        let with = |first: f64| {
            let detected = rows.iter().flat_map(|row| [row.0 as f64 * first, 1.0, 2.0, 3.0, 4.0, 0.9, 0.9, 0.0]);
            let shape: &[usize] = if matrices { &[n, 24, 3, 3] } else { &[n, 72] };
            let arrays = [
                ("pose", array(shape, rows.iter().flat_map(values))),
                ("shape", array(&[n, 10], betas.repeat(n))),
                ("global_t", array(&[n, 3], flat(rows.iter().map(of)))),
                ("pred_joints", array(&[n, 2, 3], vec![0.0; 6 * n])),
                ("focal_l", array(&[n], vec![362.0; n])),
                ("detection_all", array(&[n, 8], detected)),
            ];
            npz::write(&path, &arrays).unwrap();
            read::read(&path, &video).map(|(fit, _)| fit)
        };
        let fit = with(1.0).unwrap();
        let counts: Vec<usize> = fit.people.iter().map(|person| person.frames.len()).collect();
        assert_eq!((fit.tool, counts), (Tool::Cliff, vec![poses.len(), poses.len() - 1]));
        for (i, frame) in fit.people[0].frames.iter().enumerate() {
            assert_eq!((frame.index, frame.focal), (i, [362.0; 2]));
            assert!(frame.pelvis(joint).distance(pelvises[i]) < 1e-5);
            let turns = frame.pose.iter().zip(&poses[i]).map(|(a, b)| (rotation(*a), rotation(*b)));
            turns.for_each(|(a, b)| assert!(a.abs_diff_eq(b, 1e-6)));
        }
        refused(with(0.5), &["detection_all", "0.5"]);
    }
}

#[test]
fn what_peoplesnapshot_prepares_of_a_known_motion_is_that_motion() {
    let Some(dir) = shared("estimators") else { return };
    let motion = known(&dir);
    let Motion { video, k, betas, poses, pelvises, joint } = &motion;
    let out = Directory::new("import-peoplesnapshot");
    let (turn, moved) = (rotation(DVec3::new(3.0, 0.2, -0.4)), DVec3::new(0.3, -0.2, 1.5));
    std::fs::create_dir_all(out.file("poses")).unwrap();
    let write = |name: &str, arrays: &[(&str, NdArray)]| npz::write(&out.file(name), arrays).unwrap();
    let cameras = |name: &str, width: f64| {
        let intrinsic = ("intrinsic", array(&[3, 3], k.clone()));
        let sides = [("height", array(&[], [256.0])), ("width", array(&[], [width]))];
        write(name, &[&[intrinsic, ("extrinsic", array(&[4, 4], extrinsics(turn, moved)))], &sides[..]].concat());
    };
    cameras("cameras.npz", 256.0);
    cameras("cam_parms.npz", 256.0);
    let n = poses.len();
    let thetas = poses.iter().flat_map(|pose| {
        let root = axis_angle(turn.transpose() * rotation(pose[0]));
        flat([&[root], &pose[1..]].concat())
    });
    let thetas: Vec<f64> = thetas.collect();
    let part =
        |from: usize, to: usize| array(&[n, to - from], thetas.chunks(72).flat_map(|row| row[from..to].to_vec()));
    let transl = array(&[n, 3], flat(pelvises.iter().map(|p| turn.transpose() * (*p - moved) - *joint)));
    let both = [("betas", array(&[1, 10], betas.clone())), ("transl", transl.clone())];
    write("poses.npz", &[&both[..], &[("thetas", part(0, 72))]].concat());
    // The other form of the same, in a folder below.
    write("poses/train.npz", &[&both[..], &[("global_orient", part(0, 3)), ("body_pose", part(3, 72))]].concat());
    // The same as GaussianAvatar has it, and with the joints of SMPL-X.
    for (name, width) in [("smpl_parms.pth", 72), ("smplx.pth", 165)] {
        let bodies = thetas.chunks(72).flat_map(|row| row.iter().copied().chain([0.0; 93]).take(width));
        let parms = Py::record([
            ("beta", testing::array(&[1, 10], betas)),
            ("body_pose", testing::array(&[n as u32, width as u32], &bodies.collect::<Vec<_>>())),
            ("trans", testing::array(&[n as u32, 3], &transl.to_f64())),
        ]);
        out.write(name, zip([("archive/data.pkl", parms.pickle())]));
    }
    let read = |name: &str| read::read(&out.file(name), video).map(|(fit, _)| fit);
    for (file, tool) in [
        ("poses.npz", Tool::PeopleSnapshot),
        ("poses/train.npz", Tool::PeopleSnapshot),
        ("smpl_parms.pth", Tool::GaussianAvatar),
    ] {
        let fit = read(file).unwrap();
        assert_eq!((fit.tool, fit.people.len(), fit.people[0].frames.len()), (tool, 1, n));
        motion.is_of(&fit.people[0]);
    }
    refused(read("smplx.pth"), &["smplx.pth", "body_pose", "72", "165"]);
    cameras("cameras.npz", 1080.0);
    refused(read("poses.npz"), &["cameras.npz", "width", "256", "1080"]);
    cameras("cameras.npz", 256.0);
    let [_, place] = &both;
    for shape in [vec![300], vec![10, n], vec![n, 10]] {
        let shape = array(&shape, vec![0.0; shape.iter().product()]);
        write("poses.npz", &[("betas", shape), place.clone(), ("thetas", part(0, 72))]);
        refused(read("poses.npz"), &["poses.npz", "betas", "[1, 10]"]);
    }
    let few = [("thetas", array(&[2, 72], [0.0; 144])), ("transl", array(&[2, 3], [0.0; 6]))];
    write("poses.npz", &[&both[..1], &few[..]].concat());
    refused(read("poses.npz"), &["poses.npz", "transl", "20 rows", "found 2"]);
    out.remove("cameras.npz");
    refused(read("poses.npz"), &["cameras.npz", "missing"]);
}

#[test]
fn what_neuman_aligns_to_a_known_motion_is_that_motion() {
    let Some(dir) = shared("estimators") else { return };
    let motion = known(&dir);
    let Motion { k, betas, poses, pelvises, joint, .. } = &motion;
    // Pictures are named by the rows of the poses.
    let video = video((0..poses.len()).map(|i| format!("{i:05}")), motion.video.size);
    let out = Directory::new("import-neuman");
    // A camera that moves, and a scene in which a metre is 0.3.
    let (scale, mut images, mut alignments) = (0.3, String::from("# Image list\n"), Vec::new());
    let mut bodies = Vec::new();
    for (i, (pose, pelvis)) in poses.iter().zip(pelvises).enumerate() {
        let by = i as f64 * 0.01;
        let q = DQuat::from_scaled_axis(DVec3::new(0.1 + by, -0.3, 0.2 * by));
        let (camera, t) = (DMat3::from_quat(q), DVec3::new(by, 0.2, -0.1));
        let turn = rotation(DVec3::new(2.9, by, 0.1));
        bodies.push(axis_angle((camera * turn).transpose() * rotation(pose[0])));
        bodies.extend(&pose[1..]);
        let offset = camera.transpose() * (*pelvis * scale - t) - scale * (turn * *joint);
        let matrix = flat([turn.x_axis * scale, turn.y_axis * scale, turn.z_axis * scale, offset]);
        alignments.push((format!("{i:05}.png"), testing::array(&[4, 3], &matrix)));
        writeln!(images, "{} {} {} {} {} {} {} {} 1 {i:05}.png", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z).unwrap();
        images.push_str(if i % 2 == 0 { "\n" } else { "12.5 30.25 -1 18 22 7\n" });
    }
    let n = poses.len() as u32;
    let person = Py::record([
        ("pose", testing::array(&[n, 72], &flat(bodies))),
        ("betas", testing::array(&[n, 10], &betas.repeat(poses.len()))),
    ]);
    out.write("smpl_output_romp.pkl", Py::Dict(vec![("1".to_owned(), person)]).pickle());
    out.write("alignments.npy", Py::Dict(alignments).npy());
    let cameras = format!("# Camera list\n1 OPENCV 256 256 {} {} {} {} 0.01 0 0 0\n", k[0], k[4], k[2], k[5]);
    out.write("sparse/cameras.txt", &cameras);
    out.write("sparse/images.txt", &images);
    let read = || read::read(&out.file("smpl_output_romp.pkl"), &video).map(|(fit, _)| fit);
    let fit = read().unwrap();
    assert_eq!((fit.tool, fit.people[0].id.as_str(), fit.people[0].frames.len()), (Tool::NeuMan, "1", poses.len()));
    motion.is_of(&fit.people[0]);
    for (file, text, words) in [
        ("sparse/cameras.txt", &*cameras.replace("OPENCV", "FISHEYE"), &["line 2", "PINHOLE", "FISHEYE"][..]),
        ("sparse/cameras.txt", &cameras.replace("256 256", "256 512"), &["256×256, as the frames"]),
        ("sparse/images.txt", "1 1 0 0 0 0 0 0 2 00000.png", &["line 1", "camera of cameras.txt", "found 2"]),
        ("sparse/images.txt", "1 1 0 0 0 0 0 0 1 00099.png", &["a number below", "00099.png"]),
        ("sparse/images.txt", "1 1 0 0 nan 0 0 0 1 00000.png", &["rotation (4)", "nan"]),
        ("sparse/images.txt", "1 9 0 0 0 0 0 0 1 00000.png", &["unit quaternion"]),
    ] {
        let before = std::fs::read(out.file(file)).unwrap();
        out.write(file, text);
        refused(read(), &[&[file], words].concat());
        out.write(file, before);
    }
}
