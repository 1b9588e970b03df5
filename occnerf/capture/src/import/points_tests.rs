//! SAM 3D Body's files and arrays of joints, made from motions that are known.

use array_files::{Data, NdArray};
use glam::{DMat3, DVec3, Vec3};
use point_fit::{Anchor, joint_set};
use smpl::{MotionClip, Placement, Posed};
use testkit::body::Random;

use super::fit::{axis_angle, rotation};
use super::*;
use crate::testing::{Directory, Py, array, npy, shared};

const FOCAL: f64 = 900.0;
const SIZE: (u32, u32) = (640, 480);

/// World to camera, y and z turned round.
fn to_camera(place: DVec3) -> (DMat3, DVec3) {
    (DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), place)
}

/// The first person of a file.
fn only(path: &Path, count: usize) -> Person {
    read::read(path, &video(count)).unwrap().0.people.into_iter().next().unwrap()
}

fn video(count: usize) -> Video {
    tests::video((1..=count).map(|i| format!("{i:06}")), SIZE)
}

fn place_of(anchor: &Anchor, posed: &Posed) -> DVec3 {
    let joints = anchor.joints.iter().map(|(j, w)| *w * posed.joints[*j]);
    let sum: Vec3 = joints.chain(anchor.vertices.iter().map(|(v, w)| *w * posed.vertices[*v])).sum();
    sum.as_dvec3()
}

/// The 70 points and the vertices, the 24 joints, and the pose with the root, all in the camera.
type Truth = (Vec<DVec3>, Vec<DVec3>, Vec<DVec3>);

fn truth(clip: &MotionClip, frames: usize, place: impl Fn(usize) -> DVec3) -> Vec<Truth> {
    let body = BodyModel::embedded();
    let set = joint_set(&body, "mhr70").unwrap();
    let frame = |f: usize| {
        let pose = &clip.poses[24 * f..24 * (f + 1)];
        let posed = body.pose(&body.shaped(&[0.8, -0.5]), pose, Placement::default());
        let (turn, at) = to_camera(place(f));
        let point =
            |anchor: &Option<Anchor>| turn * place_of(anchor.as_ref().unwrap_or(&Anchor::joint(15)), &posed) + at;
        let mut pose: Vec<DVec3> = pose.iter().map(|v| v.as_dvec3()).collect();
        pose[0] = axis_angle(turn * rotation(pose[0]));
        let vertices = posed.vertices.iter().map(|v| turn * v.as_dvec3() + at);
        (
            set.iter().map(point).chain(vertices).collect(),
            posed.joints.iter().map(|j| turn * j.as_dvec3() + at).collect(),
            pose,
        )
    };
    (0..frames).map(frame).collect()
}

/// Mean distance of the first 22 joints in metres, and mean angle of their rotations in degrees.
fn errors(body: &BodyModel, person: &Person, truth: &[Truth]) -> [f64; 2] {
    let (mut metres, mut degrees, mut n) = (0.0, 0.0, 0.0);
    for frame in &person.frames {
        let betas: Vec<f32> = frame.betas.iter().map(|b| *b as f32).collect();
        let pose: Vec<Vec3> = frame.pose.iter().map(|v| v.as_vec3()).collect();
        let placement = Placement::Pelvis { translation: frame.offset.as_vec3() };
        let found = body.pose(&body.shaped(&betas), &pose, placement).joints;
        let (_, joints, true_pose) = &truth[frame.index];
        for j in 0..22 {
            metres += found[j].as_dvec3().distance(joints[j]);
            let world = |pose: &[DVec3]| {
                std::iter::successors(Some(j), |&k| body.parents[k]).fold(DMat3::IDENTITY, |r, k| rotation(pose[k]) * r)
            };
            degrees += axis_angle(world(&frame.pose).transpose() * world(true_pose)).length().to_degrees();
            n += 1.0;
        }
    }
    [metres / n, degrees / n]
}

/// A person as SAM 3D Body writes it, with noise of the points in metres.
fn person(points: &[DVec3], random: &mut Random, noise: f64, focal: bool) -> Py {
    let at = points[9] + DVec3::new(0.1, -0.1, 0.05);
    let noisy = |p: &DVec3| *p + (0..4).map(|_| random.vec3(0.866).as_dvec3()).sum::<DVec3>() * noise;
    let points: Vec<DVec3> = points.iter().map(noisy).collect();
    let pixel = |p: &DVec3| [FOCAL * p.x / p.z + 310.0, FOCAL * p.y / p.z + 250.0];
    let flat = |points: &[DVec3]| points.iter().flat_map(|p| (*p - at).to_array()).collect::<Vec<_>>();
    let (points, vertices) = points.split_at(70);
    let mut items = vec![
        ("pred_keypoints_3d".to_owned(), array(&[70, 3], &flat(points))),
        ("pred_keypoints_2d".to_owned(), array(&[70, 2], &points.iter().flat_map(pixel).collect::<Vec<_>>())),
        ("pred_cam_t".to_owned(), array(&[3], &at.to_array())),
        ("bbox".to_owned(), array(&[4], &[0.0, 0.0, 9.0, 9.0])),
        ("mask".to_owned(), array(&[1, 2, 3], &[0.0, 1.0, 0.0, 0.0, 255.0, 0.0])),
    ];
    if !vertices.is_empty() {
        items.push(("pred_vertices".to_owned(), array(&[vertices.len() as u32, 3], &flat(vertices))));
    }
    if focal {
        items.push(("focal_length".to_owned(), array(&[], &[FOCAL])));
    }
    Py::Dict(items)
}

fn as_json(value: &Py) -> serde_json::Value {
    match value {
        Py::Dict(items) => serde_json::Value::Object(items.iter().map(|(k, v)| (k.clone(), as_json(v))).collect()),
        Py::Text(text) => text.as_str().into(),
        Py::Raw(_) => unreachable!(),
        Py::List(items) => items.iter().map(as_json).collect::<Vec<_>>().into(),
        Py::Array(shape, values) => match shape.split_first() {
            None => values[0].into(),
            Some((n, rest)) => {
                let rows = values.chunks(values.len() / *n as usize);
                rows.map(|row| as_json(&Py::Array(rest.to_vec(), row.to_vec()))).collect::<Vec<_>>().into()
            }
        },
    }
}

#[test]
fn people_of_sam_3d_body_are_told_apart_and_a_body_is_fitted_to_each() {
    let Some(dir) = shared("mocap") else { return };
    let clips = ["walk.npz", "turn.npz"].map(|name| MotionClip::load(&dir.join(name)).unwrap());
    let count = 60;
    let across = |f: usize| -1.0 + 2.0 * f as f64 / count as f64;
    let people = [
        truth(&clips[0], count, |f| DVec3::new(across(f), 0.0, 4.0)),
        truth(&clips[1], count, |f| DVec3::new(-across(f), 0.1, 4.9)),
    ];
    let out = Directory::new("import-sam3d");
    let body = BodyModel::embedded();
    for (noise, most) in [(0.0, [0.004, 7.0]), (0.015, [0.015, 11.0]), (0.03, [0.024, 13.5]), (0.045, [0.032, 16.0])] {
        let mut random = Random(11);
        // The second is not seen for some frames, the order changes.
        let frame = |f: usize| {
            let seen = (0..2).filter(|who| !(*who == 1 && (20..24).contains(&f)));
            let mut list: Vec<Py> = seen.map(|who| person(&people[who][f].0[..70], &mut random, noise, true)).collect();
            if f.is_multiple_of(3) {
                list.reverse();
            }
            Py::List(list)
        };
        let frames: Vec<Py> = (0..count).map(frame).collect();
        out.write("video.pkl", Py::List(frames.clone()).pickle());
        out.write("video.json", as_json(&Py::List(frames.clone())).to_string());
        let named = frames.iter().enumerate().map(|(f, list)| (format!("images/{:06}.jpg", f + 1), list.clone()));
        out.write("named.pkl", Py::Dict(named.collect()).pickle());
        let folder = format!("frames{noise}");
        for (f, list) in frames.iter().enumerate() {
            out.write(&format!("{folder}/out_{:06}.pkl", f + 1), list.pickle());
        }
        let mut all = Vec::new();
        for file in ["video.pkl", "video.json", "named.pkl", &folder] {
            let (fit, _) = read::read(&out.file(file), &video(count)).unwrap_or_else(|e| panic!("{file}: {e}"));
            assert_eq!((fit.tool, fit.people.len()), (Tool::Sam3dBody, 2), "{file}");
            let points =
                |person: &Person| person.frames.iter().map(|f| (f.index, f.points.clone())).collect::<Vec<_>>();
            all.push(fit.people.iter().map(points).collect::<Vec<_>>());
            for (who, mut person) in fit.people.into_iter().enumerate() {
                // The first frame is in reverse.
                let truth = &people[1 - who];
                assert_eq!(person.frames.len(), if who == 0 { count - 4 } else { count }, "{file}");
                assert!(person.frames.iter().all(|f| f.focal == [FOCAL; 2] && f.mask.is_some()));
                for frame in &person.frames {
                    let off = frame.points[9].distance(truth[frame.index].0[9]);
                    assert!(off < 5.0 * noise + 1e-3, "{file}: frame {} is of the other: {off}", frame.index);
                }
                if file != "video.pkl" {
                    continue;
                }
                points::solve(&out.file(file), sam3d::SET, Vec::new(), &mut person, &body).unwrap();
                let [metres, degrees] = errors(&body, &person, truth);
                assert!(metres < most[0] && degrees < most[1], "{noise}: {metres} m, {degrees} degrees");
            }
        }
        assert!(all.iter().all(|other| other.len() == 2));
        assert_eq!(all[0], all[2]);
        assert_eq!(all[0], all[3]);
    }
}

/// A vertex map that maps each of the body's vertices to itself.
fn identity_map(body: &BodyModel) -> (Vec<f64>, Vec<f64>) {
    let of = |v: usize| {
        let face = body.faces.iter().position(|face| face.contains(&(v as u32))).unwrap();
        (face as f64, body.faces[face].map(|corner| f64::from(u8::from(corner as usize == v))))
    };
    let (ids, weights): (Vec<f64>, Vec<[f64; 3]>) = (0..body.num_vertices()).map(of).unzip();
    (ids, weights.concat())
}

/// Fingers that curl, of SMPL-X's form.
#[test]
fn fingers_follow_their_points_on_a_body_that_has_them() {
    let Some(path) = shared("body/open_body_x.npz") else { return };
    let body = BodyModel::load(&path).unwrap();
    let set = joint_set(&body, sam3d::SET).unwrap();
    let curl = |f: usize, joint: usize| match joint {
        // Fingers of both hands bend towards the palm, thumbs less.
        25..=36 => Vec3::NEG_Z * (0.3 + 0.05 * f as f32),
        40..=51 => Vec3::Z * (0.3 + 0.05 * f as f32),
        _ => Vec3::ZERO,
    };
    let (mut frames, mut truth) = (Vec::new(), Vec::new());
    for f in 0..12 {
        let pose: Vec<Vec3> = (0..55).map(|joint| curl(f, joint)).collect();
        let posed = body.pose(&body.shaped(&[]), &pose, Placement::Pelvis { translation: Vec3::Z * 4.0 });
        let point = |anchor: &Option<Anchor>| anchor.as_ref().map_or(DVec3::NAN, |anchor| place_of(anchor, &posed));
        let points = set.iter().map(point).collect();
        frames.push(FitFrame { index: f, points, focal: [FOCAL; 2], centre: [FOCAL; 2], ..FitFrame::default() });
        truth.push(posed.joints);
    }
    let mut person = Person::new(0, frames);
    points::solve(&path, sam3d::SET, Vec::new(), &mut person, &body).unwrap();
    for (frame, truth) in person.frames.iter().zip(&truth) {
        let betas: Vec<f32> = frame.betas.iter().map(|b| *b as f32).collect();
        let of = |hands: bool| {
            let joint = |(j, v): (usize, &DVec3)| if j < 25 || hands { v.as_vec3() } else { Vec3::ZERO };
            let pose: Vec<Vec3> = frame.pose.iter().enumerate().map(joint).collect();
            let placement = Placement::Pelvis { translation: frame.offset.as_vec3() };
            let found = body.pose(&body.shaped(&betas), &pose, placement).joints;
            (25..55).map(|j| found[j].distance(truth[j])).sum::<f32>() / 30.0
        };
        assert!(of(true) < 0.006 && of(true) < 0.5 * of(false), "{}", frame.index);
    }
}

#[test]
fn vertices_of_a_mesh_tell_the_twist_of_limbs_through_a_map() {
    let Some(dir) = shared("mocap") else { return };
    let clip = MotionClip::load(&dir.join("walk.npz")).unwrap();
    let body = BodyModel::embedded();
    let truth = truth(&clip, 40, |_| DVec3::new(0.0, 0.0, 4.0));
    let out = Directory::new("import-sam3d-map");
    let (path, map) = (out.file("video.pkl"), out.file("map.npz"));
    let count = body.num_vertices();
    let (ids, weights) = identity_map(&body);
    let write = |ids: &[f64], weights: &[f64]| {
        let array = |shape: Vec<usize>, values: &[f64]| NdArray { shape, data: Data::F64(values.to_vec()) };
        let weights = array(vec![weights.len() / 3, 3], weights);
        let parts = [("triangle_ids", array(vec![ids.len()], ids)), ("baryc_coords", weights)];
        array_files::npz::write(&map, &parts).unwrap();
    };
    write(&ids, &weights);
    for (noise, most) in [(0.0, [0.004, 3.0]), (0.015, [0.01, 6.0]), (0.03, [0.016, 9.0]), (0.045, [0.02, 11.0])] {
        let mut random = Random(5);
        let frames = truth.iter().map(|(points, ..)| Py::List(vec![person(points, &mut random, noise, true)]));
        out.write("video.pkl", Py::List(frames.collect()).pickle());
        let [joints_alone, both] = [false, true].map(|is_mapped| {
            let mut person = only(&path, 40);
            assert_eq!(person.vertices, count);
            let mapped =
                if is_mapped { points::mapped(&path, Some(&map), count, &body, true).unwrap() } else { Vec::new() };
            points::solve(&path, sam3d::SET, mapped, &mut person, &body).unwrap();
            errors(&body, &person, &truth)
        });
        assert!(both[0] < most[0] && both[1] < most[1], "{noise}: {both:?}");
        assert!(both[1] < 0.8 * joints_alone[1], "{noise}: {both:?}, of joints alone {joints_alone:?}");
    }
    // MHR's mesh needs no map on the open body: at its vertices the middles of faces.
    let faces = points::mapped(&path, None, points::MHR, &body, true).unwrap();
    assert_eq!((faces.len(), points::mapped(&path, None, points::MHR, &body, false).unwrap().len()), (128, 0));
    let frame = |(points, ..): &Truth| {
        let mut all = vec![points[0]; 70 + points::MHR];
        all[..70].copy_from_slice(&points[..70]);
        for (point, anchor) in all[70..].iter_mut().step_by(145).zip(&faces) {
            *point = anchor.vertices.iter().map(|(v, _)| points[70 + v] / 3.0).sum();
        }
        Py::List(vec![person(&all, &mut Random(5), 0.0, true)])
    };
    out.write("mhr.pkl", Py::List(truth.iter().map(frame).collect()).pickle());
    let mut mhr = only(&out.file("mhr.pkl"), 40);
    points::solve(&path, sam3d::SET, faces, &mut mhr, &body).unwrap();
    let [metres, degrees] = errors(&body, &mhr, &truth);
    assert!(metres < 0.004 && degrees < 3.0, "{metres} m, {degrees} degrees");
    // Of another body.
    let shifted: Vec<f64> = (0..count).map(|v| ids[(v + 3000) % count]).collect();
    write(&shifted, &weights);
    let mut person = only(&path, 40);
    let mapped = points::mapped(&path, Some(&map), count, &body, true).unwrap();
    let error = points::solve(&path, sam3d::SET, mapped, &mut person, &body).unwrap_err().to_string();
    assert!(error.contains("vertex map is of (--body), and pred_vertices") && error.contains("mm off"), "{error}");
    let refused = |vertices: usize, words: &[&str]| {
        let error = points::mapped(&path, Some(&map), vertices, &body, true).unwrap_err().to_string();
        assert!(error.lines().count() == 1 && words.iter().all(|word| error.contains(word)), "{error}");
    };
    refused(0, &["video.pkl", "pred_vertices", "none"]);
    refused(18439, &["map.npz", "18439 pred_vertices", "6890"]);
    write(&vec![13776.0; count], &weights);
    refused(count, &["triangle_ids", "below 13776", "found 13776"]);
    write(&ids, &vec![0.5; 3 * count]);
    refused(count, &["baryc_coords", "sum to 1", "0.5"]);
    write(&ids, &vec![f64::NAN; 3 * count]);
    refused(count, &["baryc_coords", "finite", "NaN"]);
    std::fs::write(&map, b"PK\x03\x04").unwrap();
    refused(count, &["map.npz"]);
}

/// One person's file of eight frames.
fn still(focal: bool) -> Option<Vec<Py>> {
    let clip = MotionClip::load(&shared("mocap")?.join("walk.npz")).unwrap();
    let mut random = Random(2);
    let frames = truth(&clip, 8, |_| DVec3::new(0.0, 0.0, 4.0));
    Some(frames.iter().map(|(points, ..)| Py::List(vec![person(&points[..74], &mut random, 0.0, focal)])).collect())
}

#[test]
fn a_camera_without_focal_length_is_solved_and_joints_are_read_as_arrays() {
    let Some(frames) = still(false) else { return };
    let out = Directory::new("import-sam3d-camera");
    out.write("video.pkl", Py::List(frames).pickle());
    let person = only(&out.file("video.pkl"), 8);
    for frame in &person.frames {
        assert!((frame.focal[0] - FOCAL).abs() < 0.1, "{:?}", frame.focal);
        assert!((frame.centre[0] - 310.0).hypot(frame.centre[1] - 250.0) < 0.1, "{:?}", frame.centre);
    }
    let points = person.frames.iter().flat_map(|f| f.points[..70].iter().flat_map(|p| p.to_array()));
    let data = NdArray { shape: vec![8, 70, 3], data: Data::F64(points.collect()) };
    let path = out.file("joints.npz");
    array_files::npz::write(&path, &[("joints", data)]).unwrap();
    let (again, _) = read::joints(&path, "mhr70", &video(8)).unwrap();
    assert_eq!((again.tool, again.people[0].frames.len()), (Tool::Joints, 8));
    assert_eq!(again.people[0].frames[3].points, person.frames[3].points[..70]);
    let refused = |set: &str| read::joints(&path, set, &video(8)).err().unwrap().to_string();
    assert!(refused("coco17").contains("[frames, 17, 3]") && refused("coco18").contains("coco17, openpose25"));
}

#[test]
fn damaged_files_of_sam_3d_body_are_refused_in_one_line() {
    let Some(frames) = still(true) else { return };
    let out = Directory::new("import-sam3d-damage");
    let refused = |name: &str, words: &[&str]| {
        let error =
            read::read(&out.file(name), &video(8)).err().unwrap_or_else(|| panic!("{name} was read")).to_string();
        assert!(error.lines().count() == 1 && words.iter().all(|word| error.contains(word)), "{name}: {error}");
    };
    let with = |key: &str, to: Py| {
        let mut frames = frames.clone();
        let Py::List(people) = &mut frames[2] else { unreachable!() };
        let Py::Dict(items) = &mut people[0] else { unreachable!() };
        items.iter_mut().find(|(k, _)| k == key).unwrap().1 = to;
        Py::List(frames).pickle()
    };
    for (name, key, to, words) in [
        ("nan.pkl", "pred_keypoints_3d", array(&[70, 3], &[f64::NAN; 210]), ["2[0].pred_keypoints_3d", "finite"]),
        ("count.pkl", "pred_keypoints_3d", array(&[17, 3], &[0.0; 51]), ["[1, 70, 3]", "[17, 3]"]),
        ("behind.pkl", "pred_cam_t", array(&[3], &[0.0, 0.0, -9.0]), ["2[0].pred_keypoints_3d", "in front"]),
        ("focal.pkl", "focal_length", array(&[], &[-1.0]), ["frame 2", "focal length"]),
        ("mask.pkl", "mask", array(&[6], &[0.0; 6]), ["2[0].mask", "[_, _]"]),
        ("text.pkl", "pred_cam_t", Py::text("x"), ["2[0].pred_cam_t", "array"]),
        ("mesh.pkl", "pred_vertices", array(&[2, 2], &[0.0; 4]), ["2[0].pred_vertices", "[_, 3]"]),
        ("rows.pkl", "pred_vertices", array(&[2, 3], &[0.0; 6]), ["2[0].pred_vertices", "4 rows"]),
    ] {
        out.write(name, with(key, to));
        refused(name, &words);
    }
    let Py::List(people) = &frames[2] else { unreachable!() };
    out.write("crowd.pkl", Py::List(vec![Py::List(vec![people[0].clone(); 257])]).pickle());
    refused("crowd.pkl", &["at most 256 people", "257"]);
    out.write("twice/000002.pkl", frames[0].pickle());
    out.write("twice/2.json", as_json(&frames[1]).to_string());
    refused("twice", &["number 2", "000002.pkl and 2.json"]);
    out.write("cut.json", &as_json(&Py::List(frames.clone())).to_string()[..999]);
    refused("cut.json", &["JSON", "EOF"]);
    let long: Vec<Py> = frames.iter().cycle().take(20).cloned().collect();
    out.write("long.pkl", Py::List(long).pickle());
    refused("long.pkl", &["8", "19"]);
}

/// Small files of one person: a pickle, JSON, and an archive of one picture.
pub(super) fn files() -> Option<[Vec<u8>; 3]> {
    let frames = Py::List(still(true)?);
    let archive = [
        ("pred_keypoints_3d.npy", npy(&[70, 3], &[0.5; 210])),
        ("pred_cam_t.npy", npy(&[3], &[0.0, 0.0, 4.0])),
        ("focal_length.npy", npy(&[], &[900.0])),
    ];
    Some([frames.pickle(), as_json(&frames).to_string().into_bytes(), testkit::files::zip(archive)])
}
