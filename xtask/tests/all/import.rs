//! From an estimator's files to a drawn person, and what is refused on the way.

use crate::common;

use std::path::Path;

use array_files::Data;
use array_files::pickle;
use array_files::torch::TorchFile;
use serde_json::Value;

use common::{done, folder, json, refused, rewritten, text};
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
    let quick = ["--preset", "fast", "--method", "hash-point", "--steps", "1"];
    done(&[&["train", text(&capture), "--out", text(&run)], &quick[..]].concat());
    done(&["render", text(&run), "tpose", "--size", "64x64"]);
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

/// The capture that the estimators' frames are of, with its own metadata.json, some frames alone.
fn own(dir: &Path, indices: &[usize], out: &Path) {
    let whole = dir.join("../captures/ocmotion_like/mild");
    let records: Value = serde_json::from_str(&std::fs::read_to_string(whole.join("metadata.json")).unwrap()).unwrap();
    let mut kept = serde_json::Map::new();
    for (name, record) in indices.iter().map(|i| records.as_object().unwrap().iter().nth(55 + i).unwrap()) {
        for kind in ["images", "masks"] {
            std::fs::create_dir_all(out.join(kind)).unwrap();
            let file = Path::new(kind).join(name).with_extension("png");
            std::fs::copy(whole.join(&file), out.join(&file)).unwrap();
        }
        kept.insert(name.clone(), record.clone());
    }
    std::fs::write(out.join("metadata.json"), Value::Object(kept).to_string()).unwrap();
    std::fs::copy(dir.join("../body/open_body.npz"), out.join("body.npz")).unwrap();
}

/// With `OCCNERF_TOOLS` set, a training on every tool's fit: some minutes. Without, the prior of the
/// tool whose focal length is worst.
#[test]
fn training_views_are_as_good_as_from_the_captures_own_metadata() {
    let Some(dir) = shared("estimators") else { return };
    let folder = folder("import-trained");
    let long = std::env::var_os("OCCNERF_TOOLS").is_some();
    let how = if long { ["--preset", "fast"] } else { ["--method", "prior"] };
    let psnr = |capture: &Path| {
        let run = capture.with_extension("run");
        done(&[&["train", text(capture), "--out", text(&run)], &how[..]].concat());
        json(&run.join("metrics.json"))["splits"]["novel_view"]["psnr_mask"].as_f64().unwrap()
    };
    let mut known = std::collections::BTreeMap::new();
    for (fit, masks, frames) in [
        ("romp/video_results.npz", Some("sam2"), (0..20).collect::<Vec<_>>()),
        ("wham/wham_output.pkl", Some("sam2"), (0..20).collect()),
        ("phalp/demo_clip.pkl", None, (0..20).filter(|i| ![8, 9].contains(i)).collect()),
        ("gvhmr/hmr4d_results.pt", Some("sam2"), (0..20).collect()),
        ("prompthmr/results.pkl", None, (4..16).collect()),
        ("easymocap", Some("sam2"), (0..20).collect()),
    ] {
        let capture = folder.join(fit.split('/').next().unwrap());
        let (video, file, masks) = (dir.join("frames"), dir.join(fit), masks.map(|masks| dir.join(masks)));
        let mut line = vec!["import", "--frames", text(&video), "--fit", text(&file), "--out", text(&capture)];
        line.extend(masks.iter().flat_map(|masks| ["--masks", text(masks)]));
        done(&line);
        let itself = *known.entry(frames.len()).or_insert_with(|| {
            let capture = folder.join(format!("own{}", frames.len()));
            own(&dir, &frames, &capture);
            psnr(&capture)
        });
        let found = psnr(&capture);
        println!("{fit}: {found:.2} dB, the capture itself {itself:.2}");
        assert!(found > itself - 0.5, "{fit}: {found} dB, the capture itself {itself}");
        if !long {
            break;
        }
    }
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

fn each(list: &mut Value, change: impl Fn(f64) -> f64) {
    for number in list.as_array_mut().unwrap() {
        *number = change(number.as_f64().unwrap()).into();
    }
}

#[test]
fn check_names_the_mistake_in_a_capture_on_disk() {
    let Some(dir) = shared("estimators") else { return };
    let folder = folder("check-mistakes");
    let capture = folder.join("capture");
    let (frames, fit, masks) = (dir.join("frames"), dir.join("wham/wham_output.pkl"), dir.join("sam2"));
    let line =
        ["import", "--frames", text(&frames), "--fit", text(&fit), "--masks", text(&masks), "--out", text(&capture)];
    done(&line);
    let whole = std::fs::read_to_string(capture.join("metadata.json")).unwrap();
    type Change = fn(&mut Value);
    // The extrinsics of an import are a translation alone.
    let mistakes: [(&str, Change); 6] = [
        ("camera to world", |record| {
            (0..3).for_each(|row| each(&mut record["cam_extrinsics"][row], |x| if x == 1.0 { x } else { -x }));
        }),
        ("points up (OpenGL)", |record| (1..3).for_each(|row| each(&mut record["cam_extrinsics"][row], |x| -x))),
        ("millimetres", |record| {
            (0..3).for_each(|row| each(&mut record["cam_extrinsics"][row], |x| if x == 1.0 { x } else { 1000.0 * x }));
        }),
        ("in degrees", |record| each(&mut record["poses"], f64::to_degrees)),
        ("radians already", |record| each(&mut record["poses"], f64::to_radians)),
        ("times too long", |record| {
            (0..2).for_each(|row| each(&mut record["cam_intrinsics"][row], |x| if x > 200.0 { 2.0 * x } else { x }));
        }),
    ];
    for (words, change) in mistakes {
        std::fs::write(capture.join("metadata.json"), &whole).unwrap();
        rewritten(&capture, change);
        let said = done(&["check", text(&capture)]);
        assert!(said.contains("likely mistake") && said.contains(words), "{words}: {said}");
    }
}

#[test]
fn help_says_where_the_tools_leave_their_files() {
    let help = done(&["import", "--help"]);
    for word in
        ["wham_output.pkl", "hmr4d_results.pt", "video_results.npz", "mask_data", "pha/0000.png", "smpl.is.tue.mpg.de"]
    {
        assert!(help.contains(word), "{word}");
    }
}
