//! Files of weights in every form, and damaged ones.

use std::path::Path;

use lpips::{Lpips, Trunk};
use testkit::files::{Directory, torch, zip};

use crate::formula::{Tensors, bytes, network, safetensors, weights};
use crate::noise;

fn saved(tensors: &Tensors, legacy: bool) -> Vec<u8> {
    let whole = |numbers: &[usize]| numbers.iter().map(|&n| n as u32).collect::<Vec<u32>>();
    let each = tensors.iter().enumerate().map(|(key, (name, (shape, _)))| {
        let strides: Vec<usize> = (0..shape.len()).map(|i| shape[i + 1..].iter().product()).collect();
        (name.as_str(), "FloatStorage", key, 0, whole(shape), whole(&strides))
    });
    let storages: Vec<_> = tensors.values().map(|(_, values)| (bytes(values), 4)).collect();
    torch(&each.collect::<Vec<_>>(), &storages, legacy)
}

fn value(lpips: &Lpips) -> f64 {
    lpips.distance(&noise(3 * 32 * 32, 8), &noise(3 * 32 * 32, 9), 32, 32).unwrap()[0]
}

#[test]
fn every_form_of_file_and_directory_gives_the_same_network() {
    let (trunk, lin) = weights();
    let all: Tensors = trunk.clone().into_iter().chain(lin.clone()).collect();
    let expected = value(&network(Trunk::SqueezeNet));
    for end in ["safetensors", "pth", "pt"] {
        let form = |tensors: &Tensors| match end {
            "safetensors" => safetensors(tensors),
            end => saved(tensors, end == "pt"),
        };
        let (one, two) = (Directory::new("one"), Directory::new("two"));
        let [whole, part, lin_file] = ["all", "squeezenet1_1", "a"].map(|stem| format!("{stem}.{end}"));
        one.write(&whole, form(&all));
        two.write(&part, form(&trunk));
        two.write(&lin_file, form(&lin));
        // A file or its directory, with one file or with two.
        for path in [one.file(&whole), one.path().into(), two.file(&part), two.path().into()] {
            assert_eq!(value(&Lpips::load(&path).unwrap()), expected, "{}", path.display());
        }
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
    let dir = Directory::new("wrong");
    let (trunk, lin) = weights();
    let all: Tensors = trunk.clone().into_iter().chain(lin.clone()).collect();
    let path = dir.file("net.pth");
    let check = |tensors: &Tensors, words: &[&str]| {
        for legacy in [false, true] {
            dir.write("net.pth", saved(tensors, legacy));
            refused(&path, words);
        }
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
    dir.write("net.pth", b"not weights at all, but long enough to be");
    refused(&path, &["neither"]);
    refused(&dir.file("none.pth"), &[]);
    // A damaged file beside the trunk is an error only if no other file has the linear layers.
    let beside = Directory::new("beside");
    beside.write("trunk.pth", saved(&trunk, false));
    beside.write("zlin.pth", &saved(&lin, false)[..200]);
    let paths = [beside.file("trunk.pth"), beside.path().into()];
    for path in &paths {
        let error = Lpips::load(path).err().unwrap().to_string();
        assert!(error.contains("zlin.pth"), "{error}");
    }
    beside.write("lin.pth", saved(&lin, false));
    paths.iter().for_each(|path| drop(Lpips::load(path).unwrap()));
    refused(Directory::new("empty").path(), &["no .safetensors"]);
    // A program.
    let pickle = b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00ls\x85R.";
    dir.write("net.pth", zip([("x/data.pkl", pickle)]));
    refused(&path, &["os system", "not allowed"]);
}
