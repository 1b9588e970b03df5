//! A tiny capture of two cameras and three instants on disk, whole and with every fault, which is
//! told in one line that names the file, the key, what was expected and what was found; and the
//! shared capture, against its prepared twin.

use glam::{DVec3, Vec2, Vec3};
use smpl::{BodyModel, Placement};
use volrender::Distortion;

use crate::testing::{
    Directory, Py, array, body, damaged, fails, load, load_with, names, overlap, points_npy, shared, views,
};
use crate::{Frame, LoadOptions, find_body, load_capture};

const SIZE: (u32, u32) = (12, 8);

struct Fixture {
    dir: Directory,
    annots: Py,
    params: Py,
}

fn list(paths: &[&str]) -> Py {
    Py::List(paths.iter().map(|p| Py::text(p)).collect())
}

impl Fixture {
    fn new(name: &str) -> Self {
        let both = |shape: &[u32], values: &[f64]| Py::List(vec![array(shape, values), array(shape, values)]);
        let cams = Py::record([
            ("K", both(&[3, 3], &[16.0, 0.0, 6.0, 0.0, 16.0, 4.0, 0.0, 0.0, 1.0])),
            ("R", both(&[3, 3], &[1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0])),
            ("T", both(&[3, 1], &[0.0, 0.0, 4000.0])),
            ("D", both(&[5, 1], &[0.0; 5])),
        ]);
        let instants = [
            &["Camera_B1/000000.png", "Camera_B2/000000.png"][..],
            &["Camera_B1/000001.png"],
            &["Camera_B1/000002.png", "Camera_B2/000002.png"],
        ];
        let ims = Py::List(instants.map(|paths| Py::record([("ims", list(paths))])).into());
        let params = Py::record([
            ("Rh", array(&[1, 3], &[0.0, 0.5, 0.0])),
            ("Th", array(&[1, 3], &[0.125, 0.0, 0.0])),
            ("poses", array(&[1, 6], &[0.0, 0.0, 0.0, 0.0, 0.25, 0.0])),
            ("shapes", array(&[1, 1], &[0.5])),
        ]);
        let fixture = Self { dir: Directory::new(name), annots: Py::record([("cams", cams), ("ims", ims)]), params };
        for picture in ["Camera_B1/000000", "Camera_B1/000001", "Camera_B1/000002", "Camera_B2/000000"] {
            fixture.dir.picture(&format!("{picture}.png"), SIZE, |_, _| 200);
            fixture.masks(picture, true);
        }
        fixture.masks("Camera_B2/000002", true);
        fixture.write();
        fixture
    }

    /// Masks that show columns 4 to 7 between them: labels 1 and 2 on 4 to 6 in one, 1 on 7 in the
    /// other.
    fn masks(&self, picture: &str, shown: bool) {
        let shown = u8::from(shown);
        let labels = |x, _| shown * [0, 0, 0, 0, 1, 2, 1, 0, 0, 0, 0, 0][x as usize];
        self.dir.picture(&format!("mask_cihp/{picture}.png"), SIZE, labels);
        self.dir.picture(&format!("mask/{picture}.png"), SIZE, |x, _| shown * u8::from(x == 7));
    }

    /// Writes the pickles.
    fn write(&self) {
        self.dir.write("annots.npy", self.annots.npy());
        (0..3).for_each(|i| self.dir.write(&format!("new_params/{i}.npy"), self.params.npy()));
    }

    /// Writes the vertices of an instant, all moved by `offset`.
    fn vertices(&self, instant: usize, offset: f32) {
        let (rotation, translation) = (Vec3::new(0.0, 0.5, 0.0), Vec3::new(0.125 + offset, 0.0, 0.0));
        let pose = [Vec3::ZERO, Vec3::new(0.0, 0.25, 0.0)];
        let posed = body().pose(&body().shaped(&[0.5]), &pose, Placement::Origin { rotation, translation });
        self.dir.write(&format!("new_vertices/{instant}.npy"), points_npy(&posed.vertices));
    }

    fn occlusion(&self, camera: &str, size: [u32; 2], [x0, y0, x1, y1]: [u32; 4], frames: &[usize]) {
        let rect = serde_json::json!({"x0": x0, "y0": y0, "x1": x1, "y1": y1});
        let file = serde_json::json!({"camera": camera, "image_size": size, "rect": rect, "frames": frames, "mid": 1});
        self.dir.write("occlusion.json", file.to_string());
    }
}

/// Breaks a fresh capture.
#[track_caller]
fn broken(words: &[&str], breakage: impl FnOnce(&mut Fixture)) {
    let mut fixture = Fixture::new("zju-fails");
    breakage(&mut fixture);
    fails(&fixture.dir, words);
}

#[test]
fn a_whole_capture_is_read() {
    let fixture = Fixture::new("zju-whole");
    let capture = load(&fixture.dir).unwrap();
    assert_eq!(names(&capture.train), ["frame_000000", "frame_000001", "frame_000002"]);
    assert_eq!(capture.mean_betas, [0.5]);
    let (frame, pixels) = (&capture.train[1], capture.train[1].pixels().unwrap());
    assert_eq!(frame.pose, [Vec3::ZERO, Vec3::new(0.0, 0.25, 0.0)]);
    let (rotation, translation) = (Vec3::new(0.0, 0.5, 0.0), Vec3::new(0.125, 0.0, 0.0));
    assert_eq!(frame.placement, Placement::Origin { rotation, translation });
    assert_eq!(frame.camera.world_to_camera.translation, Vec3::new(0.0, 0.0, 4.0).into(), "millimetres");
    assert_eq!((frame.camera.width, frame.camera.height), SIZE);
    // Labels 1 and 2 of one mask and the other mask are all the subject.
    let subject: Vec<usize> = (0..SIZE.0 as usize).filter(|&x| pixels.mask[x] > 0.5).collect();
    assert_eq!(subject, [4, 5, 6, 7]);
    assert!(pixels.mask.iter().all(|m| [0.0, 1.0].contains(m)));
    assert!((pixels.image.rgb(5, 0)[0] - 200.0 / 255.0).abs() < 0.02 && pixels.image.rgb(0, 0) == [0.0; 3]);

    // The second camera lacks frame 1; the last picture that the file lists is not on disk.
    assert_eq!(views(&capture), [("Camera_B2", 0)]);
    assert_eq!(capture.eval[0].frame.camera.focal.x, 16.0);

    // Parameters counted from one.
    for i in (0..3).rev() {
        let path = |i: usize| fixture.dir.file(&format!("new_params/{i}.npy"));
        std::fs::rename(path(i), path(i + 1)).unwrap();
    }
    assert_eq!(load(&fixture.dir).unwrap().train.len(), 3);
}

#[test]
fn the_training_camera_is_chosen_by_name_or_number() {
    let fixture = Fixture::new("zju-camera");
    fixture.dir.stripe("Camera_B2/000002.png", SIZE, 200);
    let with = |camera: &str| {
        let camera = Some(camera.to_owned());
        load_with(&fixture.dir, LoadOptions { camera, ..LoadOptions::default() })
    };
    for camera in ["2", "Camera_B2"] {
        let capture = with(camera).unwrap();
        assert_eq!(names(&capture.train), ["frame_000000", "frame_000002"]);
        assert_eq!(views(&capture), [("Camera_B1", 0), ("Camera_B1", 1)]);
    }
    let message = with("3").unwrap_err().to_string();
    assert!(message.contains("camera") && message.contains("Camera_B1, Camera_B2"), "{message}");
}

#[test]
fn cameras_may_be_nested_lists_or_whole_arrays() {
    let mut fixture = Fixture::new("zju-lists");
    let row = |values: [f64; 3]| array(&[3], &values);
    *fixture.annots.at(&["cams", "K", "1"]) =
        Py::List(vec![row([16.0, 0.0, 6.0]), row([0.0, 16.0, 4.0]), row([0.0, 0.0, 1.0])]);
    *fixture.annots.at(&["cams", "T"]) = array(&[2, 3], &[0.0, 0.0, 4000.0, 0.0, 0.0, 4000.0]);
    *fixture.annots.at(&["cams", "D"]) = array(&[2, 1, 5], &[0.0; 10]);
    fixture.write();
    let capture = load(&fixture.dir).unwrap();
    assert_eq!(capture.eval[0].frame.camera, capture.train[0].camera);
}

#[test]
fn hidden_pixels_never_reach_training_and_kept_back_views_are_whole() {
    let fixture = Fixture::new("zju-occluded");
    let hidden = || {
        let capture = load(&fixture.dir).unwrap();
        let columns = |frame: &Frame| {
            let pixels = frame.pixels().unwrap();
            for (pixel, mask) in pixels.image.pixels.chunks(3).zip(&pixels.mask) {
                assert!(*mask > 0.0 || pixel == [0.0; 3], "a hidden colour");
            }
            (0..SIZE.0 as usize).filter(|&x| pixels.mask[x] > 0.5).collect::<Vec<_>>()
        };
        let kept_back = capture.eval[0].frame.pixels().unwrap().mask;
        assert_eq!(kept_back.iter().filter(|m| **m > 0.5).count(), 4 * SIZE.1 as usize);
        capture.train.iter().map(columns).collect::<Vec<_>>()
    };
    let whole = vec![4, 5, 6, 7];
    assert_eq!(hidden(), [whole.clone(), whole.clone(), whole.clone()]);
    fixture.occlusion("Camera_B1", [12, 8], [4, 0, 5, 8], &[1]);
    assert_eq!(hidden(), [whole.clone(), vec![5, 6, 7], whole.clone()]);
    // Rows as well as columns: the upper half of a column.
    fixture.occlusion("Camera_B1", [12, 8], [4, 0, 5, 4], &[0]);
    let mask = load(&fixture.dir).unwrap().train[0].pixels().unwrap().mask;
    let column: Vec<f32> = (0..8).map(|y| mask[y * 12 + 4]).collect();
    assert_eq!(column, [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
    fixture.occlusion("Camera_B2", [12, 8], [4, 0, 5, 8], &[1]);
    assert_eq!(hidden()[1], whole, "about another camera");
}

#[test]
fn lens_distortion_is_undone() {
    let size = (96, 64);
    let mut fixture = Fixture::new("zju-lens");
    let coefficients = [-0.25f64, 0.08, 0.002, -0.003, 0.01];
    let lens = Distortion::from_opencv(coefficients.map(|c| c as f32));
    let (focal, centre) = (Vec2::splat(80.0), Vec2::new(50.0, 30.0));
    // A smooth pattern on the image plane of a perfect lens.
    let pattern = |p: Vec2| 0.5 + 0.4 * (p.x * 9.0).sin() * (p.y * 7.0).cos();
    let level = |value: f32| (value * 255.0).round() as u8;
    for i in 0..3 {
        fixture.dir.picture(&format!("Camera_B1/{i:06}.png"), size, |x, y| {
            let seen = (Vec2::new(x as f32, y as f32) + 0.5 - centre) / focal;
            level(pattern(lens.undistort(seen).unwrap()))
        });
        for kind in ["mask_cihp", "mask"] {
            fixture.dir.picture(&format!("{kind}/Camera_B1/{i:06}.png"), size, |_, _| 1);
        }
    }
    let k = [80.0, 0.0, 50.0, 0.0, 80.0, 30.0, 0.0, 0.0, 1.0];
    *fixture.annots.at(&["cams", "K", "0"]) = array(&[3, 3], &k);
    let error = |fixture: &Fixture| {
        fixture.write();
        let capture = load(&fixture.dir).unwrap();
        let frame = &capture.train[0];
        let (mut worst, mut seen) = (0.0f32, 0);
        let shown = frame.pixels().unwrap();
        for (i, pixel) in shown.image.pixels.chunks(3).enumerate().filter(|(i, _)| shown.mask[*i] > 0.999) {
            let at = Vec2::new((i % 96) as f32 + 0.5, (i / 96) as f32 + 0.5);
            worst = worst.max((pixel[0] - pattern((at - frame.camera.centre) / frame.camera.focal)).abs());
            seen += 1;
        }
        assert!(seen > 96 * 64 / 2, "{seen}");
        worst
    };
    let ignored = error(&fixture);
    *fixture.annots.at(&["cams", "D", "0"]) = array(&[5, 1], &coefficients);
    let undone = error(&fixture);
    // Rounding to levels, and bilinear: (1/80)² / 8 · 0.4 · (81 + 49 + 2 · 63).
    assert!(undone < 0.5 / 255.0 + 0.0025, "{undone}");
    assert!(ignored > 0.05, "the distortion must matter for the test to say anything: {ignored}");
}

#[test]
fn resizing_scales_projections_exactly() {
    let fixture = Fixture::new("zju-resize");
    let resized = |side| load_with(&fixture.dir, LoadOptions { resize: side, ..LoadOptions::default() }).unwrap();
    let (large, small) = (resized(None), resized(Some(6)));
    for (a, b) in large.train.iter().zip(&small.train) {
        let (whole, pixels) = (a.pixels().unwrap(), b.pixels().unwrap());
        assert_eq!((pixels.image.width, pixels.image.height, pixels.mask.len()), (6, 4, 24));
        let posed = body().pose(&body().shaped(&a.betas), &a.pose, a.placement);
        for v in posed.vertices {
            let (p, q) = (a.camera.project(v).unwrap(), b.camera.project(v).unwrap());
            assert!((p.truncate() * 0.5).distance(q.truncate()) < 1e-5 && p.z == q.z, "{p} {q}");
        }
        // Coverage and premultiplied colour shrink alike.
        let sum = |values: &[f32]| values.iter().sum::<f32>();
        assert!((sum(&pixels.mask) - 0.25 * sum(&whole.mask)).abs() < 1e-4);
        for (pixel, mask) in pixels.image.pixels.chunks(3).zip(&pixels.mask) {
            assert!((pixel[0] - mask * 200.0 / 255.0).abs() < 0.02);
        }
    }
    let image = |capture: &crate::Capture| capture.train[0].pixels().unwrap().image;
    assert_eq!(image(&resized(Some(100))), image(&large), "nothing is enlarged");
}

#[test]
fn files_that_are_missing_are_named() {
    let masks = ["mask_cihp/Camera_B1/000001.png", "mask/Camera_B1/000001.png"];
    for (files, words) in [
        (&["Camera_B1/000001.png"][..], &["Camera_B1/000001.png"][..]),
        (&masks, &["mask_cihp/Camera_B1/000001.png", "missing mask", "mask/"]),
        (&["new_params/0.npy"], &["new_params/0.npy", "missing", "annots.npy", "ims[0]"]),
        (&["new_params/1.npy"], &["new_params/1.npy", "missing", "annots.npy", "ims[1]"]),
        (&["new_params/2.npy"], &["new_params/2.npy", "missing", "annots.npy", "ims[2]"]),
    ] {
        broken(words, |f| files.iter().for_each(|file| f.dir.remove(file)));
    }
}

#[test]
fn broken_pickles() {
    let whole = Fixture::new("zju-whole-pickle").annots.npy();
    for keep in [0, 5, 20, 130, whole.len() / 2, whole.len() - 1] {
        broken(&["annots.npy"], |f| f.dir.write("annots.npy", &whole[..keep]));
    }
    let eval = b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93\x8c\x011\x85R.";
    broken(&["new_params/2.npy", "builtins eval", "not allowed"], |f| f.dir.write("new_params/2.npy", eval));
    let list = array(&[1], &[0.0]).npy();
    broken(&["annots.npy", "dictionary", "numpy array"], |f| f.dir.write("annots.npy", list));
    // A list that holds itself.
    let circle = b"\x80\x02}X\x03\0\0\0ims]q\0h\0as.";
    broken(&["annots.npy", "nested deeper"], |f| f.dir.write("annots.npy", circle));
}

#[test]
fn no_damage_to_a_pickle_is_a_panic() {
    let fixture = Fixture::new("zju-damaged");
    for (file, whole) in [("annots.npy", fixture.annots.npy()), ("new_params/1.npy", fixture.params.npy())] {
        let mut refused = 0;
        for bytes in damaged(&whole, 300) {
            fixture.dir.write(file, bytes);
            refused += usize::from(load(&fixture.dir).is_err());
        }
        fixture.dir.write(file, whole);
        assert!((75..300).contains(&refused), "{file}: {refused} of 300 refused");
    }
}

#[test]
fn cameras_and_pictures_that_cannot_be() {
    let seven = array(&[7], &[0.0; 7]);
    let sevens = Py::List(vec![seven.clone(), seven.clone()]);
    let one = Py::List(vec![array(&[3, 1], &[0.0; 3])]);
    let nan = array(&[3, 1], &[0.0, f64::NAN, 0.0]);
    let (text, far) = (Py::text("none"), array(&[3, 1], &[0.0, 0.0, -40_000.0]));
    let three = list(&["Camera_B1/000001.png", "Camera_B2/000001.png", "Camera_B3/000001.png"]);
    let twice = list(&["Camera_B1/000001.png", "Camera_B1/000000.png"]);
    let ims = &["ims", "1", "ims"][..];
    let cases: [(&[&str], Py, &[&str]); 21] = [
        (&["cams", "K", "1"], seven, &["cams.K", "shape [7] after [3, 3]"]),
        (&["cams", "K"], sevens, &["cams.K", "[C, 3, 3]", "[2, 7]"]),
        (&["cams", "T"], one, &["cams.T", "[3]", "2 cameras", "[1, 3, 1]"]),
        (&["cams", "K"], text.clone(), &["cams.K", "an array", "str"]),
        (&["cams"], text.clone(), &["cams", "dictionary", "str"]),
        (&["cams", "R", "1"], array(&[3, 3], &[0.5; 9]), &["cams.R[1]", "a rotation"]),
        (&["cams", "K", "0"], array(&[3, 3], &[0.0; 9]), &["cams.K[0]", "pinhole"]),
        (&["cams", "T", "1"], nan, &["cams.T", "finite", "NaN", "4"]),
        (&["cams", "K"], Py::List(Vec::new()), &["cams.K"]),
        (&["cams", "T", "0"], far, &["sees the posed body", "3 frames"]),
        (ims, three, &["ims", "2 pictures", "up to 3"]),
        (ims, list(&["Camera_B7/000001.png"]), &["ims[1].ims", "Camera_B1, Camera_B2", "Camera_B7"]),
        (ims, twice.clone(), &["ims[1].ims", "one picture a camera"]),
        (&["ims", "0", "ims"], twice, &["ims", "a folder for each camera", "Camera_B1"]),
        (ims, list(&["../outside/1.png"]), &["ims[1].ims", "below the capture"]),
        (ims, list(&["/etc/passwd"]), &["ims[1].ims", "below the capture"]),
        (ims, list(&[""]), &["ims[1].ims", "below the capture"]),
        (&["ims", "2"], Py::record([]), &["ims[2].ims", "no such key"]),
        (&["ims", "2"], Py::record([("ims", text.clone())]), &["ims[2].ims", "a list"]),
        (&["ims"], text, &["ims", "a list", "str"]),
        (&["ims"], Py::List(Vec::new()), &["ims", "empty"]),
    ];
    for (keys, value, words) in cases {
        broken(&[&["annots.npy"], words].concat(), |f| {
            *f.annots.at(keys) = value;
            f.write();
        });
    }
    broken(&["annots.npy", "cams.R", "no such key", "K, T, D"], |f| {
        f.annots.remove(&["cams", "R"]);
        f.write();
    });
    broken(&["annots.npy", "ims", "all cameras see"], |f| {
        ["0", "1", "2"].iter().for_each(|i| *f.annots.at(&["ims", i, "ims"]) = list(&["Camera_B1/000000.png"]));
        f.write();
    });
}

#[test]
fn pictures_bodies_and_obstacles_that_cannot_be() {
    broken(&["mask_cihp/Camera_B1/000001.png", "size", "12×8", "12×9"], |f| {
        f.dir.picture("mask_cihp/Camera_B1/000001.png", (SIZE.0, SIZE.1 + 1), |_, _| 1);
    });
    broken(&["mask_cihp/Camera_B1", "subject pixel", "3 frames", "largest value is 0"], |f| {
        (0..3).for_each(|i| f.masks(&format!("Camera_B1/{i:06}"), false));
    });
    broken(&["new_params/1.npy", "shapes", "1 to 1", "[10]"], |f| {
        *f.params.at(&["shapes"]) = array(&[1, 10], &[0.0; 10]);
        f.dir.write("new_params/1.npy", f.params.npy());
    });
    let fixture = Fixture::new("zju-vertices");
    fixture.vertices(1, 0.001);
    assert!(load(&fixture.dir).is_ok(), "rounding of a fit");
    broken(&["new_vertices/1.npy", "vertices", "vertex 0", "numbered"], |f| f.vertices(1, 0.02));
    broken(&["new_vertices/1.npy", "[8, 3]", "[1, 3]"], |f| {
        f.dir.write("new_vertices/1.npy", points_npy(&[Vec3::ZERO]));
    });
    for (size, rect, frames, words) in [
        ([12, 8], [4, 0, 13, 8], &[][..], &["occlusion.json", "rect", "x1", "4 0 13 8"][..]),
        ([12, 8], [5, 0, 4, 8], &[], &["occlusion.json", "rect"]),
        ([8, 12], [0, 0, 1, 1], &[], &["occlusion.json", "image_size", "[12, 8]", "[8, 12]"]),
        ([12, 8], [0, 0, 1, 1], &[0, 80], &["occlusion.json", "frames", "below 3", "80"]),
        ([12, 8], [0, 0, 12, 8], &[0, 1, 2], &["mask_cihp/Camera_B1", "subject pixel"]),
    ] {
        broken(words, |f| f.occlusion("Camera_B1", size, rect, frames));
    }
    broken(&["occlusion.json", "camera", "folder"], |f| f.dir.write("occlusion.json", "{\"camera\": 3}"));
}

/// Largest difference of two cameras' calibration and extrinsics, in pixels and metres.
fn camera_difference(a: &Frame, b: &Frame) -> f32 {
    let extrinsics = |f: &Frame| f.camera.world_to_camera.to_cols_array();
    let moved = extrinsics(a).iter().zip(extrinsics(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let lens = (a.camera.focal - b.camera.focal).abs().max((a.camera.centre - b.camera.centre).abs());
    moved.max(lens.max_element())
}

#[test]
fn the_raw_capture_is_the_prepared_one_and_its_bodies_cover_the_subject() {
    let (Some(scene), Some(prepared)) = (shared("captures/zju_demo"), shared("captures/humannerf_demo")) else {
        return;
    };
    let body = BodyModel::load(&find_body(&scene).unwrap()).unwrap();
    let [raw, prepared] = [&scene, &prepared].map(|dir| load_capture(dir, &body, &LoadOptions::default()).unwrap());
    assert_eq!((raw.train.len(), raw.eval.len()), (100, 100));
    for (a, b) in raw.mean_betas.iter().zip(&prepared.mean_betas) {
        assert!((a - b).abs() < 1e-5, "{a} {b}");
    }
    let posed = |f: &Frame| body.pose(&body.shaped(&f.betas), &f.pose, f.placement);
    let kept_back = raw.eval.iter().map(|e| &e.frame).zip(prepared.eval.iter().map(|e| &e.frame));
    for (i, (a, b)) in raw.train.iter().zip(&prepared.train).chain(kept_back).enumerate() {
        assert_eq!(a.name, b.name);
        assert!(camera_difference(a, b) < 1e-4, "{}", a.name);
        let (p, q) = (posed(a), posed(b));
        let pairs = p.joints.iter().zip(&q.joints).chain(p.vertices.iter().zip(&q.vertices));
        assert!(pairs.map(|(a, b)| a.distance(*b)).fold(0.0, f32::max) < 1e-4, "{}", a.name);
        // The occlusion too: the same subject pixels.
        assert_eq!(a.pixels().unwrap(), b.pixels().unwrap(), "{i}: {}", a.name);
    }
    assert_eq!(views(&raw), views(&prepared));
    for (i, frame) in raw.train.iter().enumerate().step_by(5) {
        let path = scene.join(format!("new_vertices/{i}.npy"));
        let expected = array_files::npz::read_npy(&path).unwrap().to_f64();
        for (v, e) in posed(frame).vertices.iter().zip(expected.chunks(3)) {
            let off = v.as_dvec3().distance(DVec3::from_slice(e));
            assert!(off < 1e-4, "{}: {off}", frame.name);
        }
    }
    // The recorded obstacle stands before the first four fifths.
    let seen = raw.eval.iter().step_by(9).map(|e| &e.frame).chain(raw.train[80..].iter().step_by(5));
    for frame in seen {
        assert!(overlap(frame, &body) > 0.6, "{}: {}", frame.name, overlap(frame, &body));
    }
}
