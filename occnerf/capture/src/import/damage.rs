//! Damaged and hostile files: one clear line each, no panic, no hang, bounded memory.
//!
//! `OCCNERF_MUTATIONS` says how many mutations of all formats together are tried (1 200 if it is
//! not set).

use std::io::{Cursor, Read, Write};
use std::path::Path;
use std::time::Instant;

use allocation_counter::measure;
use array_files::npz::Npz;
use array_files::pickle::{self, Value};
use array_files::torch::TorchFile;
use array_files::{Data, NdArray};
use zip::write::SimpleFileOptions;
use zip::{ZipArchive, ZipWriter};

use super::fit::Fit;
use super::levels::Levels;
use super::*;
use crate::testing::{Directory, shared};
use testkit::files::zip as zipped;
use volrender::RandomStream;

/// Longest that a mutation may take, and most memory: pickles take 8 times their
/// size and 128 MiB, compressed ones may grow by 64 MiB and more before that; vectors are there
/// twice while they grow.
const SECONDS: f64 = 1.0;
const BYTES: u64 = 600 << 20;

fn mutations() -> usize {
    std::env::var("OCCNERF_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(1200)
}

fn read_fit(name: &str, bytes: &[u8], video: &Video) -> Result<Fit, CaptureError> {
    let path = Path::new(name);
    match name {
        "torch" => gvhmr::read(path, &mut TorchFile::open(name, Cursor::new(bytes))?, video),
        "npz" => {
            let mut npz = Npz::from_bytes(name, bytes.to_vec())?;
            romp::read(path, &npz.value("results")?, video)
        }
        _ => read::parse(path, &pickle::from_bytes(name, bytes.to_vec())?, video),
    }
}

/// Where a file says what it holds, rather than holding it: near runs of small letters.
fn structure(bytes: &[u8]) -> Vec<usize> {
    let mut near = vec![false; bytes.len()];
    for (at, word) in bytes.windows(4).enumerate() {
        if word.iter().all(u8::is_ascii_lowercase) {
            near[at.saturating_sub(24)..(at + 40).min(bytes.len())].fill(true);
        }
    }
    let found: Vec<usize> = (0..bytes.len()).filter(|&at| near[at]).collect();
    if found.is_empty() { (0..bytes.len()).collect() } else { found }
}

/// One to three changes: a byte, an opcode of pickles, a field of ones, a piece left out, repeated
/// or moved, the end.
fn mutated(whole: &[u8], places: &[usize], stream: &mut RandomStream) -> Vec<u8> {
    const OPCODES: &[u8] =
        b"(.012FGIJKLMNQRSTUVX]abcdeghjlopqrstu}\x80\x81\x85\x86\x87\x88\x89\x8a\x8c\x8e\x8f\x93\x94\x95";
    let mut bytes = whole.to_vec();
    for _ in 0..=stream.below(3) {
        if bytes.is_empty() {
            break;
        }
        let place = |stream: &mut RandomStream, most: usize| places[stream.below(places.len())].min(most - 1);
        let at = place(stream, bytes.len());
        let end = (at + 1 + stream.below(40)).min(bytes.len());
        match stream.below(8) {
            0 => bytes[at] = stream.below(256) as u8,
            1 => bytes[at] ^= 1 << stream.below(8),
            2 => bytes[at] = OPCODES[stream.below(OPCODES.len())],
            3 => bytes[at..end.min(at + 8)].fill(if stream.below(2) == 0 { 0xff } else { 0x7f }),
            4 => drop(bytes.drain(at..end)),
            5 => {
                let piece = bytes[at..end].to_vec();
                let to = place(stream, bytes.len());
                bytes.splice(to..to, piece);
            }
            6 => {
                let other = place(stream, bytes.len());
                bytes.swap(at, other);
            }
            _ if stream.below(4) == 0 => bytes.truncate(at),
            _ => bytes[at] = bytes[at].wrapping_add(1),
        }
    }
    bytes
}

/// Entries of an archive, and an archive of entries: checksums are right, so that damage within is
/// met.
fn unzipped(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let mut zip = ZipArchive::new(Cursor::new(bytes)).unwrap();
    let mut entries = Vec::new();
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i).unwrap();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        entries.push((entry.name().unwrap().to_string(), bytes));
    }
    entries
}

/// Runs `read` on a mutation; it may say anything in one line but must not take long or much. What
/// another process kept waiting is tried again.
fn bounded(what: &str, case: usize, read: impl Fn() -> Result<(), String>) {
    let (mut outcome, mut taken, mut seconds) = (Ok(()), 0, f64::INFINITY);
    for _ in 0..3 {
        let start = Instant::now();
        taken = measure(|| outcome = read()).bytes_max;
        seconds = start.elapsed().as_secs_f64().min(seconds);
        if seconds < SECONDS {
            break;
        }
    }
    assert!(seconds < SECONDS, "{what}, mutation {case}: {seconds} s");
    assert!(taken < BYTES, "{what}, mutation {case}: {taken} bytes");
    if let Err(error) = outcome {
        assert!(!error.is_empty() && error.lines().count() <= 1, "{what}, mutation {case}: {error:?}");
    }
}

#[test]
fn mutated_fits_are_errors_or_fits() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let file = |name: &str| std::fs::read(dir.join(name)).unwrap();
    let mut phalp = Vec::new();
    flate2_decoded(&file("phalp/demo_clip.pkl"), &mut phalp);
    let (torch, npz) = (file("gvhmr/hmr4d_results.pt"), file("romp/video_results.npz"));
    // Mutations within entries first: the archive around them is whole.
    let inner = [("torch", "data.pkl", unzipped(&torch)), ("npz", "results", unzipped(&npz))];
    let seeds = [
        ("wham", file("wham/wham_output.pkl")),
        ("phalp", phalp),
        ("phalp compressed", file("phalp/demo_clip.pkl")),
        ("prompthmr", file("prompthmr/results.pkl")),
        ("torch", torch),
        ("npz", npz),
    ];
    let each = mutations() / 10;
    for (name, whole) in &seeds {
        assert!(read_fit(name, whole, &video).is_ok(), "{name}");
        let places = structure(whole);
        for case in 0..each {
            let bytes = mutated(whole, &places, &mut RandomStream::new(&[1, case as u64]));
            bounded(name, case, || read_fit(name, &bytes, &video).map(drop).map_err(|e| e.to_string()));
        }
    }
    for (name, part, entries) in &inner {
        let at = entries.iter().position(|(entry, _)| entry.contains(part)).unwrap();
        let places = structure(&entries[at].1);
        for case in 0..each {
            let mut entries = entries.clone();
            entries[at].1 = mutated(&entries[at].1, &places, &mut RandomStream::new(&[2, case as u64]));
            let bytes = zipped(entries);
            bounded(name, case, || read_fit(name, &bytes, &video).map(drop).map_err(|e| e.to_string()));
        }
    }
}

fn flate2_decoded(bytes: &[u8], out: &mut Vec<u8>) {
    // PHALP's own compression, undone so that mutations are of what it holds.
    flate2::read::ZlibDecoder::new(bytes).read_to_end(out).unwrap();
}

#[test]
fn mutated_masks_and_easymocap_files_are_errors_or_read() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let out = Directory::new("import-damage");
    let seeds = [
        ("00000.png", "sam2/00000.png"),
        ("0000.png", "matanyone/pha/0000.png"),
        ("mask_00000.npy", "grounded_sam2/mask_data/mask_00000.npy"),
    ];
    let each = mutations() / 25;
    for (name, file) in seeds {
        let whole = std::fs::read(dir.join(file)).unwrap();
        let places: Vec<usize> = (0..whole.len().min(400)).collect();
        let path = out.path().join(name);
        for case in 0..each {
            std::fs::write(&path, mutated(&whole, &places, &mut RandomStream::new(&[3, case as u64]))).unwrap();
            bounded(name, case, || Levels::load(&path).map(drop).map_err(|e| e.to_string()));
        }
    }
    for file in ["smpl/000000.json", "intri.yml", "extri.yml"] {
        for other in ["smpl/000000.json", "intri.yml", "extri.yml"] {
            out.write(other, std::fs::read(dir.join("easymocap").join(other)).unwrap());
        }
        let whole = std::fs::read(dir.join("easymocap").join(file)).unwrap();
        let places: Vec<usize> = (0..whole.len()).collect();
        for case in 0..each {
            out.write(file, mutated(&whole, &places, &mut RandomStream::new(&[4, case as u64])));
            bounded(file, case, || read::read(out.path(), &video).map(drop).map_err(|e| e.to_string()));
        }
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
    refused("other.npz", &zipped([("a.npy", [1, 2])]), &["WHAM", "an archive of a"]);
    // Half a gigabyte of zeros in an archive of half a megabyte.
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file("results.npy", SimpleFileOptions::default()).unwrap();
    for _ in 0..512 {
        zip.write_all(&vec![0; 1 << 20]).unwrap();
    }
    let bomb = zip.finish().unwrap().into_inner();
    let taken = measure(|| refused("bomb.npz", &bomb, &["results", "limit"])).bytes_max;
    assert!(taken < BYTES, "{taken}");

    let frames = Directory::new("import-frames");
    frames.picture("a/1.png", (8, 8), |_, _| 9);
    frames.picture("a/2.png", (8, 9), |_, _| 9);
    let options = ImportOptions { frames: frames.path().join("a"), fit: dir.join("easymocap"), ..Default::default() };
    let error = import(&options, &out.path().join("capture")).unwrap_err().to_string();
    assert!(["2.png", "8×8", "8×9"].iter().all(|word| error.contains(word)), "{error}");
    assert!(!out.path().join("capture").exists());
}
