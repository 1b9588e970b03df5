//! Bodies of every size and form: archives like those of SMPL-H and SMPL-X, the saved form, and
//! faults that are named.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use glam::Vec3;
use smpl::{BodyModel, Placement};
use testkit::files::{npy, shared, zip};

fn temporary(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(name)
}

/// How an archive writes the parent of the root.
#[derive(Clone, Copy, Debug)]
enum Root {
    U32,
    I64Wrapped,
    MinusOne,
}

/// Key, element type, shape and values.
type Array = (&'static str, &'static str, Vec<usize>, Vec<f64>);

/// A body of `joints` joints and 3 vertices each, in a chain.
fn arrays(joints: usize, betas: usize, root: Root) -> [Array; 7] {
    let v = 3 * joints;
    let wave = |i: usize| (i as f64 * 0.71).sin();
    let whole = if matches!(root, Root::U32) { "<u4" } else { "<i8" };
    let above = if matches!(root, Root::MinusOne) { -1.0 } else { f64::from(u32::MAX) };
    let parents = (0..joints).map(|j| if j == 0 { above } else { j as f64 - 1.0 });
    let tree = parents.chain((0..joints).map(|j| j as f64)).collect();
    let floats = |key, shape: &[usize], value: &dyn Fn(usize) -> f64| -> Array {
        (key, "<f4", shape.to_vec(), (0..shape.iter().product()).map(value).collect())
    };
    [
        floats("v_template", &[v, 3], &|i| (i / 9) as f64 * 0.1 + wave(i)),
        ("f", whole, vec![joints, 3], (0..v).map(|i| i as f64).collect()),
        floats("shapedirs", &[v, 3, betas], &|i| 0.01 * wave(i)),
        floats("posedirs", &[v, 3, 9 * (joints - 1)], &|i| if i % 7 == 0 { 0.001 * wave(i) } else { 0.0 }),
        floats("weights", &[v, joints], &|i| f64::from(u8::from(i / joints / 3 == i % joints))),
        floats("J_regressor", &[joints, v], &|i| if i % v / 3 == i / v { 1.0 / 3.0 } else { 0.0 }),
        ("kintree_table", whole, vec![2, joints], tree),
    ]
}

/// Writes arrays of a body, and some of what archives of SMPL-H and SMPL-X carry besides.
fn written(name: &str, arrays: &[Array]) -> PathBuf {
    let encoded = |(key, descr, shape, values): &Array| {
        let bytes = |x: &f64| match *descr {
            "<f4" => (*x as f32).to_le_bytes().to_vec(),
            "<u4" => (*x as u32).to_le_bytes().to_vec(),
            _ => (*x as i64).to_le_bytes().to_vec(),
        };
        (*key, npy(descr, shape, &values.iter().flat_map(bytes).collect::<Vec<u8>>()))
    };
    let more = [("lmk_faces_idx", npy("<i8", &[2], &[0; 16])), ("joint2num", npy("|O", &[], b"not even a pickle"))];
    let path = temporary(name);
    let files = arrays.iter().map(encoded).chain(more).map(|(key, bytes)| (format!("{key}.npy"), bytes));
    std::fs::write(&path, zip(files)).unwrap();
    path
}

#[test]
fn bodies_with_hands_and_faces_load_pose_and_survive_saving() {
    for (joints, betas, root) in
        [(52, 16, Root::U32), (55, 400, Root::I64Wrapped), (55, 20, Root::MinusOne), (1, 0, Root::MinusOne)]
    {
        let path = written(&format!("hands-{joints}-{betas}.npz"), &arrays(joints, betas, root));
        let body = BodyModel::load(&path).unwrap();
        assert_eq!((body.num_joints(), body.num_betas(), body.num_vertices()), (joints, betas, 3 * joints));
        assert_eq!(body.parents[0], None);
        let shaped = body.shaped(&vec![0.5; betas]);
        let pose: Vec<Vec3> = (0..joints).map(|j| Vec3::new(0.1, 0.0, 0.01) * j as f32).collect();
        let posed = body.pose(&shaped, &pose, Placement::default());
        assert!(posed.vertices.iter().all(|v| v.is_finite()));

        let saved = temporary(&format!("hands-{joints}-{betas}.safetensors"));
        body.save(&saved).unwrap();
        let back = BodyModel::load(&saved).unwrap();
        assert_eq!(bits(&back), bits(&body));
        assert_eq!(back, body);
        // The content tells the kind, whatever the name.
        let renamed = temporary(&format!("hands-{joints}-{betas}.body"));
        std::fs::copy(&saved, &renamed).unwrap();
        assert_eq!(BodyModel::load(&renamed).unwrap(), body);
        let again = temporary(&format!("hands-{joints}-{betas}-again.safetensors"));
        body.save(&again).unwrap();
        assert_eq!(std::fs::read(&saved).unwrap(), std::fs::read(&again).unwrap());
    }
}

/// Every float of a model: equality of floats takes −0 for 0.
fn bits(body: &BodyModel) -> Vec<u32> {
    let vectors = [&body.v_template, &body.shapedirs, &body.posedirs.values];
    let scalars = body.weights.values.iter().chain(&body.j_regressor.values);
    vectors.into_iter().flatten().flat_map(|v| v.to_array()).chain(scalars.copied()).map(f32::to_bits).collect()
}

#[test]
fn invalid_bodies_are_not_saved() {
    let mut body = BodyModel::embedded();
    body.v_template[3].x = f32::NAN;
    let path = temporary("never.safetensors");
    let _ = std::fs::remove_file(&path);
    assert!(body.save(&path).unwrap_err().to_string().contains("v_template"));
    assert!(!path.exists());
    assert!(BodyModel::embedded().save(Path::new("/no/such/folder/a.safetensors")).is_err());
}

/// The saved form of a body of three joints: written once, as tests run at once and would read what
/// another is writing.
static SMALL: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let body = BodyModel::load(&written("small.npz", &arrays(3, 2, Root::U32))).unwrap();
    let path = temporary("small.safetensors");
    body.save(&path).unwrap();
    std::fs::read(path).unwrap()
});

fn load(name: &str, bytes: &[u8]) -> Result<BodyModel, smpl::Error> {
    let path = temporary(name);
    std::fs::write(&path, bytes).unwrap();
    BodyModel::load(&path)
}

#[test]
fn truncated_and_foreign_files_are_refused() {
    let bytes = SMALL.clone();
    for n in (0..bytes.len()).step_by(7) {
        assert!(load("cut.safetensors", &bytes[..n]).is_err(), "{n} bytes");
    }
    let text = String::from_utf8_lossy(&bytes).into_owned();
    assert!(text.contains("smpl-body 1"));
    let swap = |from: &str, to: &str| {
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        let mut bytes = bytes.clone();
        bytes[at..at + from.len()].copy_from_slice(to.as_bytes());
        load("swapped.safetensors", &bytes).unwrap_err().to_string()
    };
    assert!(swap("smpl-body 1", "smpl-body 9").contains("smpl-body 9"));
    assert!(swap("\"parents\"", "\"porents\"").contains("`parents`: missing, the file holds J_regressor.columns, "));
    let mut huge = bytes.clone();
    huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert!(load("huge.safetensors", &huge).is_err());
    assert!(load("plain.body", b"hello").unwrap_err().to_string().contains(".npz, .pkl or .safetensors"));
}

#[test]
fn bodies_without_faces_or_with_huge_coordinates_are_refused() {
    let refused = |change: fn(&mut BodyModel), words: [&str; 2]| {
        let mut body = BodyModel::embedded();
        change(&mut body);
        let message = body.validate("a.npz").unwrap_err().to_string();
        assert!(words.iter().all(|word| message.contains(word)), "{words:?}: {message}");
    };
    refused(|body| body.faces.clear(), ["`f`", "no faces"]);
    refused(|body| body.faces.iter_mut().for_each(|f| f[1] = f[0]), ["`f`", "degenerate"]);
    refused(|body| body.v_template.fill(Vec3::ONE), ["`f`", "degenerate"]);
    refused(|body| body.v_template[7].y = 1e30, ["`v_template`", "row 7"]);
    refused(|body| body.shapedirs[3] = Vec3::splat(-2e6), ["`shapedirs`", "row 3"]);
    refused(|body| body.posedirs.values[5].z = 1e30, ["`posedirs`", "row 5"]);
}

#[test]
fn faults_of_a_model_name_the_array() {
    let cases: [(&str, usize, f64); 11] = [
        ("v_template", 4, f64::NAN),
        ("v_template", 0, f64::INFINITY),
        ("f", 2, 6.0),
        ("f", 0, -1.0),
        ("weights", 0, 0.5),
        ("weights", 2, -0.5),
        ("weights", 0, f64::NAN),
        ("J_regressor", 0, 9.0),
        ("kintree_table", 1, 1.0),
        ("shapedirs", 3, f64::NEG_INFINITY),
        ("posedirs", 80, f64::NAN),
    ];
    for (i, (key, index, value)) in cases.into_iter().enumerate() {
        let mut arrays = arrays(2, 1, Root::MinusOne);
        arrays.iter_mut().find(|a| a.0 == key).unwrap().3[index] = value;
        let name = format!("fault{i}.npz");
        let message = BodyModel::load(&written(&name, &arrays)).expect_err(key).to_string();
        assert!(message.contains(&format!("`{key}`")) && message.contains(&name), "{message}");
    }
}

#[test]
fn missing_and_misshapen_arrays_of_a_model_are_named() {
    for i in 0..7 {
        let mut arrays = arrays(2, 1, Root::MinusOne).to_vec();
        let (key, _, shape, _) = &mut arrays[i];
        let key = *key;
        shape.push(1);
        let shown = format!("{shape:?}");
        let message = BodyModel::load(&written(&format!("shape{i}.npz"), &arrays)).expect_err(key).to_string();
        assert!(message.contains(&format!("`{key}`")) && message.contains(&shown), "{message}");

        arrays.remove(i);
        let error = BodyModel::load(&written(&format!("missing{i}.npz"), &arrays)).expect_err(key).to_string();
        assert!(error.contains(&format!("`{key}`: missing")), "{error}");
    }
    assert!(load("plain.py", b"import numpy").unwrap_err().to_string().contains("unknown kind of file"));
}

#[test]
fn the_pickled_body_equals_the_npz_one() {
    let (Some(npz), Some(pkl)) = (shared("body/open_body.npz"), shared("body/open_body.pkl")) else {
        return;
    };
    let (a, b) = (BodyModel::load(&npz).unwrap(), BodyModel::load(&pkl).unwrap());
    assert_eq!(a, b);
}
