//! Files of weights in every form, and damaged ones.

use std::path::{Path, PathBuf};

use lpips::{Lpips, Trunk};
use testkit::files::zip;

use crate::formula::{Tensors, bytes, network, safetensors, weights};
use crate::noise;

/// An empty folder of a test's own.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("lpips").join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}

/// The pickle of a state dictionary as `torch.save` writes it: protocol 2, an `OrderedDict` with
/// `_metadata`.
fn state_dict(tensors: &Tensors, legacy: bool) -> Vec<u8> {
    let text = |out: &mut Vec<u8>, text: &str| {
        out.push(b'X');
        out.extend((text.len() as u32).to_le_bytes());
        out.extend(text.as_bytes());
    };
    let whole = |out: &mut Vec<u8>, n: usize| {
        out.push(b'J');
        out.extend((n as u32).to_le_bytes());
    };
    let list = |out: &mut Vec<u8>, numbers: &[usize]| {
        out.push(b'(');
        numbers.iter().for_each(|&n| whole(out, n));
        out.push(b't');
    };
    let mut out = b"\x80\x02ccollections\nOrderedDict\nq\x00)Rq\x01(".to_vec();
    for (key, (name, (shape, values))) in tensors.iter().enumerate() {
        text(&mut out, name);
        out.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        text(&mut out, "storage");
        out.extend(b"ctorch\nFloatStorage\n");
        text(&mut out, &key.to_string());
        text(&mut out, "cpu");
        whole(&mut out, values.len());
        if legacy {
            out.push(b'N');
        }
        out.extend(b"tQK\x00");
        list(&mut out, shape);
        let strides: Vec<usize> = (0..shape.len()).map(|i| shape[i + 1..].iter().product()).collect();
        list(&mut out, &strides);
        out.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    }
    out.extend(b"u}");
    text(&mut out, "_metadata");
    out.extend(b"h\x00)Rsb.");
    out
}

fn archive(tensors: &Tensors) -> Vec<u8> {
    let first = [
        ("weights/data.pkl".to_owned(), state_dict(tensors, false)),
        ("weights/byteorder".to_owned(), b"little".to_vec()),
    ];
    let storages = tensors.values().enumerate();
    let storages = storages.map(|(key, tensor)| (format!("weights/data/{key}"), bytes(&tensor.1)));
    zip(first.into_iter().chain(storages))
}

fn legacy(tensors: &Tensors) -> Vec<u8> {
    let mut out = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.".to_vec();
    out.extend(b"\x80\x02}X\x0d\x00\x00\x00little_endian\x88s.");
    out.extend(state_dict(tensors, true));
    out.extend(b"\x80\x02](");
    for key in 0..tensors.len() {
        let key = key.to_string();
        out.push(b'U');
        out.push(key.len() as u8);
        out.extend(key.as_bytes());
    }
    out.extend(b"e.");
    for (_, values) in tensors.values() {
        out.extend((values.len() as u64).to_le_bytes());
        out.extend(bytes(values));
    }
    out
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
