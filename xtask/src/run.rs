//! The run directory: configuration, log, checkpoint, metrics and pictures.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail, ensure};
use array_files::read_bounded;
use occnerf::capture::LoadOptions;
use occnerf::{Config, Model, SplitMetrics, replace_file};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::process::{Lock, still_held, unwritten};
use crate::source::{self, Source, hash_file, hex};

/// Parameters, Adam moments and visibility counts.
pub const CHECKPOINT: &str = "checkpoint.safetensors";
const CONFIG: &str = "config.toml";
/// The surface: baked, or fitted by `--method surface`.
pub const AVATAR: &str = "avatar.safetensors";
/// Metrics.
pub const METRICS: &str = "metrics.json";
/// Record of `--method auto`.
const VERDICT: &str = "auto.json";
/// Log of the training.
pub const LOG: &str = "train.jsonl";
/// Viewer page.
pub const PERSON: &str = "person.html";

/// [`RunConfig::difference`] of a run whose capture has changed since.
pub const CHANGED: &str = "the capture as it was then";

/// Contents of config.toml.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// `demo` or a directory.
    pub scene: String,
    /// The body model's file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub body: Option<PathBuf>,
    /// Identity of capture and body ([`Source::identity`]).
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub capture: String,
    /// Options of loading the capture.
    #[serde(default, skip_serializing_if = "is_default")]
    pub load: LoadOptions,
    /// Training configuration.
    pub train: Config,
}

impl RunConfig {
    /// Configuration of a new run.
    ///
    /// # Errors
    /// Files of the capture that cannot be read.
    pub fn new(source: &Source, train: Config) -> Result<Self> {
        let (scene, body, load) = (source.scene.clone(), source.body.clone(), source.load.clone());
        Ok(Self { scene, body, capture: source.identity()?, load, train })
    }

    /// Reads a run's config.toml.
    pub fn read(run: &Path) -> Result<Self> {
        let path = run.join(CONFIG);
        let text = read_text(&path).with_context(|| format!("{} is not a run", run.display()))?;
        let config = toml::from_str(&text).map_err(|error| anyhow!("{}: {}", path.display(), error.message()));
        let config: Self = config?;
        config.train.validate().with_context(|| path.display().to_string())?;
        Ok(config)
    }

    /// Writes it.
    pub fn write(&self, run: &Path) -> Result<()> {
        write(&run.join(CONFIG), &toml::to_string(self)?)
    }

    /// What differs between two runs of the same scene, if anything. Runs that do not say what
    /// their capture was pass.
    pub fn difference(&self, other: &Self) -> Option<&'static str> {
        let changed = self.capture != other.capture && !self.capture.is_empty() && !other.capture.is_empty();
        if changed {
            return Some(CHANGED);
        }
        (self.train != other.train || self.load != other.load).then_some("other settings")
    }

    /// Whether two runs have the same place of capture and body.
    pub fn same_scene(&self, other: &Self) -> bool {
        let place = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
        place(self.scene.as_ref()) == place(other.scene.as_ref())
            && self.body.as_deref().map(place) == other.body.as_deref().map(place)
    }

    /// The capture of the run in `directory`, with its registered bodies.
    pub fn source(&self, directory: &Path) -> Result<Source> {
        let mut source = source::load(Some(&self.scene), self.body.as_deref(), &self.load)?;
        source.restore(directory, &self.train)?;
        Ok(source)
    }
}

fn is_default(options: &LoadOptions) -> bool {
    *options == LoadOptions::default()
}

/// Contents of metrics.json.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// Identity of what was scored ([`identity`]).
    #[serde(default)]
    pub of: String,
    /// Name of the method.
    pub method: String,
    /// Name of the preset.
    pub preset: String,
    /// Name of the rule for occluded pixels.
    pub occluded: String,
    /// `demo` or a directory.
    pub scene: String,
    /// Seed of every random choice.
    pub seed: u64,
    /// Optimisation steps.
    pub steps: u64,
    /// Wall clock of the training.
    pub train_seconds: f64,
    /// Largest resident set.
    pub peak_rss_bytes: u64,
    /// Number of parameters.
    pub parameters: usize,
    /// Perceptual term of the training.
    #[serde(default)]
    pub perceptual: String,
    /// Network of `lpips_full`.
    #[serde(default)]
    pub lpips: Option<String>,
    /// Scores.
    pub splits: Splits,
}

/// Title of evaluation views.
fn evaluation_title(split: &SplitMetrics) -> &'static str {
    let held_out = !split.frames.is_empty() && split.frames.iter().all(|frame| frame.camera == occnerf::HELD_OUT);
    if held_out { "held-out frames, over known pixels" } else { "novel views" }
}

/// Metrics of each split.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Splits {
    /// Held-out cameras.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub novel_view: Option<SplitMetrics>,
    /// Every tenth training frame, on its known pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub train_view: Option<SplitMetrics>,
}

impl Splits {
    /// Title and metrics of each split.
    pub fn titled(&self) -> impl Iterator<Item = (&'static str, &SplitMetrics)> {
        let novel = self.novel_view.iter().map(|split| (evaluation_title(split), split));
        novel.chain(self.train_view.iter().map(|split| ("training views, over visible pixels", split)))
    }

    /// Title and metrics of the main split: novel views if there are any.
    pub fn first(&self) -> Option<(&'static str, &SplitMetrics)> {
        self.titled().next()
    }

    /// Title of [`Splits::first`].
    pub fn title(&self) -> &'static str {
        self.first().map_or("nothing to score", |(title, _)| title)
    }
}

impl Metrics {
    /// Reads a run's metrics.json.
    pub fn read(run: &Path) -> Result<Self> {
        let path = run.join(METRICS);
        serde_json::from_str(&read_text(&path)?).with_context(|| path.display().to_string())
    }

    /// Reads the metrics in `directory` if they are of the model that the run `model` has now.
    pub fn fresh(directory: &Path, model: &Path) -> Result<Option<Self>> {
        if !directory.join(METRICS).is_file() {
            return Ok(None);
        }
        let (metrics, of) = (Self::read(directory)?, identity(model)?);
        Ok(Some(metrics).filter(|metrics| metrics.of == of))
    }

    /// Writes it.
    pub fn write(&self, run: &Path) -> Result<()> {
        write(&run.join(METRICS), &serde_json::to_string_pretty(self)?)
    }
}

/// What `--method auto` found that a scene needs, and why.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Verdict {
    /// Whether the body has a skirt.
    #[serde(default)]
    pub skirt: bool,
    /// Whether a field is trained.
    pub field: bool,
    /// A row a part of the body, the first a header.
    pub parts: Vec<Vec<String>>,
    /// Gain, costs and decision in a sentence.
    pub why: String,
}

impl Verdict {
    /// The record of a run; `None` where its method was named.
    pub fn read(run: &Path) -> Result<Option<Self>> {
        let path = run.join(VERDICT);
        if !path.is_file() {
            return Ok(None);
        }
        serde_json::from_str(&read_text(&path)?).map(Some).with_context(|| path.display().to_string())
    }

    /// Writes the record of a new run, or removes an old one.
    pub fn begin(run: &Path, verdict: Option<&Self>) -> Result<()> {
        let path = run.join(VERDICT);
        match verdict {
            Some(verdict) => write(&path, &serde_json::to_string_pretty(verdict)?),
            None => remove(&path),
        }
    }
}

/// Identity of what a run has learnt, which all that is made of it carries: SHA-256 of checkpoint
/// or fitted surface, body and person.
pub fn identity(run: &Path) -> Result<String> {
    let learnt = if run.join(CHECKPOINT).exists() { CHECKPOINT } else { AVATAR };
    let files = [learnt, "body.safetensors", "person.safetensors"].map(|name| run.join(name));
    let mut hash = Sha256::new();
    files.iter().filter(|path| path.is_file()).try_for_each(|path| hash_file(&mut hash, path))?;
    Ok(hex(hash))
}

/// The trained model of a run.
///
/// # Errors
/// Files that are damaged; a checkpoint of another run.
pub fn model(directory: &Path, run: &RunConfig) -> Result<Model> {
    let model = Model::load(directory)?;
    // A training that was stopped has taken fewer steps.
    let same = Config { steps: run.train.steps, ..model.config().clone() } == run.train;
    ensure!(same, "{}: of another run: its settings are not those of {CONFIG}", directory.join(CHECKPOINT).display());
    Ok(model)
}

/// Creates and locks the directory of a new run: `out`, or the first free `runs/NAME`,
/// `runs/NAME-2`, …
pub fn new_directory(out: Option<&Path>, name: &str) -> Result<(PathBuf, Lock)> {
    let directory = match out {
        Some(out) => {
            make_directory(out)?;
            out.to_owned()
        }
        None => free_directory(name)?,
    };
    let lock = Lock::take(&directory)?;
    if [CHECKPOINT, AVATAR].iter().any(|name| directory.join(name).exists()) {
        bail!("{} already holds a run: go on with --resume, or give another --out", directory.display());
    }
    make_directory(&directory.join("renders"))?;
    Ok((directory, lock))
}

/// Creates the first free default name, free of races.
fn free_directory(name: &str) -> Result<PathBuf> {
    for directory in candidates(name) {
        make_directory(directory.parent().unwrap_or(Path::new(".")))?;
        match std::fs::create_dir(&directory) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            made => return made.map_err(unwritten(&directory)).map(|()| directory),
        }
    }
    bail!("no free directory under runs/")
}

/// Directory of the run to resume: `out`, or the latest default name.
pub fn existing_directory(out: Option<&Path>, name: &str) -> Result<PathBuf> {
    let directory = match out {
        Some(out) => out.to_owned(),
        None => candidates(name).take_while(|d| d.exists()).last().context("no run to resume under runs/")?,
    };
    if ![CHECKPOINT, CONFIG].iter().any(|name| directory.join(name).is_file()) {
        bail!("{} has no {CHECKPOINT} to resume from, and no {CONFIG} to begin with", directory.display());
    }
    Ok(directory)
}

fn candidates(name: &str) -> impl Iterator<Item = PathBuf> {
    let name = name.to_owned();
    (1..10_000).map(move |i| Path::new("runs").join(if i == 1 { name.clone() } else { format!("{name}-{i}") }))
}

/// Largest text file of a run.
const MAX_TEXT: u64 = 1 << 28;

/// Reads a text file of a run; invalid UTF-8 becomes U+FFFD.
pub fn read_text(path: &Path) -> Result<String> {
    ensure!(!path.exists() || path.is_file(), "{}: not a plain file", path.display());
    let bytes = read_bounded(path, MAX_TEXT).with_context(|| path.display().to_string())?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Creates a directory and its parents.
///
/// # Errors
/// [`Ending::Unwritten`](crate::process::Ending::Unwritten).
pub fn make_directory(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(unwritten(path))
}

/// Replaces a text file atomically.
///
/// # Errors
/// [`Ending::Unwritten`](crate::process::Ending::Unwritten).
pub fn write(path: &Path, text: &str) -> Result<()> {
    path.parent().map_or(Ok(()), still_held)?;
    replace(path, |to| Ok(to.write_all(text.as_bytes())?))
}

/// Replaces a file atomically by what `encode` writes.
///
/// # Errors
/// [`Ending::Unwritten`](crate::process::Ending::Unwritten), and other faults of `encode`.
pub fn replace(path: &Path, encode: impl FnOnce(&mut BufWriter<File>) -> Result<()>) -> Result<()> {
    let mut failed = None;
    let written = replace_file(path, |to| {
        encode(to).map_err(|error| match error.downcast() {
            Ok(system) => system,
            Err(other) => {
                failed = Some(other);
                std::io::Error::other("not encoded")
            }
        })
    });
    match failed {
        Some(error) => Err(error).with_context(|| path.display().to_string()),
        None => written.map_err(unwritten(path)),
    }
}

/// An error of the image encoders, those of the system as they are.
pub fn unquoted(error: image::ImageError) -> anyhow::Error {
    match error {
        image::ImageError::IoError(error) => error.into(),
        error => error.into(),
    }
}

/// Removes a file if there is one.
pub fn remove(path: &Path) -> Result<()> {
    if path.is_file() { std::fs::remove_file(path).map_err(unwritten(path)) } else { Ok(()) }
}

/// Most threads for each processor.
const OVERBOOKED: usize = 16;
/// Number of threads without `--threads`.
const THREADS: &str = "RAYON_NUM_THREADS";

/// Checks `--threads`, and what stands in for it; returns the number of threads.
pub fn check_threads(threads: Option<usize>) -> Result<usize> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let named = std::env::var(THREADS).ok().filter(|text| threads.is_none() && !text.is_empty() && text != "0");
    let (name, asked) = match (threads, named) {
        (Some(threads), _) => ("--threads", threads.to_string()),
        (None, Some(text)) => (THREADS, text),
        (None, None) => return Ok(cores),
    };
    let most = OVERBOOKED * cores;
    let number = asked.parse().ok().filter(|number| (1..=most).contains(number));
    number.with_context(|| format!("{name} {asked}: expected 1 to {most}, {OVERBOOKED} for each processor"))
}

/// Starts the global thread pool.
///
/// # Errors
/// A number out of range; threads that the system refuses.
pub fn use_threads(threads: Option<usize>) -> Result<()> {
    let number = check_threads(threads)?;
    let built = rayon::ThreadPoolBuilder::new().num_threads(number).build_global();
    built.with_context(|| format!("{number} threads cannot be started (--threads gives another number)"))
}
