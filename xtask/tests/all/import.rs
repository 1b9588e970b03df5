//! From an estimator's files to a drawn person, and what is refused on the way.

use crate::common;

use std::path::Path;

use array_files::Data;
use array_files::pickle;
use array_files::torch::TorchFile;
use serde_json::Value;

use common::{done, folder, refused, rewritten, text};
use testkit::files::shared;

#[test]
fn a_newcomer_gets_a_person_with_three_commands() {
    let Some(dir) = shared("estimators") else { return };
    let folder = folder("import-newcomer");
    let (capture, run) = (folder.join("capture"), folder.join("run"));
    let (frames, fit) = (dir.join("frames"), dir.join("phalp"));
    let fit = fit.join("demo_clip.pkl");
    let said = done(&["import", "--frames", text(&frames), "--fit", text(&fit), "--out", text(&capture)]);
    for words in ["4D-Humans", "18 of 20 frames", "2 (5 frames)", "left over", "no usual mistake", "train on it"] {
        assert!(said.contains(words), "{words}: {said}");
    }
    assert!(image::open(capture.join("check.png")).unwrap().width() > 500);
    let whole = std::fs::read(capture.join("metadata.json")).unwrap();
    let degrees = |axis: &mut Value| *axis = axis.as_f64().unwrap().to_degrees().into();
    rewritten(&capture, |record| record["poses"].as_array_mut().unwrap().iter_mut().for_each(degrees));
    let said = done(&["check", text(&capture)]);
    assert!(said.contains("likely mistake") && said.contains("in degrees"), "{said}");
    std::fs::write(capture.join("metadata.json"), whole).unwrap();
    let quick = ["--preset", "fast", "--method", "hash-point", "--steps", "1"];
    done(&[&["train", text(&capture), "--out", text(&run)], &quick[..]].concat());
    done(&["render", text(&run), "tpose"]);
    // A second import needs leave to replace the first.
    let again = ["import", "--frames", text(&frames), "--fit", text(&fit), "--out", text(&capture)];
    refused(&again, &["--force"]);
    done(&[&again[..], &["--force"]].concat());
    // What lies in the capture is not read while it is replaced.
    let images = capture.join("images");
    let count = || std::fs::read_dir(&images).unwrap().filter(|e| e.as_ref().unwrap().path().is_file()).count();
    let own = ["import", "--force", "--frames", text(&images), "--fit", text(&fit), "--out", text(&capture)];
    refused(&own, &["images", "--frames", "--out"]);
    assert_eq!(count(), 18);
}

#[test]
fn what_cannot_be_imported_is_said_in_one_line_and_leaves_nothing() {
    let Some(dir) = shared("estimators") else { return };
    let folder = folder("import-refused");
    let out = folder.join("capture");
    let (frames, wham, masks) = (dir.join("frames"), dir.join("wham/wham_output.pkl"), dir.join("sam2"));
    let import = |more: &[&str], words: &[&str]| {
        let line = ["import", "--frames", text(&frames), "--out", text(&out)];
        refused(&[&line[..], more].concat(), words);
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
    };
    import(&["--fit", text(&wham)], &["wham_output.pkl", "--masks"]);
    import(&["--fit", text(&wham), "--masks", "nowhere"], &["nowhere", "--masks"]);
    import(&["--fit", text(&wham), "--masks", text(&masks), "--object", "7"], &["sam2", "object 7", "objects 1, 2"]);
    import(&["--fit", text(&wham), "--masks", text(&masks), "--person", "7"], &["person 7", "0 (20 frames)"]);
    import(&["--fit", text(&wham), "--masks", text(&masks), "--focal", "0"], &["focal"]);
    import(&["--fit", text(&masks), "--masks", text(&masks)], &["sam2", "EasyMocap"]);
    let body = dir.join("../body/open_body_x.npz");
    import(&["--fit", text(&wham), "--masks", text(&masks), "--body", text(&body)], &["SMPL_NEUTRAL.pkl", "55 joints"]);
}

/// GVHMR's file saved by numpy, as it would be if its body were SMPL-X, whose pelvis is lower at
/// rest.
fn of_smplx(fit: &Path, to: &Path) {
    let mut file = TorchFile::open("fit", std::fs::File::open(fit).unwrap()).unwrap();
    let root = file.root().clone();
    let mut array = |value: &pickle::Value| file.resolve("fit", value).unwrap().as_array().unwrap().clone();
    let mut arrays = vec![("K_fullimg".to_owned(), array(root.get("K_fullimg").unwrap()))];
    for key in ["body_pose", "betas", "global_orient", "transl"] {
        let params = root.get("smpl_params_incam").unwrap();
        arrays.push((format!("smpl_params_incam_{key}"), array(params.get(key).unwrap())));
    }
    let Data::F32(places) = &mut arrays[4].1.data else { panic!("floats") };
    places.chunks_exact_mut(3).for_each(|place| place[1] += 0.351 - 0.22);
    array_files::npz::write(to, &arrays).unwrap();
}

/// Where no body model is at hand, the open body takes the joints' rotations; its shape is found.
#[test]
fn without_a_body_model_the_open_body_stands_in() {
    let Some(dir) = shared("estimators") else { return };
    let folder = folder("import-open-body");
    let frames = folder.join("frames");
    std::fs::create_dir(&frames).unwrap();
    for frame in std::fs::read_dir(dir.join("frames")).unwrap() {
        let path = frame.unwrap().path();
        std::fs::copy(&path, frames.join(path.file_name().unwrap())).unwrap();
    }
    let (masks, known) = (dir.join("sam2"), dir.join("../body/open_body.npz"));
    let mut scores = Vec::new();
    for (fit, words) in [
        ("wham/wham_output.pkl", "SMPL_NEUTRAL.pkl, which WHAM fitted"),
        ("gvhmr/hmr4d_results.pt", "SMPLX_NEUTRAL.npz, which GVHMR fitted"),
        ("wham/wham_output.pkl", ""),
    ] {
        let name = format!("{}{}", fit.split('/').next().unwrap(), scores.len());
        let (copy, capture, run) = (folder.join(&name), folder.join(name.clone() + "c"), folder.join(name + "r"));
        match fit.starts_with("gvhmr") {
            true => of_smplx(&dir.join(fit), &copy),
            false => std::fs::copy(dir.join(fit), &copy).map(|_| ()).unwrap(),
        }
        let line = ["import", "--frames", text(&frames), "--fit", text(&copy), "--masks", text(&masks)];
        let body = if words.is_empty() { vec!["--body", text(&known)] } else { Vec::new() };
        let said = done(&[&line[..], &["--out", text(&capture)], &body].concat());
        assert!(said.contains(words) && said.contains("open body of this program") != words.is_empty(), "{said}");
        let said = done(&["train", text(&capture), "--out", text(&run), "--method", "surface"]);
        let row = said.lines().find(|line| line.starts_with("| surface")).unwrap();
        scores.push(row.split('|').nth(5).unwrap().trim().parse::<f64>().unwrap());
    }
    println!("psnr_mask: open body under WHAM's and GVHMR's fit, the true body: {scores:?}");
    assert!(scores[..2].iter().all(|score| *score > scores[2] - 1.0), "{scores:?}");
}
