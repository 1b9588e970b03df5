//! One clear line for whatever is wrong.

use super::*;
use testkit::program::refusal;

#[test]
fn whatever_is_wrong_with_the_arrays_is_named_in_one_line() {
    let folder = folder("refused");
    let body = octahedron(&folder);
    let body = body.to_str().unwrap();
    let (model, mesh) = (["--model", body], ["--mesh", body]);
    let surface = || vec![("queries", floats(&[1, 3], &[0.0; 3]))];
    let nan = f32::NAN;
    let cases: Vec<(&str, Arrays, &[&str], &[&str])> = vec![
        ("skin", without(skin(), "trans"), &model, &["no array `trans`"]),
        ("skin", with(skin(), "extra", floats(&[], &[1.0])), &model, &["unknown array", "extra", "betas"]),
        ("skin", with(skin(), "betas", floats(&[2, 9], &[0.0; 18])), &model, &["`betas`", "9", "10"]),
        ("skin", with(skin(), "poses", floats(&[2, 72], &[0.0; 144])), &model, &["`poses`", "[2, 72]", "[2, 6]"]),
        ("skin", with(skin(), "trans", floats(&[1, 3], &[0.0; 3])), &model, &["`trans`", "[1, 3]", "[2, 3]"]),
        ("skin", with(skin(), "trans", floats(&[2, 3], &[0.0, 0.0, 0.0, nan, 0.0, 0.0])), &model, &["`trans`", "3"]),
        ("skin", with(skin(), "trans", doubles(&[2, 3], &[1e300; 6])), &model, &["`trans`", "not finite"]),
        (
            "skin",
            with(with(skin(), "betas", floats(&[2, 10], &[3e38; 20])), "trans", floats(&[2, 3], &[3e38; 6])),
            &model,
            &["overflows"],
        ),
        ("motion", with(motion(), "kind", whole(&[], &[2])), &model, &["`kind`", "2", "0 to 1"]),
        ("motion", with(motion(), "kind", floats(&[], &[1.0])), &model, &["`kind`", "integer"]),
        ("motion", with(motion(), "betas", floats(&[11], &[0.0; 11])), &model, &["`betas`", "11"]),
        ("motion", with(motion(), "points", floats(&[3], &[0.0; 3])), &model, &["`points`", "[3]", "[_, 3]"]),
        (
            "motion",
            with(with(motion(), "betas", floats(&[10], &[3e38; 10])), "trans", floats(&[3], &[3e38; 3])),
            &model,
            &["overflows"],
        ),
        ("fps", with(fps(), "ratio", floats(&[], &[0.0])), &[], &["`ratio`", "0"]),
        ("fps", with(fps(), "ratio", floats(&[], &[1.5])), &[], &["`ratio`", "1.5"]),
        ("fps", with(fps(), "ratio", floats(&[2], &[0.5; 2])), &[], &["`ratio`", "[2]"]),
        ("fps", with(fps(), "levels", whole(&[], &[0])), &[], &["`levels`", "1 to 32"]),
        ("fps", with(fps(), "levels", whole(&[], &[i64::MAX])), &[], &["`levels`", "1 to 32"]),
        ("fps", with(fps(), "points", floats(&[0, 3], &[])), &[], &["`points`", "no points"]),
        ("fps", with(fps(), "points", flags(&[1, 3], &[true; 3])), &[], &["`points`", "booleans"]),
        ("knn", with(knn(), "k", whole(&[], &[0])), &[], &["`k`", "1 to 100"]),
        ("knn", with(knn(), "k", whole(&[], &[101])), &[], &["`k`", "101", "1 to 100"]),
        ("knn", with(knn(), "k", whole(&[], &[-1])), &[], &["`k`", "-1"]),
        ("knn", with(knn(), "k", whole(&[0], &[])), &[], &["`k`", "[0]"]),
        ("knn", with(knn(), "k", doubles(&[], &[5.0])), &[], &["`k`", "integer"]),
        ("knn", with(knn(), "k", flags(&[], &[true])), &[], &["`k`", "booleans"]),
        ("knn", with(knn(), "queries", floats(&[1, 3], &[0.0, f32::INFINITY, 0.0])), &[], &["`queries`", "1"]),
        ("knn", with(knn(), "queries", floats(&[1, 3], &[3e38; 3])), &[], &["`distances`", "overflows"]),
        ("surface", with(surface(), "queries", floats(&[1, 2], &[0.0; 2])), &mesh, &["`queries`", "[1, 2]"]),
        (
            "surface",
            with(surface(), "queries", floats(&[1, 3], &[3e38; 3])),
            &mesh,
            &["exact_signed_distance", "too large"],
        ),
        ("visible", with(visible(), "width", whole(&[], &[0])), &mesh, &["`width`", "0"]),
        ("visible", with(visible(), "height", whole(&[], &[1 << 40])), &mesh, &["`height`"]),
        ("visible", with(visible(), "K", floats(&[3, 3], &[0.0; 9])), &mesh, &["`K`"]),
        ("visible", with(visible(), "E", floats(&[3, 4], &[0.0; 12])), &mesh, &["`E`", "inverse"]),
        ("visible", with(visible(), "E", floats(&[4, 4], &[0.0; 16])), &mesh, &["`E`", "[4, 4]", "[3, 4]"]),
        ("hash-encode", with(hash(), "points", floats(&[1, 2], &[0.0, 1.5])), &[], &["`points`", "1.5", "0 to 1"]),
        ("hash-encode", with(hash(), "points", floats(&[1, 5], &[0.0; 5])), &[], &["`points`", "[1, 5]", "[_, 4]"]),
        ("hash-encode", with(hash(), "resolutions", whole(&[2], &[0, 8])), &[], &["`resolutions`", "0"]),
        ("hash-encode", with(hash(), "resolutions", whole(&[3], &[1, 2, 8])), &[], &["`table`", "[3, _, _]"]),
        ("hash-encode", with(hash(), "resolutions", whole(&[2], &[2, 1 << 30])), &[], &["`resolutions`"]),
        ("hash-encode", with(hash(), "resolutions", whole(&[2, 1], &[2, 8])), &[], &["`resolutions`", "[2, 1]"]),
        ("hash-encode", with(hash(), "table", floats(&[2, 12, 1], &[0.0; 24])), &[], &["`table`", "12", "power"]),
        ("hash-encode", with(hash(), "table", floats(&[2, 16, 0], &[])), &[], &["table", "features: 0"]),
        ("hash-encode", with(hash(), "d_features", floats(&[2, 3], &[0.0; 6])), &[], &["`d_features`", "[2, 2]"]),
        ("composite", with(composite(), "sigma", floats(&[2, 2], &[0.0, -1.0, 0.0, 0.0])), &[], &["`sigma`", "-1"]),
        ("composite", with(composite(), "sigma", floats(&[2, 0], &[])), &[], &["`sigma`", "samples"]),
        ("composite", with(composite(), "edges", floats(&[2, 2], &[0.0; 4])), &[], &["`edges`", "[2, 2]", "[2, 3]"]),
        (
            "composite",
            with(composite(), "edges", floats(&[2, 3], &[0., 1., 2., 0., 2., 1.])),
            &[],
            &["`edges`", "ray 1"],
        ),
        ("composite", with(composite(), "background", floats(&[], &[0.0])), &[], &["`background`", "[3]"]),
        ("metrics", with(metrics(), "b", floats(&[9, 8, 3], &[0.0; 216])), &[], &["`b`", "[9, 8, 3]", "[8, 9, 3]"]),
        ("metrics", with(metrics(), "b", floats(&[8, 9, 3], &[2.0; 216])), &[], &["`b`", "2", "0 to 1"]),
        ("metrics", with(metrics(), "mask", whole(&[8, 9], &[1; 72])), &[], &["`mask`", "integers", "booleans"]),
        ("metrics", with(metrics(), "mask", flags(&[8, 9], &[false; 72])), &[], &["`mask`", "nowhere"]),
        ("metrics", with(metrics(), "mask", flags(&[72], &[true; 72])), &[], &["`mask`", "[72]", "[8, 9]"]),
    ];
    let (input, out) = (folder.join("in.npz"), folder.join("out.npz"));
    for (op, arrays, options, words) in cases {
        npz::write(&input, &arrays).unwrap();
        refusal(&run(op, &input, &out, options), &format!("{op} without {words:?}"), words);
        assert!(!out.exists(), "{op} left something behind");
    }
    let small = vec![
        ("a", floats(&[6, 9, 3], &[0.0; 162])),
        ("b", floats(&[6, 9, 3], &[0.0; 162])),
        ("mask", flags(&[6, 9], &[true; 54])),
    ];
    npz::write(&input, &small).unwrap();
    refusal(&run("metrics", &input, &out, &[]), "a small image", &["9×6", "7×7"]);
}

#[test]
fn files_and_options_that_do_not_fit_are_named_in_one_line() {
    let folder = folder("files");
    let body = octahedron(&folder);
    let (input, out) = (folder.join("in.npz"), folder.join("out.npz"));
    let missing = folder.join("none.npz");
    refusal(&run("fps", &missing, &out, &[]), "no file", &["none.npz"]);
    refusal(&run("fps", &folder, &out, &[]), "a folder", &[folder.to_str().unwrap()]);
    std::fs::write(&input, b"PK\x03\x04 and no more").unwrap();
    refusal(&run("fps", &input, &out, &[]), "no archive", &["in.npz"]);
    npz::write(&input, &fps()).unwrap();
    let bytes = std::fs::read(&input).unwrap();
    for length in [0, 30, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&input, &bytes[..length]).unwrap();
        refusal(&run("fps", &input, &out, &[]), "a truncated archive", &["in.npz"]);
    }
    std::fs::write(&input, &bytes).unwrap();
    refusal(&run("fps", &input, &folder.join("no/such/out.npz"), &[]), "nowhere to write", &["no/such/out.npz"]);
    refusal(&run("fps", &input, &out, &["--mesh", body.to_str().unwrap()]), "a mesh too many", &["fps", "--mesh"]);
    refusal(&run("skin", &input, &out, &[]), "no model", &["skin", "--model"]);
    refusal(
        &run("surface", &input, &out, &["--mesh", missing.to_str().unwrap()]),
        "other arrays",
        &["points", "queries"],
    );
    npz::write(&input, &[("queries", floats(&[0, 3], &[]))]).unwrap();
    refusal(&run("surface", &input, &out, &["--mesh", missing.to_str().unwrap()]), "no mesh", &["none.npz"]);
    refusal(&run("surface", &input, &out, &["--mesh", input.to_str().unwrap()]), "no model", &["v_template"]);
}
