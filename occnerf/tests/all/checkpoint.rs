//! Checkpoints that are broken, foreign or forged: an error that names the file, never a panic.

use crate::common;

use std::collections::HashMap;
use std::path::Path;

use common::{body, capture, config, scene};
use occnerf::{Error, Method, Scene, Trainer, checkpoint_config};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use testkit::files::Directory;

/// A checkpoint after two steps.
fn good(dir: &Directory) -> Vec<u8> {
    let mut trainer = Trainer::new(scene(), config(Method::Occnerf)).unwrap();
    trainer.step().unwrap();
    trainer.step().unwrap();
    let path = dir.file("good.safetensors");
    trainer.save(&path).unwrap();
    std::fs::read(path).unwrap()
}

fn resume<'a>(scene: &'a Scene, path: &Path, bytes: &[u8]) -> Result<Trainer<'a>, Error> {
    std::fs::write(path, bytes).unwrap();
    Trainer::resume(scene, path)
}

/// The message of an error that must come and must name the file.
fn refused(scene: &Scene, path: &Path, bytes: &[u8], case: &str) -> String {
    let message = match resume(scene, path, bytes) {
        Ok(_) => panic!("{case}: accepted"),
        Err(error) => error.to_string(),
    };
    let name = path.file_name().unwrap().to_str().unwrap();
    assert!(message.contains(name), "{case}: `{message}` does not name the file");
    message
}

fn header_length(bytes: &[u8]) -> usize {
    8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize
}

type Arrays = HashMap<String, (Dtype, Vec<usize>, Vec<u8>)>;

/// Takes a checkpoint apart, lets `change` at it, and puts it together again.
fn forged(bytes: &[u8], change: impl FnOnce(&mut HashMap<String, String>, &mut Arrays)) -> Vec<u8> {
    let (_, metadata) = SafeTensors::read_metadata(bytes).unwrap();
    let mut header = metadata.metadata().clone().unwrap();
    let tensors = SafeTensors::deserialize(bytes).unwrap();
    let array = |view: &TensorView<'_>| (view.dtype(), view.shape().to_vec(), view.data().to_vec());
    let mut arrays: Arrays = tensors.tensors().iter().map(|(name, view)| (name.clone(), array(view))).collect();
    change(&mut header, &mut arrays);
    let views = arrays
        .iter()
        .map(|(name, (dtype, shape, data))| (name.as_str(), TensorView::new(*dtype, shape.clone(), data).unwrap()));
    safetensors::serialize(views, Some(header)).unwrap()
}

#[test]
fn a_good_checkpoint_is_accepted_and_saved_again_byte_for_byte() {
    let dir = Directory::new("good");
    let bytes = good(&dir);
    let path = dir.file("copy.safetensors");
    let trainer = resume(scene(), &path, &bytes).unwrap();
    assert_eq!((trainer.steps_done(), trainer.model().config()), (2, &config(Method::Occnerf)));
    assert_eq!(checkpoint_config(&path).unwrap(), config(Method::Occnerf));
    trainer.save(&path).unwrap();
    assert!(std::fs::read(&path).unwrap() == bytes);
    assert!(
        resume(scene(), &path, &forged(&bytes, |_, _| ())).is_ok(),
        "taking apart and putting together is harmless"
    );
}

#[test]
fn a_checkpoint_cut_short_anywhere_is_refused() {
    let dir = Directory::new("short");
    let bytes = good(&dir);
    let path = dir.file("short.safetensors");
    let header = header_length(&bytes);
    let lengths = (0..header).step_by(13).chain(header - 3..header + 3).chain((header..bytes.len()).step_by(997));
    for length in lengths.chain([bytes.len() - 1]) {
        refused(scene(), &path, &bytes[..length], &format!("{length} of {} bytes", bytes.len()));
    }
    let longer = [bytes.as_slice(), b"more"].concat();
    refused(scene(), &path, &longer, "bytes behind the end");
}

#[test]
fn numbers_that_cannot_be_are_refused_by_name() {
    let dir = Directory::new("nan");
    let bytes = good(&dir);
    let path = dir.file("nan.safetensors");
    for name in ["field", "table", "vertices.first_moment", "field.second_moment"] {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let forged = forged(&bytes, |_, arrays| {
                arrays.get_mut(name).unwrap().2[8..12].copy_from_slice(&bad.to_le_bytes());
            });
            let message = refused(scene(), &path, &forged, name);
            assert!(message.contains(name) && message.contains("at 2"), "{message}");
        }
    }
    // Adam takes its square root.
    let forged = forged(&bytes, |_, arrays| {
        arrays.get_mut("field.second_moment").unwrap().2[..4].copy_from_slice(&(-1.0f32).to_le_bytes());
    });
    assert!(refused(scene(), &path, &forged, "negative").contains("field.second_moment"));
}

#[test]
fn missing_and_misshapen_arrays_are_refused_by_name() {
    let dir = Directory::new("shape");
    let bytes = good(&dir);
    let path = dir.file("shape.safetensors");
    for name in ["field", "table.first_moment", "vertices", "visibility_counts"] {
        let missing = forged(&bytes, |_, arrays| drop(arrays.remove(name)));
        assert!(refused(scene(), &path, &missing, name).contains(name));
        let short = forged(&bytes, |_, arrays| {
            let (dtype, shape, data) = arrays.get_mut(name).unwrap();
            shape[0] -= 1;
            data.truncate(shape[0] * if *dtype == Dtype::U64 { 8 } else { 4 });
        });
        assert!(refused(scene(), &path, &short, name).contains("expected"));
        let square = forged(&bytes, |_, arrays| {
            let shape = &mut arrays.get_mut(name).unwrap().1;
            *shape = vec![1, shape[0]];
        });
        refused(scene(), &path, &square, name);
        let integers = forged(&bytes, |_, arrays| {
            let dtype = &mut arrays.get_mut(name).unwrap().0;
            *dtype = if *dtype == Dtype::U64 { Dtype::I64 } else { Dtype::I32 };
        });
        refused(scene(), &path, &integers, name);
    }
}

#[test]
fn foreign_headers_are_refused_and_say_what_was_expected() {
    let dir = Directory::new("header");
    let bytes = good(&dir);
    let path = dir.file("header.safetensors");
    let set = |key: &'static str, value: &str| {
        let value = value.to_owned();
        forged(&bytes, move |header, _| drop(header.insert(key.to_owned(), value)))
    };
    for (key, value, hint) in [
        ("format", "something-else", "something-else"),
        ("version", "3", "version 3"),
        ("version", "2", "version 2"),
        ("scene", "another", "another"),
        ("steps_done", "-1", "-1"),
        ("steps_done", "many", "many"),
        ("steps_done", "2.5", "2.5"),
        // Counting on from there would overflow.
        ("steps_done", "18446744073709551615", "steps_done"),
        ("config", "seed = 1", "config"),
        ("config", "not toml at all [", "config"),
    ] {
        let message = refused(scene(), &path, &set(key, value), key);
        assert!(message.contains(hint), "{key} = {value}: {message}");
    }
    for key in ["format", "version", "scene", "steps_done", "config"] {
        let without = forged(&bytes, |header, _| drop(header.remove(key)));
        refused(scene(), &path, &without, key);
    }
}

/// The checkpoint with one line of its configuration replaced.
fn edited(bytes: &[u8], key: &str, by: &str) -> Vec<u8> {
    forged(bytes, |header, _| {
        let config = header.get_mut("config").unwrap();
        *config = common::replace_line(config, key, by);
    })
}

#[test]
fn configurations_that_cannot_be_run_are_refused() {
    let dir = Directory::new("config");
    let bytes = good(&dir);
    let path = dir.file("config.safetensors");
    for (key, by) in [
        ("samples", "samples = 0"),
        ("width", "width = 100000"),
        ("width", "width = 17"),
        ("levels", "levels = 0"),
        ("levels", "levels = 3"),
        ("log2_table_size", "log2_table_size = 40"),
        ("n_min", "n_min = 0"),
        ("margin", "margin = nan"),
        ("method", "method = \"hash-point\""),
        // The scene's neighbour lists have another length than the field wants.
        ("k", "k = 20"),
        ("k", "k = 5"),
        ("coarse_levels", "coarse_levels = 0"),
    ] {
        refused(scene(), &path, &edited(&bytes, key, by), by);
    }
}

#[test]
fn another_body_or_another_scene_is_refused() {
    let dir = Directory::new("scene");
    let bytes = good(&dir);
    let path = dir.file("scene.safetensors");
    let config = config(Method::Occnerf);
    let mut renamed = capture();
    renamed.name = "someone else".to_owned();
    let other = Scene::new(&renamed, body(), &config).unwrap();
    let message = refused(&other, &path, &bytes, "name");
    assert!(message.contains("someone else") && message.contains("ellipsoid"), "{message}");
    // The same name, but a body of other vertices.
    let mut finer = body().clone();
    finer.v_template.push(finer.v_template[0]);
    finer.shapedirs.push(finer.shapedirs[0]);
    finer.posedirs = smpl::SparseRows::from_rows(finer.v_template.iter().map(|_| Vec::<(u32, glam::Vec3)>::new()));
    let rows = (0..finer.v_template.len() - 1).chain([0]);
    let rows: Vec<Vec<(u32, f32)>> =
        rows.map(|v| body().weights.row(v).map(|(joint, w)| (joint as u32, w)).collect()).collect();
    finer.weights = smpl::SparseRows::from_rows(rows);
    let other = Scene::new(&capture(), &finer, &config).unwrap();
    refused(&other, &path, &bytes, "vertices");
}

#[test]
fn files_that_are_not_there_or_not_files_are_named() {
    let dir = Directory::new("absent");
    for path in [dir.file("absent.safetensors"), dir.file("")] {
        let name = path.display().to_string();
        for message in [
            Trainer::resume(scene(), &path).err().unwrap().to_string(),
            checkpoint_config(&path).unwrap_err().to_string(),
        ] {
            assert!(message.contains(&name), "{message}");
        }
    }
    let trainer = Trainer::new(scene(), config(Method::HashPoint)).unwrap();
    let message = trainer.save(&dir.file("no/such/folder.safetensors")).unwrap_err().to_string();
    assert!(message.contains("folder"), "{message}");
}

#[test]
fn a_training_that_has_diverged_leaves_the_good_checkpoint_alone() {
    let dir = Directory::new("diverged");
    let mut config = config(Method::HashPoint);
    let path = dir.file("good.safetensors");
    let mut trainer = Trainer::new(scene(), config.clone()).unwrap();
    trainer.step().unwrap();
    trainer.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    (config.rates.field, config.rates.table) = (f32::MAX, f32::MAX);
    let mut wild = Trainer::new(scene(), config).unwrap();
    let mut outcome = wild.save(&path);
    for _ in 0..20 {
        std::fs::write(&path, &bytes).unwrap();
        wild.step().unwrap();
        outcome = wild.save(&path);
        if outcome.is_err() {
            break;
        }
    }
    let error = outcome.unwrap_err();
    assert!(matches!(error, Error::Diverged { .. }), "{error}");
    assert!(error.to_string().contains("rates"), "{error}");
    assert!(std::fs::read(&path).unwrap() == bytes);
}

#[test]
fn a_checkpoint_must_say_how_far_its_field_reaches() {
    let dir = Directory::new("shell");
    let path = dir.file("shell.safetensors");
    let mut config = config(Method::Occnerf);
    config.motion.shell_interval = 1;
    let mut trainer = Trainer::new(scene(), config).unwrap();
    trainer.step().unwrap();
    trainer.step().unwrap();
    trainer.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert!(resume(scene(), &path, &forged(&bytes, |_, _| ())).is_ok());
    for end in [-0.01f32, 7.0, f32::NAN, f32::INFINITY] {
        let forged =
            forged(&bytes, |_, arrays| arrays.get_mut("shell").unwrap().2[4..8].copy_from_slice(&end.to_le_bytes()));
        let message = refused(scene(), &path, &forged, "an end beyond the margin");
        assert!(message.contains("`shell` is") && message.contains("at 1"), "{message}");
    }
    let without = forged(&bytes, |_, arrays| drop(arrays.remove("shell")));
    assert!(refused(scene(), &path, &without, "no shell").contains("`shell`"));
}
