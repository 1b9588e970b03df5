//! A tiny capture on disk, whole and with every fault, which is told in one line that names the
//! file, the key, what was expected and what was found. What layouts share is tested with the wild
//! one.

use glam::Vec3;
use smpl::Placement;

use crate::testing::{Directory, Py, array, body, fails, flat, load, load_with, names, views};
use crate::{LoadOptions, find_body};

const SIZE: (u32, u32) = (6, 4);
const FRAME: &str = "frame_000001";

/// A capture of three frames with an evaluation camera at two of them.
struct Fixture {
    dir: Directory,
    cameras: Py,
    mesh_infos: Py,
    canonical: Py,
}

impl Fixture {
    fn new(name: &str) -> Self {
        let joints = array(&[2, 3], &flat(&body().shaped(&[0.5]).joints));
        // Looks along −z of the world from 4 in front of the body.
        let rows = [1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 4.0, 0.0, 0.0, 0.0, 1.0];
        let camera = Py::record([
            ("intrinsics", array(&[3, 3], &[8.0, 0.0, 3.0, 0.0, 8.0, 2.0, 0.0, 0.0, 1.0])),
            ("extrinsics", array(&[4, 4], &rows)),
            ("distortions", array(&[5], &[0.0; 5])),
        ]);
        let info = Py::record([
            ("Rh", array(&[3], &[0.0, 0.5, 0.0])),
            ("Th", array(&[3], &[0.125, 0.0, 0.0])),
            ("poses", array(&[6], &[0.0, 0.0, 0.0, 0.0, 0.25, 0.0])),
            ("betas", array(&[1], &[0.5])),
            ("tpose_joints", joints.clone()),
        ]);
        let all = |value: &Py| Py::Dict((0..3).map(|i| (format!("frame_{i:06}"), value.clone())).collect());
        let fixture = Self {
            dir: Directory::new(name),
            cameras: all(&camera),
            mesh_infos: all(&info),
            canonical: Py::record([("joints", joints), ("avg_betas", array(&[1], &[0.5]))]),
        };
        for frame in ["frame_000000", FRAME, "frame_000002"] {
            let kept_back = (frame != FRAME).then_some("eval/Camera_B2/");
            for below in ["", kept_back.unwrap_or_default()] {
                fixture.dir.picture(&format!("{below}images/{frame}.png"), SIZE, |_, _| 200);
                fixture.dir.stripe(&format!("{below}masks/{frame}.png"), SIZE, 255);
            }
        }
        fixture.write();
        fixture
    }

    /// Writes the pickles.
    fn write(&self) {
        for (name, value) in [("cameras", &self.cameras), ("mesh_infos", &self.mesh_infos)] {
            self.dir.write(&format!("{name}.pkl"), value.pickle());
            let mut kept_back = value.clone();
            kept_back.remove(&[FRAME]);
            self.dir.write(&format!("eval/Camera_B2/{name}.pkl"), kept_back.pickle());
        }
        self.dir.write("canonical_joints.pkl", self.canonical.pickle());
    }
}

/// Breaks a fresh capture.
#[track_caller]
fn broken(words: &[&str], breakage: impl FnOnce(&mut Fixture)) {
    let mut fixture = Fixture::new("humannerf-fails");
    breakage(&mut fixture);
    fails(&fixture.dir, words);
}

/// Breaks what the pickles hold.
#[track_caller]
fn holds(words: &[&str], breakage: impl FnOnce(&mut Fixture)) {
    broken(words, |fixture| {
        breakage(fixture);
        fixture.write();
    });
}

#[test]
fn a_whole_capture_is_read() {
    let fixture = Fixture::new("whole");
    let capture = load(&fixture.dir).unwrap();
    assert_eq!(capture.name, crate::pictures::file_name(fixture.dir.path()));
    assert_eq!(names(&capture.train), ["frame_000000", FRAME, "frame_000002"]);
    assert_eq!(capture.mean_betas, [0.5]);
    let (frame, pixels) = (&capture.train[1], capture.train[1].pixels().unwrap());
    assert_eq!((pixels.image.width, pixels.image.height, pixels.mask.len()), (6, 4, 24));
    assert_eq!(frame.pose, [Vec3::ZERO, Vec3::new(0.0, 0.25, 0.0)]);
    let (rotation, translation) = (Vec3::new(0.0, 0.5, 0.0), Vec3::new(0.125, 0.0, 0.0));
    assert_eq!(frame.placement, Placement::Origin { rotation, translation });
    assert_eq!((frame.betas.as_slice(), frame.camera.centre.x), (&[0.5][..], 3.0));
    assert!(pixels.occluder.is_none());
    assert_eq!(views(&capture), [("Camera_B2", 0), ("Camera_B2", 2)]);
    assert_eq!(capture.eval[1].frame.name, "frame_000002");
    // The pixel centre moves the principal point.
    let capture = load_with(&fixture.dir, LoadOptions { pixel_centre: 0.0, ..LoadOptions::default() }).unwrap();
    assert_eq!(capture.train[0].camera.centre, glam::Vec2::new(3.5, 2.5));
}

#[test]
fn stride_and_limits_keep_frames_and_their_views_together() {
    let fixture = Fixture::new("stride");
    // Frames 0 to 2; the camera kept back has 0 and 2.
    for (options, expected, kept) in [
        (LoadOptions { stride: 2, ..LoadOptions::default() }, &["frame_000000", "frame_000002"][..], &[0, 1][..]),
        (LoadOptions { max_frames: Some(2), ..LoadOptions::default() }, &["frame_000000", FRAME], &[0]),
        (LoadOptions { eval_stride: 3, max_frames: Some(1), ..LoadOptions::default() }, &["frame_000000"], &[0]),
    ] {
        let capture = load_with(&fixture.dir, options).unwrap();
        assert_eq!(names(&capture.train), expected);
        assert_eq!(capture.eval.iter().map(|e| e.train_index).collect::<Vec<_>>(), kept);
        assert!(capture.eval.iter().all(|e| e.frame.name == expected[e.train_index]));
    }
}

#[test]
fn a_hidden_subject_and_jpeg_frames_and_a_capture_without_eval_are_read() {
    let fixture = Fixture::new("jpeg");
    fixture.dir.stripe("masks/frame_000001.png", SIZE, 0);
    let path = fixture.dir.file("images/frame_000001.png");
    image::open(&path).unwrap().save(path.with_extension("jpg")).unwrap();
    std::fs::remove_file(path).unwrap();
    std::fs::remove_dir_all(fixture.dir.file("eval")).unwrap();
    let capture = load(&fixture.dir).unwrap();
    assert_eq!((capture.train.len(), capture.eval.len()), (3, 0));
}

#[test]
fn the_nearest_body_is_found() {
    let fixture = Fixture::new("find");
    let scene = fixture.dir.file("captures/scene");
    std::fs::create_dir_all(&scene).unwrap();
    // Not an archive: passed over.
    fixture.dir.write("body/a.npz", "no");
    let message = find_body(&scene).unwrap_err().to_string();
    assert!(message.contains("annots.npy") && message.contains("metadata.json"), "no capture: {message}");
    for layout in ["annots.npy", "metadata.json", "mesh_infos.pkl"] {
        std::fs::write(scene.join(layout), b"").unwrap();
        let found = find_body(&scene);
        assert!(found.is_ok_and(|path| !path.starts_with(fixture.dir.path())) || find_body(&scene).is_err());
        std::fs::write(scene.join("body.npz"), b"own").unwrap();
        assert_eq!(find_body(&scene).unwrap(), scene.join("body.npz"));
        std::fs::remove_file(scene.join("body.npz")).unwrap();
        std::fs::remove_file(scene.join(layout)).unwrap();
    }
}

#[test]
fn files_and_frames_that_are_missing_are_named() {
    for (file, words) in [
        ("cameras.pkl", &["cameras.pkl", "missing"][..]),
        ("mesh_infos.pkl", &["mesh_infos.pkl", "missing"]),
        ("canonical_joints.pkl", &["canonical_joints.pkl", "missing"]),
        ("images/frame_000001.png", &["images/frame_000001.png", "missing", "cameras.pkl"]),
        ("masks/frame_000002.png", &["masks/frame_000002.png", "missing", "cameras.pkl"]),
    ] {
        broken(words, |f| f.dir.remove(file));
    }
    broken(&["images"], |f| std::fs::remove_dir_all(f.dir.file("images")).unwrap());
    broken(&["missing directory"], |f| std::fs::remove_dir_all(f.dir.path()).unwrap());
    holds(&["mesh_infos.pkl", FRAME, "cameras.pkl", "no such key"], |f| f.mesh_infos.remove(&[FRAME]));
    holds(&["cameras.pkl", FRAME, "mesh_infos.pkl", "no such key"], |f| f.cameras.remove(&[FRAME]));
    broken(&["frame_000009.png", "cameras.pkl", "none"], |f| f.dir.write("images/frame_000009.png", ""));
    broken(&["eval/Camera_B2/cameras.pkl", "frame_000000", "training frame"], |f| {
        f.cameras.remove(&["frame_000000"]);
        f.mesh_infos.remove(&["frame_000000"]);
        f.dir.write("cameras.pkl", f.cameras.pickle());
        f.dir.write("mesh_infos.pkl", f.mesh_infos.pickle());
        f.dir.remove("images/frame_000000.png");
    });
}

#[test]
fn values_that_cannot_be() {
    let far = |x: f64| array(&[3], &[0.0, x, 0.0]);
    let cases: [(&str, Py, &[&str]); 9] = [
        ("Rh", Py::text("nothing"), &["an array", "str"]),
        ("Rh", array(&[1, 4], &[0.0; 4]), &["[3]", "[1, 4]"]),
        ("Rh", far(-1e30), &["1000"]),
        ("poses", array(&[6], &[f64::NAN; 6]), &["finite", "NaN"]),
        ("Th", far(f64::INFINITY), &["finite", "inf"]),
        ("Th", far(-1e38), &["10000000"]),
        ("poses", array(&[6], &[0.5; 6]), &["zero root"]),
        ("tpose_joints", array(&[24, 3], &[0.0; 72]), &["[2, 3]", "[24, 3]"]),
        ("tpose_joints", array(&[2, 3], &[0.0; 6]), &["joint 0", "body model"]),
    ];
    for (key, value, words) in cases {
        let full = format!("{FRAME}.{key}");
        holds(&[&["mesh_infos.pkl", &full], words].concat(), |f| *f.mesh_infos.at(&[FRAME, key]) = value);
    }
    holds(&["mesh_infos.pkl", FRAME, "dictionary", "numpy array"], |f| *f.mesh_infos.at(&[FRAME]) = far(0.0));
    holds(&["cameras.pkl", "extrinsics", "finite", "NaN"], |f| {
        *f.cameras.at(&[FRAME, "extrinsics"]) = array(&[4, 4], &[f64::NAN; 16]);
    });
    holds(&["frame_000001.Rh", "no such key", "Th, poses"], |f| f.mesh_infos.remove(&[FRAME, "Rh"]));
    holds(&["canonical_joints.pkl", "avg_betas"], |f| *f.canonical.at(&["avg_betas"]) = array(&[0], &[]));
    holds(&["canonical_joints.pkl", "joints", "body model"], |f| {
        *f.canonical.at(&["joints"]) = array(&[2, 3], &[0.0; 6]);
    });
    holds(&["cameras.pkl", "frame_000001.intrinsics", "pinhole"], |f| {
        *f.cameras.at(&[FRAME, "intrinsics"]) = array(&[3, 3], &[0.0; 9]);
    });
}

/// Its views would be passed over in silence.
#[cfg(unix)]
#[test]
fn links_that_lead_nowhere_or_in_a_circle_are_named() {
    for target in ["nowhere", "eval"] {
        broken(&["eval"], |f| {
            std::fs::remove_dir_all(f.dir.file("eval")).unwrap();
            std::os::unix::fs::symlink(target, f.dir.file("eval")).unwrap();
        });
    }
    broken(&["eval/Camera_B9"], |f| std::os::unix::fs::symlink("nowhere", f.dir.file("eval/Camera_B9")).unwrap());
}

#[test]
fn broken_pickles() {
    let whole = Fixture::new("whole-pickle").mesh_infos.pickle();
    for keep in [0, 1, 3, whole.len() / 2, whole.len() - 1] {
        broken(&["mesh_infos.pkl", "pickle"], |f| f.dir.write("mesh_infos.pkl", &whole[..keep]));
    }
    broken(&["cameras.pkl", "dictionary", "str"], |f| f.dir.write("cameras.pkl", Py::text("x").pickle()));
    holds(&["cameras.pkl", "empty"], |f| (f.cameras, f.mesh_infos) = (Py::Dict(vec![]), Py::Dict(vec![])));
    broken(&["cameras.pkl", "os"], |f| f.dir.write("cameras.pkl", b"cos\nsystem\n(X\x02\0\0\0lstR."));
}
