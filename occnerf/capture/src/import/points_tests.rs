//! SAM 3D Body's files and arrays of joints, made from motions that are known.

use glam::{DMat3, DVec3, Vec3};
use point_fit::joint_set;
use smpl::{MotionClip, Placement};
use testkit::body::Random;

use super::fit::{axis_angle, rotation};
use super::*;
use crate::testing::{Directory, Py, array, shared};

const FOCAL: f64 = 900.0;
const SIZE: (u32, u32) = (640, 480);

/// World to camera, y and z turned round.
fn to_camera(place: DVec3) -> (DMat3, DVec3) {
    (DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), place)
}

fn video(count: usize) -> Video {
    let names = (1..=count).map(|i| format!("{i:06}")).collect();
    Video { names, paths: vec![PathBuf::new(); count], size: SIZE }
}

/// The 70 points and 24 joints in the camera, and the pose with the root in it, of every frame.
fn truth(
    clip: &MotionClip,
    frames: usize,
    place: impl Fn(usize) -> DVec3,
) -> Vec<(Vec<DVec3>, Vec<DVec3>, Vec<DVec3>)> {
    let body = BodyModel::embedded();
    let set = joint_set(&body, "mhr70").unwrap();
    let frame = |f: usize| {
        let pose = &clip.poses[24 * f..24 * (f + 1)];
        let posed = body.pose(&body.shaped(&[0.8, -0.5]), pose, Placement::default());
        let (turn, at) = to_camera(place(f));
        let point = |anchor: &Option<point_fit::Anchor>| {
            let anchor = anchor.clone().unwrap_or_else(|| point_fit::Anchor::joint(15));
            let joints = anchor.joints.iter().map(|(j, w)| *w * posed.joints[*j]);
            let sum: Vec3 = joints.chain(anchor.vertices.iter().map(|(v, w)| *w * posed.vertices[*v])).sum();
            turn * sum.as_dvec3() + at
        };
        let mut pose: Vec<DVec3> = pose.iter().map(|v| v.as_dvec3()).collect();
        pose[0] = axis_angle(turn * rotation(pose[0]));
        (set.iter().map(point).collect(), posed.joints.iter().map(|j| turn * j.as_dvec3() + at).collect(), pose)
    };
    (0..frames).map(frame).collect()
}

/// A person as SAM 3D Body writes it, with noise of the points in metres.
fn person(points: &[DVec3], random: &mut Random, noise: f64, focal: bool) -> Py {
    let at = points[9] + DVec3::new(0.1, -0.1, 0.05);
    let noisy = |p: &DVec3| *p + (0..4).map(|_| random.vec3(0.866).as_dvec3()).sum::<DVec3>() * noise;
    let points: Vec<DVec3> = points.iter().map(noisy).collect();
    let pixel = |p: &DVec3| [FOCAL * p.x / p.z + 310.0, FOCAL * p.y / p.z + 250.0];
    let flat: Vec<f64> = points.iter().flat_map(|p| (*p - at).to_array()).collect();
    let mut items = vec![
        ("pred_keypoints_3d".to_owned(), array(&[70, 3], &flat)),
        ("pred_keypoints_2d".to_owned(), array(&[70, 2], &points.iter().flat_map(pixel).collect::<Vec<_>>())),
        ("pred_cam_t".to_owned(), array(&[3], &at.to_array())),
        ("bbox".to_owned(), array(&[4], &[0.0, 0.0, 9.0, 9.0])),
        ("mask".to_owned(), array(&[1, 2, 3], &[0.0, 1.0, 0.0, 0.0, 255.0, 0.0])),
    ];
    if focal {
        items.push(("focal_length".to_owned(), array(&[], &[FOCAL])));
    }
    Py::Dict(items)
}

fn as_json(value: &Py) -> serde_json::Value {
    match value {
        Py::Dict(items) => serde_json::Value::Object(items.iter().map(|(k, v)| (k.clone(), as_json(v))).collect()),
        Py::Text(text) => text.as_str().into(),
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
    for (noise, most) in [(0.0, [0.004, 8.0]), (0.015, [0.015, 12.0]), (0.03, [0.024, 14.0]), (0.045, [0.032, 17.0])] {
        let mut random = Random(11);
        // The second is not seen for some frames, the order changes.
        let frame = |f: usize| {
            let seen = (0..2).filter(|who| !(*who == 1 && (20..24).contains(&f)));
            let mut list: Vec<Py> = seen.map(|who| person(&people[who][f].0, &mut random, noise, true)).collect();
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
            let (fit, _) = read::read(&out.path().join(file), &video(count)).unwrap_or_else(|e| panic!("{file}: {e}"));
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
                let said = points::solve(&out.path().join(file), sam3d::SET, &mut person, &body).unwrap();
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
                            std::iter::successors(Some(j), |&k| body.parents[k])
                                .fold(DMat3::IDENTITY, |r, k| rotation(pose[k]) * r)
                        };
                        degrees += axis_angle(world(&frame.pose).transpose() * world(true_pose)).length().to_degrees();
                        n += 1.0;
                    }
                }
                let (metres, degrees) = (metres / n, degrees / n);
                println!(
                    "{:.0} mm, person {who}: joints {:.1} mm, rotations {degrees:.1} degrees; {said}",
                    1e3 * noise,
                    1e3 * metres
                );
                assert!(metres < most[0] && degrees < most[1], "{noise}: {metres} m, {degrees} degrees");
            }
        }
        assert!(all.iter().all(|other| other.len() == 2));
        assert_eq!(all[0], all[2]);
        assert_eq!(all[0], all[3]);
    }
}

/// One person's file of eight frames, for damage.
fn still(focal: bool) -> Option<Vec<Py>> {
    let clip = MotionClip::load(&shared("mocap")?.join("walk.npz")).unwrap();
    let mut random = Random(2);
    let frames = truth(&clip, 8, |_| DVec3::new(0.0, 0.0, 4.0));
    Some(frames.iter().map(|(points, ..)| Py::List(vec![person(points, &mut random, 0.0, focal)])).collect())
}

#[test]
fn a_camera_without_focal_length_is_solved_and_joints_are_read_as_arrays() {
    let Some(frames) = still(false) else { return };
    let out = Directory::new("import-sam3d-camera");
    out.write("video.pkl", Py::List(frames.clone()).pickle());
    let (fit, _) = read::read(&out.path().join("video.pkl"), &video(8)).unwrap();
    for frame in &fit.people[0].frames {
        assert!((frame.focal[0] - FOCAL).abs() < 0.1, "{:?}", frame.focal);
        assert!((frame.centre[0] - 310.0).hypot(frame.centre[1] - 250.0) < 0.1, "{:?}", frame.centre);
    }
    let points: Vec<f64> =
        fit.people[0].frames.iter().flat_map(|f| f.points.iter().flat_map(|p| p.to_array())).collect();
    let data = array_files::NdArray { shape: vec![8, 70, 3], data: array_files::Data::F64(points) };
    array_files::npz::write(&out.path().join("joints.npz"), &[("joints", data)]).unwrap();
    let path = out.path().join("joints.npz");
    let (again, _) = read::joints(&path, "mhr70", &video(8)).unwrap();
    assert_eq!((again.tool, again.people[0].frames.len()), (Tool::Joints, 8));
    assert_eq!(again.people[0].frames[3].points, fit.people[0].frames[3].points);
    let refused = |set: &str| read::joints(&path, set, &video(8)).err().unwrap().to_string();
    assert!(refused("coco17").contains("[frames, 17, 3]") && refused("coco18").contains("coco17, openpose25"));
}

#[test]
fn damaged_files_of_sam_3d_body_are_refused_in_one_line() {
    let Some(frames) = still(true) else { return };
    let out = Directory::new("import-sam3d-damage");
    let refused = |name: &str, words: &[&str]| {
        let error = read::read(&out.path().join(name), &video(8))
            .err()
            .unwrap_or_else(|| panic!("{name} was read"))
            .to_string();
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
        ("text.pkl", "pred_cam_t", Py::text("x"), ["2[0].pred_cam_t", "list"]),
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
    let whole = Py::List(frames).pickle();
    for bytes in crate::testing::damaged(&whole, 300) {
        out.write("mutated.pkl", bytes);
        if let Err(error) = read::read(&out.path().join("mutated.pkl"), &video(8)) {
            assert_eq!(error.to_string().lines().count(), 1, "{error}");
        }
    }
}
