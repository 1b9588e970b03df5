//! Every fault of a capture is one line that names the file, the key, what was expected and what
//! was found.

use super::fixture::Fixture;
use crate::testing::{Py, array, body};
use crate::{LoadOptions, load_capture};

/// Breaks a fresh capture and checks that the message holds all of `words` and is one line.
#[track_caller]
fn fails(name: &str, words: &[&str], breakage: impl FnOnce(&mut Fixture)) {
    let mut fixture = Fixture::new(name);
    breakage(&mut fixture);
    let message = load_capture(&fixture.dir, &body(), &LoadOptions::default()).expect_err(name).to_string();
    assert!(!message.contains('\n'), "{message}");
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
}

/// Sets a value of one of the pickles and writes them.
fn cameras(keys: &[&str], value: Py) -> impl FnOnce(&mut Fixture) {
    let keys: Vec<String> = keys.iter().map(|k| (*k).to_owned()).collect();
    move |f| {
        f.cameras.set(&keys.iter().map(String::as_str).collect::<Vec<_>>(), value);
        f.write();
    }
}

fn infos(keys: &[&str], value: Py) -> impl FnOnce(&mut Fixture) {
    let keys: Vec<String> = keys.iter().map(|k| (*k).to_owned()).collect();
    move |f| {
        f.mesh_infos.set(&keys.iter().map(String::as_str).collect::<Vec<_>>(), value);
        f.write();
    }
}

const FRAME: &str = "frame_000001";

#[test]
fn missing_files() {
    for file in ["cameras.pkl", "mesh_infos.pkl", "canonical_joints.pkl"] {
        fails("no-file", &[file, "missing"], |f| {
            std::fs::remove_file(f.dir.join(file)).unwrap();
        });
    }
    for picture in ["images/frame_000001.png", "masks/frame_000002.png"] {
        fails("no-picture", &[picture, "missing", "cameras.pkl"], |f| {
            std::fs::remove_file(f.dir.join(picture)).unwrap();
        });
    }
    fails("no-images", &["images"], |f| std::fs::remove_dir_all(f.dir.join("images")).unwrap());
    fails("no-dir", &["missing directory"], |f| std::fs::remove_dir_all(&f.dir).unwrap());
}

#[test]
fn frames_known_to_one_file_only() {
    fails("no-info", &["mesh_infos.pkl", FRAME, "cameras.pkl", "no such key"], |f| {
        f.mesh_infos.remove(&[FRAME]);
        f.write();
    });
    fails("no-camera", &["cameras.pkl", FRAME, "mesh_infos.pkl", "no such key"], |f| {
        f.cameras.remove(&[FRAME]);
        f.write();
    });
    fails("extra-image", &["frame_000009.png", "cameras.pkl", "none"], |f| {
        let images = f.dir.join("images");
        std::fs::copy(images.join("frame_000001.png"), images.join("frame_000009.png")).unwrap();
    });
    fails("eval-only", &["eval/Camera_B2/cameras.pkl", "frame_000000", "training frame"], |f| {
        f.cameras.remove(&["frame_000000"]);
        f.mesh_infos.remove(&["frame_000000"]);
        for (file, value) in [("cameras.pkl", &f.cameras), ("mesh_infos.pkl", &f.mesh_infos)] {
            std::fs::write(f.dir.join(file), value.pickle()).unwrap();
        }
        std::fs::remove_file(f.dir.join("images/frame_000000.png")).unwrap();
    });
}

#[test]
fn pictures_of_the_wrong_size() {
    fails("mask-size", &["masks/frame_000001.png", "size", "6×4", "8×4"], |f| {
        f.mask("masks/frame_000001.png", 8, 4, 255);
    });
    fails("image-size", &["images/frame_000002.png", "size", "6×4", "7×5", "frame_000000"], |f| {
        f.mask("images/frame_000002.png", 7, 5, 255);
        f.mask("masks/frame_000002.png", 7, 5, 255);
    });
    fails("empty-picture", &["images/frame_000001.png"], |f| {
        std::fs::write(f.dir.join("images/frame_000001.png"), b"").unwrap();
    });
}

#[test]
fn masks_without_a_subject() {
    // Labels 0 and 1 in place of 0 and 255 are the likely cause: the largest value is told.
    fails("masks", &["masks", "subject pixel", "3 frames", "largest value is 1"], |f| {
        for i in 0..3 {
            f.mask(format!("masks/frame_{i:06}.png"), 6, 4, 1);
        }
    });
}

#[test]
fn values_that_are_not_finite() {
    let mut pose = [0.0; 6];
    pose[4] = f64::NAN;
    fails(
        "nan-pose",
        &["mesh_infos.pkl", "frame_000001.poses", "not finite", "4"],
        infos(&[FRAME, "poses"], array(&[6], &pose)),
    );
    fails("inf-th", &["frame_000001.Th", "not finite"], infos(&[FRAME, "Th"], array(&[3], &[0.0, f64::INFINITY, 0.0])));
    fails(
        "nan-e",
        &["cameras.pkl", "frame_000001.extrinsics", "not finite"],
        cameras(&[FRAME, "extrinsics"], array(&[4, 4], &[f64::NAN; 16])),
    );
}

#[test]
fn values_of_the_wrong_shape_or_type() {
    for (key, shape, expected) in
        [("intrinsics", [3u32, 4], "[3, 3]"), ("extrinsics", [3, 3], "[4, 4]"), ("distortions", [2, 2], "5 numbers")]
    {
        let values = vec![1.0; (shape[0] * shape[1]) as usize];
        let full = format!("{FRAME}.{key}");
        fails("k-shape", &["cameras.pkl", &full, expected], cameras(&[FRAME, key], array(&shape, &values)));
    }
    fails(
        "poses",
        &["frame_000001.poses", "[6]", "[72]", "2 joints"],
        infos(&[FRAME, "poses"], array(&[72], &[0.0; 72])),
    );
    fails("betas", &["frame_000001.betas", "1 to 1", "[10]"], infos(&[FRAME, "betas"], array(&[10], &[0.0; 10])));
    fails("text", &["frame_000001.Rh", "an array", "str"], infos(&[FRAME, "Rh"], Py::text("nothing")));
    fails("record", &["mesh_infos.pkl", FRAME, "dictionary", "numpy array"], infos(&[FRAME], array(&[1], &[0.0])));
    fails("no-key", &["frame_000001.Rh", "no such key", "Th, poses"], |f| {
        f.mesh_infos.remove(&[FRAME, "Rh"]);
        f.write();
    });
    fails("root", &["frame_000001.poses", "zero root"], infos(&[FRAME, "poses"], array(&[6], &[0.5; 6])));
    fails("betas-mean", &["canonical_joints.pkl", "avg_betas"], |f| {
        f.canonical.set(&["avg_betas"], array(&[0], &[]));
        f.write();
    });
}

#[test]
fn a_body_model_that_is_not_the_captures() {
    fails(
        "joint-count",
        &["frame_000001.tpose_joints", "[2, 3]", "[24, 3]", "body model"],
        infos(&[FRAME, "tpose_joints"], array(&[24, 3], &[0.0; 72])),
    );
    fails("joints-off", &["frame_000001.tpose_joints", "joint 1", "body model"], |f| {
        let mut joints: Vec<f64> =
            body().shaped(&[0.5]).joints.iter().flat_map(|j| j.to_array()).map(f64::from).collect();
        joints[4] += 0.1;
        f.mesh_infos.set(&[FRAME, "tpose_joints"], array(&[2, 3], &joints));
        f.write();
    });
    fails("canonical-off", &["canonical_joints.pkl", "joints", "body model"], |f| {
        f.canonical.set(&["joints"], array(&[2, 3], &[0.0; 6]));
        f.write();
    });
}

#[test]
fn cameras_that_cannot_be() {
    let matrix = |diagonal: [f64; 3], z: f64| {
        let [a, b, c] = diagonal;
        array(&[4, 4], &[a, 0.0, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, 0.0, c, z, 0.0, 0.0, 0.0, 1.0])
    };
    let everywhere = |value: Py| {
        move |f: &mut Fixture| {
            for i in 0..3 {
                f.cameras.set(&[&format!("frame_{i:06}"), "extrinsics"], value.clone());
            }
            f.write();
        }
    };
    // Behind the camera in all frames.
    fails("blind", &["cameras.pkl", "sees the posed body", "3 frames"], everywhere(matrix([1.0, -1.0, -1.0], -40.0)));
    // In one frame only: not an error.
    let mut fixture = Fixture::new("once-blind");
    fixture.cameras.set(&[FRAME, "extrinsics"], matrix([1.0, -1.0, -1.0], -40.0));
    fixture.write();
    assert!(load_capture(&fixture.dir, &body(), &LoadOptions::default()).is_ok());

    fails("mirror", &["frame_000000.extrinsics", "rotation"], everywhere(matrix([1.0, 1.0, -1.0], 4.0)));
    fails("scaled", &["frame_000000.extrinsics", "rotation"], everywhere(matrix([1.1, -1.1, -1.1], 4.0)));
    let k = [-8.0, 0.0, 3.0, 0.0, 8.0, 2.0, 0.0, 0.0, 1.0];
    fails("focal", &["frame_000001.intrinsics", "pinhole"], cameras(&[FRAME, "intrinsics"], array(&[3, 3], &k)));
}

#[test]
fn numbers_that_nothing_in_the_world_has() {
    let pose = |x: f64| array(&[6], &[0.0, 0.0, 0.0, 0.0, x, 0.0]);
    fails("wild-pose", &["frame_000001.poses", "1000"], infos(&[FRAME, "poses"], pose(1e30)));
    fails("wild-turn", &["frame_000001.Rh", "1000"], infos(&[FRAME, "Rh"], array(&[3], &[0.0, -1e30, 0.0])));
    fails("far", &["frame_000001.Th", "10000000"], infos(&[FRAME, "Th"], array(&[3], &[0.0, 0.0, -1e38])));
    fails("wild-shape", &["frame_000001.betas", "1000"], infos(&[FRAME, "betas"], array(&[1], &[1e30])));
    let lens = |f: f64, c: f64| array(&[3, 3], &[f, 0.0, c, 0.0, f, 2.0, 0.0, 0.0, 1.0]);
    for (f, c) in [(1e-30, 3.0), (1e30, 3.0), (8.0, -1e30)] {
        fails("wild-lens", &["frame_000001.intrinsics", "pinhole", "10000000"], |fixture| {
            fixture.cameras.set(&[FRAME, "intrinsics"], lens(f, c));
            fixture.write();
        });
    }
}

/// Its views would be passed over in silence.
#[cfg(unix)]
#[test]
fn links_that_lead_nowhere_or_in_a_circle_are_named() {
    for target in ["nowhere", "eval"] {
        fails("link", &["eval"], |f| {
            std::fs::remove_dir_all(f.dir.join("eval")).unwrap();
            std::os::unix::fs::symlink(target, f.dir.join("eval")).unwrap();
        });
    }
    fails("camera-link", &["eval/Camera_B9"], |f| {
        std::os::unix::fs::symlink("nowhere", f.dir.join("eval/Camera_B9")).unwrap();
    });
}

#[test]
fn broken_pickles() {
    let whole = Fixture::new("truncated-whole").mesh_infos.pickle();
    for keep in [0, 1, 3, whole.len() / 2, whole.len() - 1] {
        fails("truncated", &["mesh_infos.pkl", "pickle"], |f| {
            std::fs::write(f.dir.join("mesh_infos.pkl"), &whole[..keep]).unwrap();
        });
    }
    fails("list", &["cameras.pkl", "dictionary", "str"], |f| {
        std::fs::write(f.dir.join("cameras.pkl"), Py::text("x").pickle()).unwrap();
    });
    fails("empty", &["cameras.pkl", "empty"], |f| {
        f.cameras = Py::Dict(vec![]);
        f.mesh_infos = Py::Dict(vec![]);
        f.write();
    });
    fails("global", &["cameras.pkl", "os"], |f| {
        std::fs::write(f.dir.join("cameras.pkl"), b"cos\nsystem\n(X\x02\0\0\0lstR.").unwrap();
    });
}

#[test]
fn settings_that_cannot_be() {
    let fixture = Fixture::new("setting");
    let options = LoadOptions { pixel_centre: f32::NAN, ..LoadOptions::default() };
    let message = load_capture(&fixture.dir, &body(), &options).unwrap_err().to_string();
    assert!(message.contains("pixel_centre"), "{message}");
}
