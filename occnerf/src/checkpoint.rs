//! Checkpoints: safetensors with the configuration and a version in the header, replaced atomically.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::io::Write;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors};

use crate::Error;
use crate::atomic::replace_file;
use crate::config::Config;
use crate::parameters::{PARTS, Part};
use crate::scene::Scene;
use crate::shell::Shell;
use crate::trainer::Trainer;

const FORMAT: &str = "occnerf-checkpoint";
const VERSION: &str = "1";
/// Of pruned models: a bit for each row of the table, lowest first in each byte, and the rows whose bit is set.
const PRUNED: &str = "2";
const KEPT: &str = "table.kept";
/// Where `motion.shell_interval` is not 0: how far the field reaches over each vertex.
const SHELL: &str = "shell";
/// What is known of restarts, in the header as JSON; files from before there were any have none.
const RESTARTS: &str = "restarts";
/// Larger files are not ours: the paper's table with both moments has 0.3 GB.
const MAX_BYTES: u64 = 4 << 30;
/// Far more than anybody trains, and far from where counting on would overflow.
const MAX_STEPS: u64 = 1 << 40;

impl Trainer<'_> {
    /// Writes everything that training goes on from. An old file survives until the new one is complete and on the disk.
    ///
    /// # Errors
    /// [`Error::Diverged`] where a number is not finite, so that what could be gone on from is not replaced by what cannot;
    /// [`Error::Io`].
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        self.check_finite()?;
        let config = toml::to_string(&self.config).map_err(|e| file(path, format!("configuration: {e}")))?;
        let kept = self.parameters.kept_rows.as_deref();
        let restarts = serde_json::to_string(&self.restarts).map_err(|e| file(path, format!("{RESTARTS}: {e}")))?;
        let header = BTreeMap::from([
            ("format", FORMAT.to_owned()),
            ("version", if kept.is_some() { PRUNED } else { VERSION }.to_owned()),
            ("steps_done", self.steps_done.to_string()),
            ("scene", self.scene.name.clone()),
            ("config", config),
            (RESTARTS, restarts),
        ]);
        let mut tensors: Vec<(String, Array<'_>)> = Vec::new();
        for (part, name) in PARTS {
            let adam = &self.parameters.optimisers[part as usize];
            let values = self.parameters.get(part);
            for (suffix, array) in [("", values), (".first_moment", &adam.first), (".second_moment", &adam.second)] {
                let left = match kept.filter(|_| part == Part::Table) {
                    Some(kept) => Cow::Owned(rows_left(array, kept)),
                    None => Cow::Borrowed(array),
                };
                tensors.push((format!("{name}{suffix}"), Array::Floats(left)));
            }
        }
        if let Some(kept) = kept {
            let byte = |bits: &[bool]| bits.iter().rev().fold(0, |byte, &bit| byte << 1 | u8::from(bit));
            tensors.push((KEPT.to_owned(), Array::Bits(kept.chunks(8).map(byte).collect())));
        }
        if self.config.motion.shell_interval > 0 {
            tensors.push((SHELL.to_owned(), Array::Floats(Cow::Borrowed(&self.shell.vertices))));
        }
        tensors.push(("visibility_counts".to_owned(), Array::Counts(self.counts.counts())));
        replace_file(path, |to| write(to, &header, tensors))
            .map_err(|source| Error::Io { path: path.to_owned(), source })
    }

    fn check_finite(&self) -> Result<(), Error> {
        for (part, name) in PARTS {
            let adam = &self.parameters.optimisers[part as usize];
            for (suffix, array) in
                [("", self.parameters.get(part)), (".first_moment", &adam.first), (".second_moment", &adam.second)]
            {
                if let Some(at) = array.iter().position(|v| !v.is_finite()) {
                    let key = format!("{name}{suffix}");
                    return Err(Error::Diverged { step: self.steps_done, key, value: array[at] });
                }
            }
        }
        Ok(())
    }
}

/// One of a checkpoint's arrays.
enum Array<'a> {
    Floats(Cow<'a, [f32]>),
    Counts(&'a [u64]),
    Bits(Vec<u8>),
}

impl Array<'_> {
    fn dtype(&self) -> Dtype {
        match self {
            Self::Floats(_) => Dtype::F32,
            Self::Counts(_) => Dtype::U64,
            Self::Bits(_) => Dtype::U8,
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Floats(values) => values.len(),
            Self::Counts(counts) => counts.len(),
            Self::Bits(bits) => bits.len(),
        }
    }

    fn write(&self, to: &mut impl Write) -> std::io::Result<()> {
        match self {
            Self::Floats(values) => values.iter().try_for_each(|v| to.write_all(&v.to_le_bytes())),
            Self::Counts(counts) => counts.iter().try_for_each(|c| to.write_all(&c.to_le_bytes())),
            Self::Bits(bits) => to.write_all(bits),
        }
    }
}

/// What a safetensors header says of an array, its keys in order.
#[derive(serde::Serialize)]
struct Entry {
    data_offsets: [usize; 2],
    dtype: Dtype,
    shape: [usize; 1],
}

/// Writes a safetensors file array by array (the crate's own writers want all of them as bytes, or make a file that nobody else may
/// read). Equal models are equal files: keys are in order.
fn write(
    to: &mut impl Write,
    header: &BTreeMap<&str, String>,
    mut tensors: Vec<(String, Array<'_>)>,
) -> std::io::Result<()> {
    // The widest first: all are aligned.
    tensors.sort_by(|(a_name, a), (b_name, b)| b.dtype().cmp(&a.dtype()).then(a_name.cmp(b_name)));
    let mut keys = BTreeMap::from([("__metadata__", serde_json::to_value(header)?)]);
    let mut end = 0;
    for (name, array) in &tensors {
        let start = end;
        end += array.len() * array.dtype().bitsize() / 8;
        let entry = Entry { data_offsets: [start, end], dtype: array.dtype(), shape: [array.len()] };
        keys.insert(name, serde_json::to_value(entry)?);
    }
    let mut text = serde_json::to_vec(&keys)?;
    text.resize(text.len().next_multiple_of(8), b' ');
    to.write_all(&(text.len() as u64).to_le_bytes())?;
    to.write_all(&text)?;
    tensors.iter().try_for_each(|(_, array)| array.write(to))
}

impl<'a> Trainer<'a> {
    /// Goes on from a checkpoint of the same scene and configuration; the number of steps may differ.
    pub fn resume(scene: &'a Scene, path: &Path) -> Result<Self, Error> {
        let bytes = read(path)?;
        let (header, tensors) = parse(path, &bytes)?;
        let get = |key: &str| header.get(key).ok_or_else(|| file(path, format!("header lacks `{key}`")));
        let steps_done = get("steps_done")?;
        let steps_done: u64 = steps_done.parse().ok().filter(|&steps| steps <= MAX_STEPS).ok_or_else(|| {
            file(path, format!("header `steps_done` is {steps_done:?}, expected a whole number up to {MAX_STEPS}"))
        })?;
        let trained_on = get("scene")?;
        if *trained_on != scene.name {
            return Err(file(path, format!("was trained on scene {trained_on:?}, expected {:?}", scene.name)));
        }
        let mut trainer = Self::new(scene, config_of(path, &header)?).map_err(|e| file(path, e.to_string()))?;
        trainer.steps_done = steps_done;
        if let Some(text) = header.get(RESTARTS) {
            let wrong = |what: String| file(path, format!("header `{RESTARTS}`: {what}"));
            trainer.restarts = serde_json::from_str(text).map_err(|e| wrong(e.to_string()))?;
            trainer.restarts.check(steps_done).map_err(wrong)?;
        }
        if get("version")? == PRUNED {
            let rows = trainer.parameters.get(Part::Table).len() / trainer.config.encoding.features.max(1);
            let bits = tensor(path, &tensors, KEPT, Dtype::U8, rows.div_ceil(8))?;
            let kept = (0..rows).map(|row| bits[row / 8] >> (row % 8) & 1 == 1);
            trainer.parameters.kept_rows = Some(kept.collect());
        }
        for (part, name) in PARTS {
            let all = trainer.parameters.get(part).len();
            let expected = trainer.parameters.count(part);
            let kept = trainer.parameters.kept_rows.clone().filter(|_| part == Part::Table);
            let read = |key: String| {
                let values = floats(path, &tensors, &key, expected)?;
                Ok::<_, Error>(match &kept {
                    Some(kept) => rows_filled(&values, kept, all),
                    None => values,
                })
            };
            *trainer.parameters.get_mut(part) = read(name.to_owned())?;
            let adam = &mut trainer.parameters.optimisers[part as usize];
            adam.first = read(format!("{name}.first_moment"))?;
            adam.second = read(format!("{name}.second_moment"))?;
            if let Some(at) = adam.second.iter().position(|&v| v < 0.0) {
                let what = format!("`{name}.second_moment` is {} at {at}, expected at least 0", adam.second[at]);
                return Err(file(path, what));
            }
            adam.steps = steps_done - trainer.restarts.begun;
        }
        let counts = tensor(path, &tensors, "visibility_counts", Dtype::U64, scene.canonical.vertices.len())?;
        let counts = counts.chunks_exact(8).map(|b| b.iter().rev().fold(0u64, |sum, &byte| sum << 8 | u64::from(byte)));
        trainer.counts = visibility::VisibilityCounts::from_counts(counts.collect());
        if trainer.config.motion.shell_interval > 0 {
            let ends = floats(path, &tensors, SHELL, scene.canonical.vertices.len())?;
            let whole = trainer.shell.farthest;
            if let Some(at) = ends.iter().position(|end| !(0.0..=whole).contains(end)) {
                return Err(file(path, format!("`{SHELL}` is {} at {at}, expected 0 to {whole}", ends[at])));
            }
            trainer.shell = Shell::new(scene, ends);
        }
        trainer.refresh_volume();
        Ok(trainer)
    }
}

/// The kept rows of `array`, one after another.
fn rows_left(array: &[f32], kept: &[bool]) -> Vec<f32> {
    let rows = array.chunks_exact((array.len() / kept.len().max(1)).max(1));
    rows.zip(kept).filter(|(_, kept)| **kept).flat_map(|(row, _)| row).copied().collect()
}

/// All rows, `all` numbers, those that were not kept zero.
fn rows_filled(values: &[f32], kept: &[bool], all: usize) -> Vec<f32> {
    let width = (all / kept.len().max(1)).max(1);
    let (mut rows, mut array) = (values.chunks_exact(width), vec![0.0; all]);
    for (row, _) in array.chunks_exact_mut(width).zip(kept).filter(|(_, kept)| **kept) {
        rows.next().into_iter().for_each(|values| row.copy_from_slice(values));
    }
    array
}

/// The configuration that a checkpoint was written with.
pub fn checkpoint_config(path: &Path) -> Result<Config, Error> {
    let bytes = read(path)?;
    let (header, _) = parse(path, &bytes)?;
    config_of(path, &header)
}

fn read(path: &Path) -> Result<Vec<u8>, Error> {
    let io = |source| Error::Io { path: path.to_owned(), source };
    let size = std::fs::metadata(path).map_err(io)?.len();
    if size > MAX_BYTES {
        return Err(file(path, format!("has {size} bytes, expected at most {MAX_BYTES}")));
    }
    std::fs::read(path).map_err(io)
}

fn parse<'b>(path: &Path, bytes: &'b [u8]) -> Result<(HashMap<String, String>, SafeTensors<'b>), Error> {
    let not_ours = |e: safetensors::SafeTensorError| file(path, format!("is not a whole safetensors file: {e}"));
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(not_ours)?;
    let tensors = SafeTensors::deserialize(bytes).map_err(not_ours)?;
    let header = metadata.metadata().clone().unwrap_or_default();
    let found = |key: &str| header.get(key).map_or("nothing", String::as_str).to_owned();
    if found("format") != FORMAT || ![VERSION, PRUNED].contains(&found("version").as_str()) {
        let (format, version) = (found("format"), found("version"));
        return Err(file(
            path,
            format!("is {format} version {version}, expected {FORMAT} version {VERSION} or {PRUNED}"),
        ));
    }
    Ok((header, tensors))
}

fn config_of(path: &Path, header: &HashMap<String, String>) -> Result<Config, Error> {
    let text = header.get("config").ok_or_else(|| file(path, "header lacks `config`".to_owned()))?;
    let config: Config = toml::from_str(text).map_err(|e| file(path, format!("header `config`: {e}")))?;
    config.validate().map_err(|e| file(path, format!("header {e}")))?;
    Ok(config)
}

fn tensor<'b>(path: &Path, all: &SafeTensors<'b>, key: &str, dtype: Dtype, len: usize) -> Result<&'b [u8], Error> {
    let view = all.tensor(key).map_err(|_| file(path, format!("lacks `{key}`")))?;
    if view.dtype() != dtype || view.shape() != [len] {
        let (found, shape) = (view.dtype(), view.shape());
        return Err(file(path, format!("`{key}` is {found:?} {shape:?}, expected {dtype:?} [{len}]")));
    }
    Ok(view.data())
}

fn floats(path: &Path, all: &SafeTensors<'_>, key: &str, len: usize) -> Result<Vec<f32>, Error> {
    let bytes = tensor(path, all, key, Dtype::F32, len)?;
    let values: Vec<f32> = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    match values.iter().position(|v| !v.is_finite()) {
        Some(at) => Err(file(path, format!("`{key}` is {} at {at}, expected finite numbers", values[at]))),
        None => Ok(values),
    }
}

fn file(path: &Path, what: String) -> Error {
    Error::File { path: path.to_owned(), what }
}
