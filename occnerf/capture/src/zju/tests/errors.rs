//! Every fault of a capture is one line that names the file, the key, what was expected and what
//! was found.

use super::fixture::{Fixture, SIZE};
use crate::testing::{Py, array, body, damaged};
use crate::{LoadOptions, load_capture};

/// Breaks a fresh capture, writes its pickles, and checks that the message holds all of `words` and
/// is one line.
#[track_caller]
fn fails(name: &str, words: &[&str], breakage: impl FnOnce(&mut Fixture)) {
    let mut fixture = Fixture::new(&format!("zju-{name}"));
    breakage(&mut fixture);
    let message = load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).expect_err(name).to_string();
    assert!(!message.contains('\n') && message.len() < 600, "{message}");
    for word in words {
        assert!(message.contains(word), "`{word}` is not in: {message}");
    }
}

fn annots(keys: &'static [&'static str], value: Py) -> impl FnOnce(&mut Fixture) {
    move |f| {
        *f.annots.at(keys) = value;
        f.write();
    }
}

fn params(key: &'static str, value: Py) -> impl FnOnce(&mut Fixture) {
    move |f| {
        *f.params.at(&[key]) = value;
        f.dir.write("new_params/1.npy", f.params.npy());
    }
}

#[test]
fn missing_files() {
    fails("no-annots", &["annots.npy", "format", "none of them"], |f| f.dir.remove("annots.npy"));
    fails("no-picture", &["Camera_B1/000001.png"], |f| f.dir.remove("Camera_B1/000001.png"));
    fails("no-mask", &["mask_cihp/Camera_B1/000001.png", "missing mask", "mask/"], |f| {
        f.dir.remove("mask_cihp/Camera_B1/000001.png");
        f.dir.remove("mask/Camera_B1/000001.png");
    });
    for i in 0..3 {
        fails("no-params", &[&format!("new_params/{i}.npy"), "missing", "annots.npy", &format!("ims[{i}]")], |f| {
            f.dir.remove(&format!("new_params/{i}.npy"));
        });
    }
}

#[test]
fn broken_pickles() {
    let whole = Fixture::new("zju-whole-pickle").annots.npy();
    for keep in [0, 5, 20, 130, whole.len() / 2, whole.len() - 1] {
        fails("truncated", &["annots.npy"], |f| f.dir.write("annots.npy", &whole[..keep]));
    }
    fails("params-global", &["new_params/2.npy", "builtins eval", "not allowed"], |f| {
        f.dir.write("new_params/2.npy", b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93\x8c\x011\x85R.");
    });
    fails("array", &["annots.npy", "dictionary", "numpy array"], |f| {
        f.dir.write("annots.npy", array(&[1], &[0.0]).npy());
    });
    // A list that holds itself.
    fails("cycle", &["annots.npy", "nested deeper"], |f| {
        f.dir.write("annots.npy", b"\x80\x02}X\x03\0\0\0ims]q\0h\0as.")
    });
}

#[test]
fn no_damage_to_a_pickle_is_a_panic() {
    let fixture = Fixture::new("zju-damaged");
    for (file, whole) in [("annots.npy", fixture.annots.npy()), ("new_params/1.npy", fixture.params.npy())] {
        let mut refused = 0;
        for bytes in damaged(&whole, 300) {
            fixture.dir.write(file, bytes);
            refused += usize::from(load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).is_err());
        }
        fixture.dir.write(file, whole);
        assert!((75..300).contains(&refused), "{file}: {refused} of 300 refused");
    }
}

#[test]
fn cameras_of_the_wrong_shape_or_kind() {
    let seven = array(&[7], &[0.0; 7]);
    fails("k", &["annots.npy", "cams.K", "shape [7] after [3, 3]"], annots(&["cams", "K", "1"], seven.clone()));
    fails("k-all", &["cams.K", "[C, 3, 3]", "[2, 7]"], annots(&["cams", "K"], Py::List(vec![seven.clone(), seven])));
    fails("no-r", &["annots.npy", "cams.R", "no such key", "K, T, D"], |f| {
        f.annots.remove(&["cams", "R"]);
        f.write();
    });
    let one = Py::List(vec![array(&[3, 1], &[0.0; 3])]);
    fails("t-count", &["cams.T", "[3]", "2 cameras", "[1, 3, 1]"], annots(&["cams", "T"], one));
    fails("text", &["cams.K", "an array", "str"], annots(&["cams", "K"], Py::text("none")));
    fails("cams", &["annots.npy", "cams", "dictionary", "str"], annots(&["cams"], Py::text("none")));
    fails("r", &["cams.R[1]", "a rotation"], annots(&["cams", "R", "1"], array(&[3, 3], &[0.5; 9])));
    fails("k-focal", &["cams.K[0]", "pinhole"], annots(&["cams", "K", "0"], array(&[3, 3], &[0.0; 9])));
    fails("t-nan", &["cams.T", "not finite", "4"], annots(&["cams", "T", "1"], array(&[3, 1], &[0.0, f64::NAN, 0.0])));
    fails("empty", &["cams.K"], annots(&["cams", "K"], Py::List(Vec::new())));
    fails("away", &["annots.npy", "sees the posed body", "3 frames"], |f| {
        *f.annots.at(&["cams", "T", "0"]) = array(&[3, 1], &[0.0, 0.0, -40_000.0]);
        f.write();
    });
}

#[test]
fn frames_that_name_the_wrong_pictures() {
    let list = |paths: &[&str]| Py::List(paths.iter().map(|p| Py::text(p)).collect());
    let three = list(&["Camera_B1/000001.png", "Camera_B2/000001.png", "Camera_B3/000001.png"]);
    fails("beyond", &["annots.npy", "ims", "2 pictures", "up to 3"], annots(&["ims", "1", "ims"], three));
    let other = list(&["Camera_B7/000001.png"]);
    fails("unknown", &["ims[1].ims", "Camera_B1, Camera_B2", "Camera_B7"], annots(&["ims", "1", "ims"], other));
    let twice = list(&["Camera_B1/000001.png", "Camera_B1/000000.png"]);
    fails("twice", &["ims[1].ims", "one picture a camera"], annots(&["ims", "1", "ims"], twice));
    let same = list(&["Camera_B1/000000.png", "Camera_B1/000001.png"]);
    fails("same", &["ims", "a folder for each camera", "Camera_B1"], annots(&["ims", "0", "ims"], same));
    for path in ["../outside/1.png", "/etc/passwd", ""] {
        fails("outside", &["ims[1].ims", "below the capture"], annots(&["ims", "1", "ims"], list(&[path])));
    }
    fails("number", &["ims[2].ims", "a list of pictures"], annots(&["ims", "2"], Py::record([])));
    fails("no-ims", &["annots.npy", "ims", "a list of frames", "str"], annots(&["ims"], Py::text("none")));
    fails("no-frames", &["annots.npy", "ims", "empty"], annots(&["ims"], Py::List(Vec::new())));
    let few = list(&["Camera_B1/000000.png"]);
    fails("never-all", &["annots.npy", "ims", "all cameras see"], |f| {
        for i in ["0", "1", "2"] {
            *f.annots.at(&["ims", i, "ims"]) = few.clone();
        }
        f.write();
    });
}

#[test]
fn pictures_of_the_wrong_size_or_without_a_subject() {
    let (w, h) = SIZE;
    fails("mask-size", &["mask_cihp/Camera_B1/000001.png", "size", "12×8", "12×9"], |f| {
        f.dir.picture("mask_cihp/Camera_B1/000001.png", (w, h + 1), |_, _| 1);
    });
    fails("masks", &["mask_cihp/Camera_B1", "subject pixel", "3 frames", "largest value is 0"], |f| {
        for i in 0..3 {
            f.masks(&format!("Camera_B1/{i:06}"), false);
        }
    });
}

#[test]
fn body_parameters_that_cannot_be() {
    fails("root", &["new_params/1.npy", "poses", "zero root"], params("poses", array(&[1, 6], &[0.5; 6])));
    fails("shapes", &["new_params/1.npy", "shapes", "1 to 1", "[10]"], params("shapes", array(&[1, 10], &[0.0; 10])));
    fails("rh", &["new_params/1.npy", "Rh", "[3]", "[4]"], params("Rh", array(&[1, 4], &[0.0; 4])));
    fails("no-th", &["new_params/1.npy", "Th", "no such key"], |f| {
        f.params.remove(&["Th"]);
        f.dir.write("new_params/1.npy", f.params.npy());
    });
}

#[test]
fn vertices_tell_another_body_or_another_numbering() {
    let fixture = Fixture::new("zju-vertices");
    fixture.vertices(1, 0.001);
    assert!(load_capture(fixture.dir.path(), &body(), &LoadOptions::default()).is_ok(), "rounding of a fit");
    fails("vertices", &["new_vertices/1.npy", "vertices", "vertex 0", "numbered"], |f| f.vertices(1, 0.02));
    fails("vertex-count", &["new_vertices/1.npy", "[8, 3]", "[1, 3]"], |f| {
        f.dir.write("new_vertices/1.npy", crate::testing::points_npy(&[glam::Vec3::ZERO]));
    });
}

#[test]
fn occlusion_files_that_cannot_be() {
    fails("rect", &["occlusion.json", "rect", "x1", "4 0 13 8"], |f| {
        f.occlusion("Camera_B1", [12, 8], [4, 0, 13, 8], &[])
    });
    fails("rect-order", &["occlusion.json", "rect"], |f| f.occlusion("Camera_B1", [12, 8], [5, 0, 4, 8], &[]));
    fails("size", &["occlusion.json", "image_size", "[12, 8]", "[8, 12]"], |f| {
        f.occlusion("Camera_B1", [8, 12], [0, 0, 1, 1], &[]);
    });
    fails("frames", &["occlusion.json", "frames", "below 3", "80"], |f| {
        f.occlusion("Camera_B1", [12, 8], [0, 0, 1, 1], &[0, 80]);
    });
    fails("json", &["occlusion.json", "rect"], |f| f.dir.write("occlusion.json", "{\"camera\": 3}"));
    fails("all-hidden", &["mask_cihp/Camera_B1", "subject pixel"], |f| {
        f.occlusion("Camera_B1", [12, 8], [0, 0, 12, 8], &[0, 1, 2]);
    });
}
