//! Files of weights in every form, and damaged ones.

use std::path::{Path, PathBuf};

use lpips::{Lpips, Trunk};
use testkit::files::{torch, zip};

use crate::formula::{Tensors, bytes, network, safetensors, weights};
use crate::noise;

/// An empty folder of a test's own.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("lpips").join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn saved(tensors: &Tensors, legacy: bool) -> Vec<u8> {
    let whole = |numbers: &[usize]| numbers.iter().map(|&n| n as u32).collect::<Vec<u32>>();
    let each = tensors.iter().enumerate().map(|(key, (name, (shape, _)))| {
        let strides: Vec<usize> = (0..shape.len()).map(|i| shape[i + 1..].iter().product()).collect();
        (name.as_str(), "FloatStorage", key, 0, whole(shape), whole(&strides))
    });
    let storages: Vec<_> = tensors.values().map(|(_, values)| (bytes(values), 4)).collect();
    torch(&each.collect::<Vec<_>>(), &storages, legacy)
}

fn archive(tensors: &Tensors) -> Vec<u8> {
    saved(tensors, false)
}

fn legacy(tensors: &Tensors) -> Vec<u8> {
    saved(tensors, true)
}

fn value(lpips: &Lpips) -> f64 {
    lpips.distance(&noise(3 * 32 * 32, 8), &noise(3 * 32 * 32, 9), 32, 32).unwrap()[0]
}

#[test]
fn every_form_of_file_and_directory_gives_the_same_network() {
    let (trunk, lin) = weights();
    let all: Tensors = trunk.clone().into_iter().chain(lin.clone()).collect();
    let expected = value(&network(Trunk::SqueezeNet));
    type Form = fn(&Tensors) -> Vec<u8>;
    let forms: [(&str, Form); 3] = [("safetensors", safetensors), ("pth", archive), ("pt", legacy)];
    for (end, form) in forms {
        let one = folder(&format!("one-{end}"));
        std::fs::write(one.join(format!("all.{end}")), form(&all)).unwrap();
        assert_eq!(value(&Lpips::load(&one.join(format!("all.{end}"))).unwrap()), expected, "{end}");
        assert_eq!(value(&Lpips::load(&one).unwrap()), expected, "{end} in a directory");
        let two = folder(&format!("two-{end}"));
        std::fs::write(two.join(format!("squeezenet1_1.{end}")), form(&trunk)).unwrap();
        std::fs::write(two.join(format!("a.{end}")), form(&lin)).unwrap();
        assert_eq!(
            value(&Lpips::load(&two.join(format!("squeezenet1_1.{end}"))).unwrap()),
            expected,
            "{end}, two files"
        );
        assert_eq!(value(&Lpips::load(&two).unwrap()), expected, "{end}, two files in a directory");
    }
}

fn refused(path: &Path, words: &[&str]) {
    let error = Lpips::load(path).err().unwrap_or_else(|| panic!("{} was read", path.display())).to_string();
    for word in words.iter().chain(&[path.file_name().unwrap().to_str().unwrap()]) {
        assert!(error.contains(word), "{word}: {error}");
    }
}

#[test]
fn what_is_wrong_is_named_with_file_tensor_and_shapes() {
    let folder = folder("wrong");
    let (trunk, lin) = weights();
    let lin_only = lin.clone();
    let all: Tensors = trunk.clone().into_iter().chain(lin).collect();
    let path = folder.join("net.pth");
    let check = |tensors: &Tensors, words: &[&str]| {
        std::fs::write(&path, archive(tensors)).unwrap();
        refused(&path, words);
        std::fs::write(&path, legacy(tensors)).unwrap();
        refused(&path, words);
    };
    check(&trunk, &["squeezenet", "lin0.weight"]);
    let mut wrong = all.clone();
    wrong.insert("features.4.squeeze.bias".to_owned(), (vec![17], vec![0.0; 17]));
    check(&wrong, &["`features.4.squeeze.bias`", "[17]", "[16]"]);
    wrong.remove("features.4.squeeze.bias");
    check(&wrong, &["lacks `features.4.squeeze.bias`", "[16]"]);
    wrong.insert("features.4.squeeze.bias".to_owned(), (vec![16], vec![f32::NAN; 16]));
    check(&wrong, &["`features.4.squeeze.bias`", "NaN"]);
    check(&Tensors::from([("fc.weight".to_owned(), (vec![1], vec![0.0]))]), &["no trunk", "fc.weight"]);
    std::fs::write(&path, b"not weights at all, but long enough to be").unwrap();
    refused(&path, &["neither"]);
    refused(&folder.join("none.pth"), &[]);
    // A damaged file beside the trunk is an error only if no other file has the linear layers.
    let beside = self::folder("beside");
    let (lonely, cut) = (beside.join("trunk.pth"), beside.join("zlin.pth"));
    std::fs::write(&lonely, archive(&trunk)).unwrap();
    std::fs::write(&cut, &archive(&lin_only)[..200]).unwrap();
    for path in [&lonely, &beside] {
        let error = Lpips::load(path).err().unwrap().to_string();
        assert!(error.contains("zlin.pth"), "{error}");
    }
    std::fs::write(beside.join("lin.pth"), archive(&lin_only)).unwrap();
    for path in [&lonely, &beside] {
        Lpips::load(path).unwrap();
    }
    let empty = self::folder("empty");
    refused(&empty, &["no .safetensors"]);
}

#[test]
fn pickles_that_would_run_something_are_refused_by_name() {
    let path = folder("evil").join("net.pth");
    let pickle = b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00ls\x85R.";
    std::fs::write(&path, zip([("x/data.pkl", pickle)])).unwrap();
    refused(&path, &["os system", "not allowed"]);
}
