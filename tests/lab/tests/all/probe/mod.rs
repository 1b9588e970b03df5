//! `probe` as a user of numpy meets it: results against values worked out here, and one
//! clear line for whatever is wrong.

use crate::common;
mod refusals;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use array_files::npz::{self, Npz};
use array_files::{Data, NdArray};
use testkit::oracle;

type Arrays = Vec<(&'static str, NdArray)>;

fn floats(shape: &[usize], values: &[f32]) -> NdArray {
    NdArray { shape: shape.to_vec(), data: Data::F32(values.to_vec()) }
}

fn doubles(shape: &[usize], values: &[f64]) -> NdArray {
    NdArray { shape: shape.to_vec(), data: Data::F64(values.to_vec()) }
}

fn whole(shape: &[usize], values: &[i64]) -> NdArray {
    NdArray { shape: shape.to_vec(), data: Data::I64(values.to_vec()) }
}

fn flags(shape: &[usize], values: &[bool]) -> NdArray {
    NdArray { shape: shape.to_vec(), data: Data::Bool(values.to_vec()) }
}

/// `arrays` with one of them replaced, or added.
fn with(mut arrays: Arrays, key: &'static str, value: NdArray) -> Arrays {
    arrays.retain(|(k, _)| *k != key);
    arrays.push((key, value));
    arrays
}

fn without(mut arrays: Arrays, key: &str) -> Arrays {
    arrays.retain(|(k, _)| *k != key);
    arrays
}

/// An empty folder of a test's own.
fn folder(name: &str) -> PathBuf {
    common::folder(&format!("probe/{name}"))
}

fn run(op: &str, input: &Path, out: &Path, options: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lab"));
    command.args(["probe", op, "--in"]).arg(input).arg("--out").arg(out).args(options).output().unwrap()
}

/// What `op` makes of `arrays`.
fn probe(folder: &Path, op: &str, arrays: &Arrays, options: &[&str]) -> Npz {
    let (input, out) = (folder.join("in.npz"), folder.join("out.npz"));
    npz::write(&input, arrays).unwrap();
    let output = run(op, &input, &out, options);
    assert!(output.status.success(), "{op}: {}", String::from_utf8_lossy(&output.stderr));
    Npz::open(&out).unwrap()
}

fn close(found: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len());
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f64::from(*f) - e).abs() <= tolerance, "{i}: {f}, expected {e}");
    }
}

const CORNERS: [[f32; 3]; 6] =
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]];

/// A body model in SMPL's form: an octahedron whose corner +X hangs on a second joint at (0.5, 0,
/// 0). Beta 0 moves everything along y.
fn octahedron(folder: &Path) -> PathBuf {
    let path = folder.join("octahedron.npz");
    let faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]];
    let weights: Vec<f32> = (0..6).flat_map(|v| if v == 0 { [0.0, 1.0] } else { [1.0, 0.0] }).collect();
    let regressor = [0.0, 0.5, 0.0, 0.0, 0.5, 0.0, 0.75, 0.0, 0.0, 0.25, 0.0, 0.0];
    let shapedirs: Vec<f32> = (0..6 * 3 * 10).map(|i| f32::from(u8::from(i % 30 == 10))).collect();
    let arrays = vec![
        ("v_template", floats(&[6, 3], CORNERS.as_flattened())),
        ("f", whole(&[8, 3], faces.as_flattened())),
        ("weights", floats(&[6, 2], &weights)),
        ("J_regressor", floats(&[2, 6], &regressor)),
        ("kintree_table", whole(&[2, 2], &[-1, 0, 0, 1])),
        ("shapedirs", floats(&[6, 3, 10], &shapedirs)),
        ("posedirs", floats(&[6, 3, 9], &[0.0; 6 * 3 * 9])),
    ];
    npz::write(&path, &arrays).unwrap();
    path
}

fn skin() -> Arrays {
    let quarter = std::f64::consts::FRAC_PI_2;
    let mut betas = [0.0; 20];
    betas[10] = 2.0;
    vec![
        ("betas", doubles(&[2, 10], &betas)),
        ("poses", doubles(&[2, 6], &[0.0, 0.0, 0.0, 0.0, 0.0, quarter, 0.0, 0.0, quarter, 0.0, 0.0, 0.0])),
        ("trans", whole(&[2, 3], &[0, 0, 3, 0, 0, 0])),
    ]
}

#[test]
fn skin_turns_joints_about_themselves_and_the_root_about_the_pelvis() {
    let folder = folder("skin");
    let model = octahedron(&folder);
    let mut out = probe(&folder, "skin", &skin(), &["--model", model.to_str().unwrap()]);
    let (shape, vertices) = out.f32("vertices", &[None, None, None]).unwrap();
    assert_eq!(shape, [2, 6, 3]);
    // Frame 0: the corner turns about (0.5, 0, 0), all moves by 3 in z.
    close(&vertices[..6], &[0.5, 0.5, 3.0, 0.0, 1.0, 3.0], 1e-6);
    // Frame 1: raised by 2, turned about the pelvis, which is at (0, 2, 0).
    close(&vertices[18..24], &[0.0, 3.0, 0.0, -1.0, 2.0, 0.0], 1e-6);
    let joints = out.f32("joints", &[Some(2), Some(2), Some(3)]).unwrap().1;
    close(&joints, &[0.0, 0.0, 3.0, 0.5, 0.0, 3.0, 0.0, 2.0, 0.0, 0.0, 2.5, 0.0], 1e-6);
}

fn motion() -> Arrays {
    vec![
        ("betas", floats(&[10], &[0.0; 10])),
        ("poses", floats(&[6], &[0.0, 0.0, std::f32::consts::FRAC_PI_2, 0.0, 0.0, 0.0])),
        ("trans", floats(&[3], &[0.0, 0.0, 5.0])),
        ("points", floats(&[4, 3], &[0.0, 1.0, 5.0, 0.0, 0.0, 6.0, 9.0, 9.0, 9.0, 0.1, 0.2, 5.3])),
        ("kind", whole(&[], &[1])),
    ]
}

#[test]
fn motion_undoes_a_rigid_turn_and_leaves_far_points_without_a_place() {
    let folder = folder("motion");
    let model = octahedron(&folder);
    for kind in [0, 1] {
        let arrays = with(motion(), "kind", whole(&[1], &[kind]));
        let mut out = probe(&folder, "motion", &arrays, &["--model", model.to_str().unwrap()]);
        let NdArray { shape, data: Data::F32(canonical) } = out.array("canonical").unwrap() else { panic!() };
        assert_eq!(shape, [4, 3]);
        let likelihood = out.f32("likelihood", &[Some(4)]).unwrap().1;
        assert!(canonical[6..9].iter().all(|x| x.is_nan()) && likelihood[2] == 0.0, "{likelihood:?}");
        // A quarter turn about z: (x, y) came from (y, −x). The last point is deep inside.
        let expected = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.2, -0.1, 0.3]];
        for (point, expected) in [0, 1, 3].into_iter().zip(expected) {
            // The Gaussians of the volume kind do not reach every vertex.
            if kind == 1 || likelihood[point] > 0.0 {
                close(&canonical[3 * point..3 * point + 3], &expected, 1e-5);
            }
        }
        assert!(kind == 0 || likelihood[0] > 0.98 && likelihood[1] > 0.98, "{likelihood:?}");
    }
}

fn fps() -> Arrays {
    let x = [0.0, 1.0, 2.0, 3.0, 10.0, 9.0, 8.0, 5.0];
    let points: Vec<f64> = x.iter().flat_map(|&x| [x, 0.0, 0.0]).collect();
    vec![("points", doubles(&[8, 3], &points)), ("ratio", doubles(&[], &[0.5])), ("levels", whole(&[1], &[2]))]
}

#[test]
fn fps_takes_the_farthest_point_first_and_the_lower_index_of_ties() {
    let mut out = probe(&folder("fps"), "fps", &fps(), &[]);
    // 0, then 10; 5 is 5 from both; then 2, 3 and 8 are 2 from the nearest: the lower index.
    assert_eq!(out.i64("level_1", &[None]).unwrap().1, [0, 4, 7, 2]);
    assert_eq!(out.i64("level_2", &[None]).unwrap().1, [0, 4]);
    assert_eq!(out.keys().len(), 2);
}

fn knn() -> Arrays {
    let lattice: Vec<i64> = (0..100).flat_map(|i| [i % 10, i / 10, 0]).collect();
    vec![
        ("points", whole(&[100, 3], &lattice)),
        ("queries", floats(&[2, 3], &[4.0, 4.0, 0.0, 0.0, 0.0, 2.0])),
        ("k", whole(&[], &[7])),
    ]
}

#[test]
fn knn_breaks_ties_by_index_for_every_k() {
    let folder = folder("knn");
    for k in [1, 7, 64, 65, 100] {
        let mut out = probe(&folder, "knn", &with(knn(), "k", whole(&[1], &[k])), &[]);
        let k = k as usize;
        let indices = out.i64("indices", &[Some(2), Some(k)]).unwrap().1;
        let distances = out.f32("distances", &[Some(2), Some(k)]).unwrap().1;
        for (row, q) in [[4, 4, 0], [0, 0, 2]].into_iter().enumerate() {
            let mut all: Vec<(i64, i64)> =
                (0..100).map(|i: i64| ((i % 10 - q[0]).pow(2) + (i / 10 - q[1]).pow(2) + q[2] * q[2], i)).collect();
            all.sort_unstable();
            let (found, expected) = (&indices[row * k..][..k], &all[..k]);
            assert!(found.iter().zip(expected).all(|(f, e)| *f == e.1), "k = {k}: {found:?}");
            let expected: Vec<f64> = expected.iter().map(|e| (e.0 as f64).sqrt()).collect();
            close(&distances[row * k..][..k], &expected, 1e-6);
        }
    }
}

#[test]
fn surface_gives_neighbours_blend_and_exact_distance() {
    let folder = folder("surface");
    let mesh = octahedron(&folder);
    let queries = vec![("queries", floats(&[2, 3], &[2.0, 0.0, 0.0, 0.1, 0.1, 0.1]))];
    let mut out = probe(&folder, "surface", &queries, &["--mesh", mesh.to_str().unwrap()]);
    let indices = out.i64("indices", &[Some(2), Some(4), Some(5)]).unwrap().1;
    // Nearest first, then four as near as each other; the single vertex of the coarser levels is
    // repeated.
    assert_eq!(indices[..10], [0, 1, 2, 4, 5, 0, 0, 0, 0, 0]);
    // Normals are radial: the four others have |cos| = 1/√5 each and cancel but for x = 0.
    let w = 1.0 / 5f64.sqrt();
    let blended = 1.0 / (1.0 + 4.0 * w);
    close(&out.f32("blended", &[Some(2), Some(3)]).unwrap().1[..3], &[blended, 0.0, 0.0], 1e-6);
    close(&out.f32("signed_distance", &[Some(2)]).unwrap().1[..1], &[2.0 - blended], 1e-6);
    let third = 1.0 / 3.0;
    let closest = out.f32("closest_point", &[Some(2), Some(3)]).unwrap().1;
    close(&closest, &[1.0, 0.0, 0.0, third, third, third], 1e-6);
    let inside = -(third - 0.1) * 3f64.sqrt();
    let exact = out.f32("exact_signed_distance", &[Some(2)]).unwrap().1;
    close(&exact, &[1.0, inside], 1e-6);

    // The same mesh as an OBJ file.
    let mut text: String = CORNERS.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
    text += "f 1 2 3\nf 2 4 3\nf 4 5 3\nf 5 1 3\nf 2 1 6\nf 4 2 6\nf 5 4 6\nf 1 5 6\n";
    let obj = folder.join("octahedron.obj");
    std::fs::write(&obj, text).unwrap();
    let mut again = probe(&folder, "surface", &queries, &["--mesh", obj.to_str().unwrap()]);
    assert_eq!(again.f32("exact_signed_distance", &[Some(2)]).unwrap().1, exact);
    assert_eq!(again.i64("indices", &[None; 3]).unwrap().1, indices);
}

fn visible() -> Arrays {
    vec![
        ("K", whole(&[3, 3], &[100, 0, 64, 0, 100, 64, 0, 0, 1])),
        ("E", whole(&[3, 4], &[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4])),
        ("width", whole(&[], &[128])),
        ("height", whole(&[1], &[128])),
    ]
}

#[test]
fn visible_needs_a_free_way_and_a_place_in_the_image() {
    let folder = folder("visible");
    let mesh = octahedron(&folder);
    // Looking along z from −4: everything but the far corner, which is hidden.
    let mut out = probe(&folder, "visible", &visible(), &["--mesh", mesh.to_str().unwrap()]);
    let seen = out.array("visible").unwrap();
    assert_eq!(seen.data, Data::Bool(vec![true, true, false, true, true, true]));
    // A corner at x = 1 falls on column 89.
    let narrow = with(visible(), "width", whole(&[], &[89]));
    let mut out = probe(&folder, "visible", &narrow, &["--mesh", mesh.to_str().unwrap()]);
    assert_eq!(out.array("visible").unwrap().data, Data::Bool(vec![false, true, false, true, true, true]));
}

fn hash() -> Arrays {
    let table: Vec<f32> = (0..2 * 16).map(|i| i as f32).collect();
    vec![
        ("points", floats(&[2, 2], &[0.25, 0.5, 1.0, 1.0])),
        ("resolutions", whole(&[2], &[2, 8])),
        ("table", floats(&[2, 16, 1], &table)),
        ("d_features", floats(&[2, 2], &[1.0, 0.0, 0.0, 1.0])),
    ]
}

#[test]
fn hash_encode_indexes_dense_and_hashed_levels_as_documented() {
    let folder = folder("hash");
    let mut out = probe(&folder, "hash-encode", &hash(), &[]);
    // Level 0 is dense, 3 × 3: (0.25, 0.5) lies at (0.5, 1), between rows 3 and 4. Level 1 has 9 ×
    // 9 corners for 16 rows: (2, 4) and (8, 8) are corners.
    let row = |x: u32, y: u32| f64::from((x ^ y.wrapping_mul(2_654_435_761)) % 16);
    let expected = [3.5, 16.0 + row(2, 4), 8.0, 16.0 + row(8, 8)];
    close(&out.f32("features", &[Some(2), Some(2)]).unwrap().1, &expected, 1e-6);
    let mut d_table = [0.0; 32];
    (d_table[3], d_table[4]) = (0.5, 0.5);
    d_table[16 + row(8, 8) as usize] = 1.0;
    close(&out.f32("d_table", &[Some(2), Some(16), Some(1)]).unwrap().1, &d_table, 1e-6);
    let d_points = out.f32("d_points", &[Some(2), Some(2)]).unwrap().1;
    // Two cells an axis; a step in x is one row, a step in y three.
    close(&d_points[..2], &[2.0, 6.0], 1e-6);
    assert_eq!(probe(&folder, "hash-encode", &without(hash(), "d_features"), &[]).keys(), ["features"]);
}

fn composite() -> Arrays {
    vec![
        ("sigma", floats(&[2, 2], &[1.0, 2.0, 0.0, 0.0])),
        ("rgb", floats(&[2, 2, 3], &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])),
        ("edges", floats(&[2, 3], &[1.0, 1.5, 2.0, 0.0, 1.0, 2.0])),
        ("background", doubles(&[3], &[0.0, 0.0, 1.0])),
        ("d_color", floats(&[2, 3], &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0])),
    ]
}

#[test]
fn composite_follows_the_formula() {
    let folder = folder("composite");
    let mut out = probe(&folder, "composite", &composite(), &[]);
    let (a, b) = (1.0 - (-0.5f64).exp(), 1.0 - (-1f64).exp());
    let w = [a, (1.0 - a) * b];
    let opacity = w[0] + w[1];
    close(&out.f32("weights", &[Some(2), Some(2)]).unwrap().1, &[w[0], w[1], 0.0, 0.0], 1e-6);
    close(&out.f32("color", &[Some(2), Some(3)]).unwrap().1, &[w[0], w[1], 1.0 - opacity, 0.0, 0.0, 1.0], 1e-6);
    close(&out.f32("opacity", &[Some(2)]).unwrap().1, &[opacity, 0.0], 1e-6);
    close(&out.f32("depth", &[Some(2)]).unwrap().1, &[1.25 * w[0] + 1.75 * w[1], 0.0], 1e-6);
    assert_eq!(out.i64("termination", &[Some(2)]).unwrap().1, [1, 0]);
    // Ray 0: red is w_0. Ray 1: blue is 1 everywhere, whatever the density.
    let d_sigma = [0.5 * (1.0 - a), 0.0, 0.0, 0.0];
    close(&out.f32("d_sigma", &[Some(2), Some(2)]).unwrap().1, &d_sigma, 1e-6);
    let d_rgb = out.f32("d_rgb", &[Some(2), Some(2), Some(3)]).unwrap().1;
    close(&d_rgb, &[w[0], 0.0, 0.0, w[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 1e-6);
    assert_eq!(probe(&folder, "composite", &without(composite(), "d_color"), &[]).keys().len(), 5);
}

/// Two images of 8 × 9 pixels that differ by 0.1 in the left half, which is the mask.
fn metrics() -> Arrays {
    let values = |off: f32| -> Vec<f32> {
        (0..8 * 9 * 3).map(|i| 0.4 + 0.05 * ((i * 7 % 11) as f32) + if i / 3 % 9 < 4 { off } else { 0.0 }).collect()
    };
    let mask: Vec<bool> = (0..72).map(|i| i % 9 < 4).collect();
    vec![
        ("a", floats(&[8, 9, 3], &values(0.0))),
        ("b", floats(&[8, 9, 3], &values(0.1))),
        ("mask", flags(&[8, 9], &mask)),
    ]
}

#[test]
fn metrics_are_those_of_the_whole_and_of_the_mask() {
    let folder = folder("metrics");
    let mut out = probe(&folder, "metrics", &metrics(), &[]);
    let mut value = |key: &str| out.f32(key, &[]).unwrap().1;
    close(&value("psnr_mask"), &[20.0], 1e-4);
    close(&value("psnr"), &[20.0 + 10.0 * (9f64 / 4.0).log10()], 1e-4);
    let images: Vec<Vec<f32>> =
        metrics()[..2].iter().map(|(key, array)| array.to_f32("", key, &[None; 3]).unwrap()).collect();
    close(&value("ssim"), &[oracle::ssim(&images[0], &images[1], 9, 8)], 1e-6);
    let map = oracle::ssim_map(&images[0], &images[1], 9, 8);
    let masked: f64 = (0..72).filter(|i| i % 9 < 4).map(|i| map[i]).sum();
    close(&value("ssim_mask"), &[masked / 32.0], 1e-6);
    let same = metrics().into_iter().find(|(key, _)| *key == "a").unwrap().1;
    let mut out = probe(&folder, "metrics", &with(metrics(), "b", same), &[]);
    assert_eq!(out.array("psnr").unwrap().data, Data::F32(vec![f32::INFINITY]));
    close(&out.f32("ssim", &[]).unwrap().1, &[1.0], 0.0);
}

#[test]
fn metrics_with_weights_give_the_golden_lpips() {
    let Some(shared) = testkit::files::shared("lpips") else { return };
    let folder = folder("lpips");
    let mut golden = Npz::open(&shared.join("golden.npz")).unwrap();
    let mut picture = |key: &str| {
        let (_, values) = golden.f32(key, &[Some(1), Some(3), Some(75), Some(50)]).unwrap();
        let last: Vec<f32> = (0..values.len()).map(|i| 0.5 * values[i % 3 * 75 * 50 + i / 3] + 0.5).collect();
        floats(&[75, 50, 3], &last)
    };
    let arrays = vec![("a", picture("a_hw")), ("b", picture("b_hw")), ("mask", flags(&[75, 50], &[true; 75 * 50]))];
    let mut out = probe(&folder, "metrics", &arrays, &["--lpips", shared.to_str().unwrap()]);
    let expected = golden.array("lpips_squeeze_hw").unwrap().to_f64();
    close(&out.f32("lpips", &[]).unwrap().1, &expected, 2e-4);
    npz::write(&folder.join("in.npz"), &metrics()).unwrap();
    let options = ["--lpips", shared.to_str().unwrap()];
    let small = run("metrics", &folder.join("in.npz"), &folder.join("small.npz"), &options);
    testkit::program::refusal(&small, "a small picture", &["9 × 8", "at least 17"]);
}

#[test]
fn empty_lists_of_queries_have_empty_answers() {
    let folder = folder("empty");
    let mut out = probe(&folder, "knn", &with(knn(), "queries", floats(&[0, 3], &[])), &[]);
    assert_eq!(out.array("indices").unwrap().shape, [0, 7]);
    let mut out =
        probe(&folder, "hash-encode", &without(with(hash(), "points", floats(&[0, 3], &[])), "d_features"), &[]);
    assert_eq!(out.array("features").unwrap().shape, [0, 2]);
}
