//! Damaged and hostile files: one clear line each, no panic, bounded memory.

use std::io::{Cursor, Write};
use std::path::Path;

use allocation_counter::measure;
use array_files::pickle::{self, Value};
use array_files::{Data, NdArray};
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use super::masks::Levels;
use super::*;
use crate::testing::{Directory, damaged, shared};
use testkit::files::zip as zipped;

#[test]
fn damaged_files_are_read_or_errors_of_one_line() {
    let (Some(dir), Some(people)) = (shared("estimators"), points_tests::files()) else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let out = Directory::new("import-damage");
    let fit = |path: &Path| read::read(path, &video).map(drop);
    let mask = |path: &Path| Levels::load(path).map(drop);
    let model = BodyModel::embedded();
    let (filmed, _, pixels) = keypoints_tests::frames(&model);
    let picture = |i: usize| format!("openpose/{i:06}_keypoints.json");
    let points =
        serde_json::json!({"people": [{"pose_keypoints_2d": keypoints_tests::body25(&pixels, 0.0)}]}).to_string();
    (1..=2).for_each(|i| out.write(&picture(i), &points));
    let keypoints = |path: &Path| {
        let (folder, mut frames) = (path.parent().unwrap(), keypoints_tests::frames(&model).1);
        keypoints::add(folder, &mut frames, &[], &model, &filmed).map(drop)
    };
    type Read<'a> = &'a dyn Fn(&Path) -> Result<(), CaptureError>;
    let stored = |file: &'static str| (file.to_owned(), std::fs::read(dir.join(file)).unwrap());
    let fits = ["wham/wham_output.pkl", "phalp/demo_clip.pkl", "prompthmr/results.pkl", "gvhmr/hmr4d_results.pt"];
    let masks = ["sam2/00000.png", "matanyone/pha/0000.png", "grounded_sam2/mask_data/mask_00000.npy"];
    let names = ["sam3d.pkl", "sam3d.json", "sam3d.npz"].map(str::to_owned);
    let files = (fits.into_iter().chain(["romp/video_results.npz"]).map(|file| (stored(file), 60, &fit as Read<'_>)))
        .chain(masks.into_iter().map(|file| (stored(file), 60, &mask as Read<'_>)))
        .chain(names.into_iter().zip(people).map(|file| (file, 300, &fit as Read<'_>)))
        .chain([((picture(3), points.clone().into_bytes()), 300, &keypoints as Read<'_>)]);
    for ((file, whole), count, read) in files {
        let path = out.file(&file);
        let said = |bytes: &[u8]| {
            out.write(&file, bytes);
            let said = read(&path).err().map(|error| error.to_string()).unwrap_or_default();
            assert!(said.lines().count() <= 1, "{file}: {said}");
            said
        };
        assert_eq!(said(&whole), "");
        for i in (0..40).filter(|_| count == 300) {
            assert!(!said(&whole[..whole.len() * i / 40]).is_empty(), "{file}: {i} fortieths were read");
        }
        damaged(&whole, count).for_each(|bytes| drop(said(&bytes)));
    }
}

/// Replaces the value at a path of keys; a number is a place in a list or among the entries.
fn set(value: &mut Value, keys: &[&str], to: Value) {
    let Some((first, rest)) = keys.split_first() else {
        *value = to;
        return;
    };
    let number = first.parse::<usize>().ok();
    let next = match value {
        Value::Dict(items) => {
            let at = items.iter().position(|(key, _)| key.as_str() == Some(first)).or(number).unwrap();
            &mut items[at].1
        }
        Value::List(items) => &mut items[number.unwrap()],
        other => panic!("{first} of {}", other.type_name()),
    };
    set(next, rest, to);
}

#[test]
fn what_is_wrong_is_said_in_one_line_with_file_key_expected_and_found() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let floats = |shape: &[usize], value: f64| {
        Value::Array(NdArray { shape: shape.to_vec(), data: Data::F64(vec![value; shape.iter().product()]) })
    };
    let (wham, phalp, hmr) = ("wham/wham_output.pkl", "phalp/demo_clip.pkl", "prompthmr/results.pkl");
    let runs = |counts: &str| {
        let size = Value::List(vec![Value::Int(256), Value::Int(256)]);
        let counts = Value::Bytes(counts.as_bytes().to_vec());
        Value::List(vec![Value::Dict(vec![
            (Value::Str("size".to_owned()), size),
            (Value::Str("counts".to_owned()), counts),
        ])])
    };
    let cases: [(&str, &[&str], Value, &[&str]); 12] = [
        (wham, &["0", "trans"], floats(&[20, 3], f64::NAN), &["0.trans", "finite", "NaN"]),
        (wham, &["0", "pose"], floats(&[20, 72], 1e300), &["0.pose", "finite"]),
        (wham, &["0", "pose"], floats(&[20, 165], 0.0), &["0.pose", "[_, 72]", "[20, 165]"]),
        (wham, &["0", "betas"], floats(&[19, 10], 0.0), &["0.betas", "20 entries", "19"]),
        (wham, &["0", "frame_ids"], floats(&[20], 25.0), &["person 0", "20", "frame 25"]),
        (wham, &["0", "frame_ids"], floats(&[20], 3.0), &["person 0", "once", "twice"]),
        (wham, &["0", "frame_ids"], floats(&[20], -1.0), &["0.frame_ids", "indices", "-1"]),
        (phalp, &["3", "smpl"], Value::List(vec![]), &["smpl", "entry 0", "0 entries"]),
        (phalp, &["3", "mask", "0"], runs("0"), &["counts", "65536", "found 0"]),
        (phalp, &["3", "size", "0"], Value::List(vec![Value::Int(128); 2]), &["size", "256×256", "128×128"]),
        (phalp, &["3", "smpl", "0", "global_orient"], floats(&[1, 3, 3], 1.0), &["global_orient", "rotation"]),
        (hmr, &["camera", "img_focal"], Value::Float(-5.0), &["focal", "-5"]),
    ];
    for (file, keys, value, words) in cases {
        let path = dir.join(file);
        let mut root = pickle::read(&path).unwrap();
        set(&mut root, keys, value);
        let result = read::parse(&path, &root, &video).and_then(|fit| {
            // What `read` checks of every person.
            fit.people.iter().try_for_each(|person| read::check(&path, person, &video))
        });
        let error = result.err().unwrap_or_else(|| panic!("{keys:?} was read")).to_string();
        let name = Path::new(file).file_name().unwrap().to_str().unwrap();
        for word in words.iter().chain(&[name, "expected", "found"]) {
            assert!(error.contains(word), "{word}: {error}");
        }
        assert_eq!(error.lines().count(), 1, "{error}");
    }
}

#[test]
fn programs_bombs_and_foreign_files_are_refused_by_name() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let out = Directory::new("import-hostile");
    let refused = |name: &str, bytes: &[u8], words: &[&str]| {
        out.write(name, bytes);
        let error = read::read(&out.path().join(name), &video).err().unwrap().to_string();
        for word in words.iter().chain(&[name]) {
            assert!(error.contains(word), "{word}: {error}");
        }
    };
    // A joblib file whose wrapper's class runs a command.
    let mut evil = b"\x80\x04}\x94(\x8c\x04pose\x94\x8c\x05posix\x94\x8c\x06system\x94\x93\x94\x8c\x04true\x94\x85R\x8c\x05trans\x94K\x01u.".to_vec();
    refused("system.pkl", &evil, &["posix system", "not allowed"]);
    evil = b"cos\nsystem\n(S'true'\ntR.".to_vec();
    refused("old.pkl", &evil, &["os system", "not allowed"]);
    refused("text.pkl", b"hello", &["WHAM", "begins with hell"]);
    refused("cut.npz", b"PK\x03\x04results", &["expected a whole zip archive"]);
    refused("empty.pkl", b"", &["malformed"]);
    refused("numbers.pkl", b"\x80\x02}(X\x01\x00\x00\x00aK\x01u.", &["WHAM", "dictionary of a"]);
    refused("other.npz", &zipped([("a.npy", [1, 2])]), &["WHAM", "dictionary of a"]);
    // Half a gigabyte of zeros in an archive of half a megabyte.
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file("results.npy", SimpleFileOptions::default()).unwrap();
    for _ in 0..512 {
        zip.write_all(&vec![0; 1 << 20]).unwrap();
    }
    let bomb = zip.finish().unwrap().into_inner();
    let taken = measure(|| refused("bomb.npz", &bomb, &["results", "limit"])).bytes_max;
    assert!(taken < 600 << 20, "{taken}");

    let frames = Directory::new("import-frames");
    frames.picture("a/1.png", (8, 8), |_, _| 9);
    frames.picture("a/2.png", (8, 9), |_, _| 9);
    let options = ImportOptions { frames: frames.path().join("a"), fit: dir.join("easymocap"), ..Default::default() };
    let error = import(&options, &out.path().join("capture")).unwrap_err().to_string();
    assert!(["2.png", "8×8", "8×9"].iter().all(|word| error.contains(word)), "{error}");
    assert!(!out.path().join("capture").exists());
}
