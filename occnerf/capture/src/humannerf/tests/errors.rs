//! Every fault of a capture is one line that names the file, the key, what was expected and what
//! was found. What layouts share is tested with the wild one.

use super::fixture::{Fixture, extrinsics};
use crate::testing::{Py, array, body};
use crate::{LoadOptions, load_capture};

/// Breaks a fresh capture, writes its pickles, and checks that the message holds all of `words` and
/// is one line.
#[track_caller]
fn fails(words: &[&str], breakage: impl FnOnce(&mut Fixture)) {
    let mut fixture = Fixture::new("humannerf-fails");
    breakage(&mut fixture);
    let message = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).expect_err(words[0]).to_string();
    assert!(!message.contains('\n'), "{message}");
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
}

/// Breaks what the pickles hold.
#[track_caller]
fn holds(words: &[&str], breakage: impl FnOnce(&mut Fixture)) {
    fails(words, |fixture| {
        breakage(fixture);
        fixture.write();
    });
}

const FRAME: &str = "frame_000001";

#[test]
fn missing_files() {
    for file in ["cameras.pkl", "mesh_infos.pkl", "canonical_joints.pkl"] {
        fails(&[file, "missing"], |f| f.dir.remove(file));
    }
    for picture in ["images/frame_000001.png", "masks/frame_000002.png"] {
        fails(&[picture, "missing", "cameras.pkl"], |f| f.dir.remove(picture));
    }
    fails(&["images"], |f| std::fs::remove_dir_all(f.dir.file("images")).unwrap());
    fails(&["missing directory"], |f| std::fs::remove_dir_all(f.dir.path()).unwrap());
}

#[test]
fn frames_known_to_one_file_only() {
    holds(&["mesh_infos.pkl", FRAME, "cameras.pkl", "no such key"], |f| f.mesh_infos.remove(&[FRAME]));
    holds(&["cameras.pkl", FRAME, "mesh_infos.pkl", "no such key"], |f| f.cameras.remove(&[FRAME]));
    fails(&["frame_000009.png", "cameras.pkl", "none"], |f| f.dir.write("images/frame_000009.png", ""));
    fails(&["eval/Camera_B2/cameras.pkl", "frame_000000", "training frame"], |f| {
        f.cameras.remove(&["frame_000000"]);
        f.mesh_infos.remove(&["frame_000000"]);
        f.dir.write("cameras.pkl", f.cameras.pickle());
        f.dir.write("mesh_infos.pkl", f.mesh_infos.pickle());
        f.dir.remove("images/frame_000000.png");
    });
}

#[test]
fn values_that_cannot_be() {
    let pose = |x: f64| array(&[6], &[0.0, 0.0, 0.0, 0.0, x, 0.0]);
    let far = |x: f64| array(&[3], &[0.0, x, 0.0]);
    let cases: [(&str, Py, &[&str]); 11] = [
        ("Rh", Py::text("nothing"), &["an array", "str"]),
        ("Rh", far(-1e30), &["1000"]),
        ("Th", far(f64::INFINITY), &["not finite"]),
        ("Th", far(-1e38), &["10000000"]),
        ("poses", pose(f64::NAN), &["not finite", "4"]),
        ("poses", pose(1e30), &["1000"]),
        ("poses", array(&[6], &[0.5; 6]), &["zero root"]),
        ("betas", array(&[10], &[0.0; 10]), &["1 to 1", "[10]"]),
        ("betas", array(&[1], &[1e30]), &["1000"]),
        ("tpose_joints", array(&[24, 3], &[0.0; 72]), &["[2, 3]", "[24, 3]", "body model"]),
        ("tpose_joints", array(&[2, 3], &[0.0; 6]), &["joint 0", "body model"]),
    ];
    for (key, value, words) in cases {
        let full = format!("{FRAME}.{key}");
        holds(&[&["mesh_infos.pkl", &full], words].concat(), |f| *f.mesh_infos.at(&[FRAME, key]) = value);
    }
    holds(&["mesh_infos.pkl", FRAME, "dictionary", "numpy array"], |f| *f.mesh_infos.at(&[FRAME]) = pose(0.0));
    holds(&["frame_000001.Rh", "no such key", "Th, poses"], |f| f.mesh_infos.remove(&[FRAME, "Rh"]));
    holds(&["canonical_joints.pkl", "avg_betas"], |f| *f.canonical.at(&["avg_betas"]) = array(&[0], &[]));
    holds(&["canonical_joints.pkl", "joints", "body model"], |f| {
        *f.canonical.at(&["joints"]) = array(&[2, 3], &[0.0; 6]);
    });
}

#[test]
fn cameras_that_cannot_be() {
    let lens = |f: f64, c: f64| array(&[3, 3], &[f, 0.0, c, 0.0, f, 2.0, 0.0, 0.0, 1.0]);
    let cases: [(&str, Py, &[&str]); 7] = [
        ("extrinsics", array(&[4, 4], &[f64::NAN; 16]), &["not finite"]),
        ("extrinsics", extrinsics([1.0, 1.0, -1.0], 4.0), &["rotation"]),
        ("extrinsics", extrinsics([1.1, -1.1, -1.1], 4.0), &["rotation"]),
        ("intrinsics", lens(-8.0, 3.0), &["pinhole"]),
        ("intrinsics", lens(1e-30, 3.0), &["pinhole", "10000000"]),
        ("intrinsics", lens(1e30, 3.0), &["pinhole", "10000000"]),
        ("intrinsics", lens(8.0, -1e30), &["pinhole", "10000000"]),
    ];
    for (key, value, words) in cases {
        let full = format!("{FRAME}.{key}");
        holds(&[&["cameras.pkl", &full], words].concat(), |f| *f.cameras.at(&[FRAME, key]) = value);
    }
    // Behind the camera in one frame only: not an error.
    let mut fixture = Fixture::new("once-blind");
    *fixture.cameras.at(&[FRAME, "extrinsics"]) = extrinsics([1.0, -1.0, -1.0], -40.0);
    fixture.write();
    assert!(load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).is_ok());
}

/// Its views would be passed over in silence.
#[cfg(unix)]
#[test]
fn links_that_lead_nowhere_or_in_a_circle_are_named() {
    for target in ["nowhere", "eval"] {
        fails(&["eval"], |f| {
            std::fs::remove_dir_all(f.dir.file("eval")).unwrap();
            std::os::unix::fs::symlink(target, f.dir.file("eval")).unwrap();
        });
    }
    fails(&["eval/Camera_B9"], |f| std::os::unix::fs::symlink("nowhere", f.dir.file("eval/Camera_B9")).unwrap());
}

#[test]
fn broken_pickles() {
    let whole = Fixture::new("whole-pickle").mesh_infos.pickle();
    for keep in [0, 1, 3, whole.len() / 2, whole.len() - 1] {
        fails(&["mesh_infos.pkl", "pickle"], |f| f.dir.write("mesh_infos.pkl", &whole[..keep]));
    }
    fails(&["cameras.pkl", "dictionary", "str"], |f| f.dir.write("cameras.pkl", Py::text("x").pickle()));
    holds(&["cameras.pkl", "empty"], |f| (f.cameras, f.mesh_infos) = (Py::Dict(vec![]), Py::Dict(vec![])));
    fails(&["cameras.pkl", "os"], |f| f.dir.write("cameras.pkl", b"cos\nsystem\n(X\x02\0\0\0lstR."));
}
