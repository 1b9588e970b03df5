//! Checkpoints that are broken, foreign or forged: an error that names the file, never a panic.

use crate::common;

use std::collections::HashMap;
use std::sync::OnceLock;

use common::{body, capture, config, scene};
use occnerf::capture::Capture;
use occnerf::{Config, Error, Method, Scene, Trainer, checkpoint_config};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use smpl::SparseRows;
use testkit::files::Directory;

/// A checkpoint after two steps.
fn good() -> &'static [u8] {
    static GOOD: OnceLock<Vec<u8>> = OnceLock::new();
    GOOD.get_or_init(|| saved(config(Method::Occnerf), 2))
}

/// A checkpoint after some steps.
fn saved(config: Config, steps: usize) -> Vec<u8> {
    let mut trainer = Trainer::new(scene(), config).unwrap();
    (0..steps).for_each(|_| assert!(trainer.step().unwrap().loss.is_finite()));
    let dir = Directory::new("saved");
    trainer.save(&dir.file("good.safetensors")).unwrap();
    std::fs::read(dir.file("good.safetensors")).unwrap()
}

fn resume<'a>(scene: &'a Scene, bytes: &[u8]) -> Result<Trainer<'a>, Error> {
    let dir = Directory::new("resumed");
    dir.write("resumed.safetensors", bytes);
    Trainer::resume(scene, &dir.file("resumed.safetensors"))
}

/// The message of an error that must come and must name the file.
fn refused(scene: &Scene, bytes: &[u8], case: &str) -> String {
    let Err(error) = resume(scene, bytes) else { panic!("{case}: accepted") };
    let message = error.to_string();
    assert!(message.contains("resumed.safetensors"), "{case}: `{message}` does not name the file");
    message
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
    let dir = Directory::new("copy");
    let path = dir.file("copy.safetensors");
    let trainer = resume(scene(), good()).unwrap();
    assert_eq!((trainer.steps_done(), trainer.model().config()), (2, &config(Method::Occnerf)));
    trainer.save(&path).unwrap();
    assert_eq!(checkpoint_config(&path).unwrap(), config(Method::Occnerf));
    assert!(std::fs::read(&path).unwrap() == good());
    // Taking apart and putting together is harmless.
    assert!(resume(scene(), &forged(good(), |_, _| ())).is_ok());
}

#[test]
fn a_checkpoint_cut_short_anywhere_is_refused() {
    let bytes = good();
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let lengths = (0..header).step_by(13).chain(header - 3..header + 3).chain((header..bytes.len()).step_by(997));
    for length in lengths.chain([bytes.len() - 1]) {
        refused(scene(), &bytes[..length], &format!("{length} of {} bytes", bytes.len()));
    }
    refused(scene(), &[bytes, b"more"].concat(), "bytes behind the end");
}

/// The checkpoint with the bytes of an array changed from a number on.
fn with_bytes(bytes: &[u8], name: &str, at: usize, by: f32) -> Vec<u8> {
    forged(bytes, |_, arrays| arrays.get_mut(name).unwrap().2[at..at + 4].copy_from_slice(&by.to_le_bytes()))
}

#[test]
fn arrays_that_are_missing_misshapen_or_not_finite_are_refused_by_name() {
    for name in ["field", "table", "vertices.first_moment", "field.second_moment"] {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let message = refused(scene(), &with_bytes(good(), name, 8, bad), name);
            assert!(message.contains(name) && message.contains("at 2"), "{message}");
        }
    }
    // Adam takes its square root.
    let negative = with_bytes(good(), "field.second_moment", 0, -1.0);
    assert!(refused(scene(), &negative, "negative").contains("field.second_moment"));
    for name in ["field", "table.first_moment", "vertices", "visibility_counts"] {
        let missing = forged(good(), |_, arrays| drop(arrays.remove(name)));
        assert!(refused(scene(), &missing, name).contains(name));
        type Change = fn(&mut (Dtype, Vec<usize>, Vec<u8>));
        let changes: [Change; 3] = [
            |(dtype, shape, data)| {
                shape[0] -= 1;
                data.truncate(shape[0] * if *dtype == Dtype::U64 { 8 } else { 4 });
            },
            |(_, shape, _)| shape.insert(0, 1),
            |(dtype, ..)| *dtype = if *dtype == Dtype::U64 { Dtype::I64 } else { Dtype::I32 },
        ];
        for change in changes {
            let forged = forged(good(), |_, arrays| change(arrays.get_mut(name).unwrap()));
            assert!(refused(scene(), &forged, name).contains("expected"));
        }
    }
}

#[test]
fn foreign_headers_are_refused_and_say_what_was_expected() {
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
        let with = forged(good(), |header, _| drop(header.insert(key.to_owned(), value.to_owned())));
        let message = refused(scene(), &with, key);
        assert!(message.contains(hint), "{key} = {value}: {message}");
        let without = forged(good(), |header, _| drop(header.remove(key)));
        refused(scene(), &without, key);
    }
}

#[test]
fn configurations_that_cannot_be_run_are_refused() {
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
        let edited = forged(good(), |header, _| {
            let config = header.get_mut("config").unwrap();
            *config = common::replace_line(config, key, by);
        });
        refused(scene(), &edited, by);
    }
}

#[test]
fn another_body_or_another_scene_is_refused() {
    let config = config(Method::Occnerf);
    let renamed = Capture { name: "someone else".to_owned(), ..capture() };
    let other = Scene::new(&renamed, body(), &config).unwrap();
    let message = refused(&other, good(), "name");
    assert!(message.contains("someone else") && message.contains("ellipsoid"), "{message}");
    // The same name, but a body of other vertices.
    let mut finer = body().clone();
    finer.v_template.push(finer.v_template[0]);
    finer.shapedirs.push(finer.shapedirs[0]);
    let vertices = finer.v_template.len();
    finer.posedirs = SparseRows::from_rows(vec![Vec::<(u32, glam::Vec3)>::new(); vertices]);
    let row = |v: usize| body().weights.row(v).map(|(joint, w)| (joint as u32, w));
    finer.weights = SparseRows::from_rows((0..vertices - 1).chain([0]).map(row));
    let other = Scene::new(&capture(), &finer, &config).unwrap();
    refused(&other, good(), "vertices");
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
    let (path, bytes) = (dir.file("good.safetensors"), saved(config.clone(), 1));
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
    let mut config = config(Method::Occnerf);
    config.motion.shell_interval = 1;
    let bytes = saved(config, 2);
    assert!(resume(scene(), &forged(&bytes, |_, _| ())).is_ok());
    for end in [-0.01f32, 7.0, f32::NAN, f32::INFINITY] {
        let message = refused(scene(), &with_bytes(&bytes, "shell", 4, end), "an end beyond the margin");
        assert!(message.contains("`shell` is") && message.contains("at 1"), "{message}");
    }
    let without = forged(&bytes, |_, arrays| drop(arrays.remove("shell")));
    assert!(refused(scene(), &without, "no shell").contains("`shell`"));
}
