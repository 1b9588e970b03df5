//! Where the frames come from: a capture on disk with its body model, or the demo, which is one
//! too.

use std::cell::RefCell;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use occnerf::capture::{Capture, Frame, LoadOptions, Mended, Registered, find_body, load_capture, own_body};
use occnerf::{Config, Person, Scene, mend_masks};
use serde::Serialize;
use sha2::{Digest, Sha256};
use smpl::BodyModel;

use crate::process::{check_memory, telling};

/// Name of the scene that needs no other files.
pub const DEMO: &str = "demo";
/// The demo's capture, which `cargo lab synth --no-body --out xtask/demo --force` writes.
pub const DEMO_FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/demo");
/// Environment variable that names a body model.
const BODY_VARIABLE: &str = "SMPL_MODEL";

/// A capture with its prior, and where both came from.
pub struct Source {
    /// `demo`, or a directory.
    pub scene: String,
    /// The body model's file.
    pub body: Option<PathBuf>,
    /// How the capture was read.
    pub load: LoadOptions,
    /// Frames with masks, cameras and poses.
    pub capture: Capture,
    /// The body model.
    pub model: BodyModel,
    /// The registered capture of a number of rounds, or of a run to be resumed.
    registered: RefCell<Option<(Option<usize>, Registered)>>,
}

impl Source {
    /// Identity of the training data, independent of its path: SHA-256 of the body's file, and of
    /// every frame's pictures, camera, pose and shape.
    ///
    /// # Errors
    /// Files that cannot be read.
    pub fn identity(&self) -> Result<String> {
        let mut hash = Sha256::new();
        self.body.iter().try_for_each(|body| hash_file(&mut hash, body))?;
        let views = self.capture.eval.iter().map(|view| &view.frame);
        for frame in self.capture.train.iter().chain(views) {
            let Frame { name, camera, pose, betas, placement, .. } = frame;
            let (files, decoding) = frame.source.origin();
            hash.update(format!("{name:?} {camera:?} {pose:?} {betas:?} {placement:?} {decoding}"));
            files.into_iter().try_for_each(|file| hash_file(&mut hash, file))?;
        }
        Ok(hex(hash))
    }

    /// The same capture with another body.
    pub fn with_body(&self, model: BodyModel) -> Self {
        let (scene, body, load) = (self.scene.clone(), self.body.clone(), self.load.clone());
        Self { scene, body, load, capture: self.capture.clone(), model, registered: RefCell::default() }
    }

    /// Takes the body and the registered poses of the run in `directory`, if it kept them.
    pub fn restore(&mut self, directory: &Path, config: &Config) -> Result<()> {
        let body = directory.join("body.safetensors");
        let model = if body.is_file() { BodyModel::load(&body)? } else { self.model.clone() };
        // A skirt is added before masks are mended, hands are rolled up after it.
        let is_skirted = model.num_vertices() != self.model.num_vertices();
        let mending = if is_skirted { &model } else { &self.model };
        let mended = match config.registration.rounds {
            0 => Mended::from(self.capture.clone()),
            _ => mend_masks(self.capture.clone(), mending)?,
        };
        self.model = model;
        let restored = Person::restore(directory, mended, &self.model)?;
        self.registered.replace(restored.map(|registered| (None, registered)));
        Ok(())
    }

    /// The capture prepared for a run; registration is cached for its number of rounds.
    ///
    /// # Errors
    /// Those of [`Scene::new`].
    pub fn scene(&self, config: &Config) -> Result<Scene> {
        let rounds = config.registration.rounds;
        let mut cache = self.registered.borrow_mut();
        if let Some((_, registered)) = cache.as_ref().filter(|cached| cached.0.is_none_or(|of| of == rounds)) {
            return Ok(Scene::prepare(registered.clone(), &self.model, config)?);
        }
        let scene = telling("preparing the frames", || Scene::new(&self.capture, &self.model, config))?;
        *cache = Some((Some(rounds), scene.registered.clone()));
        Ok(scene)
    }
}

/// What a capture's files leave open.
#[derive(Args, Clone, Debug, Default, Serialize)]
#[serde(rename_all = "kebab-case")]
pub struct LoadArguments {
    /// Longest side in pixels that pictures are reduced to [default: as they are]
    #[arg(long, value_name = "PIXELS")]
    resize: Option<u32>,
    /// Train on every n-th frame [default: 1]
    #[arg(long, value_name = "N")]
    stride: Option<usize>,
    /// Train on at most this many frames [default: all]
    #[arg(long, value_name = "N")]
    max_frames: Option<usize>,
    /// Keep back views of every n-th training frame [default: 1]
    #[arg(long, value_name = "N")]
    eval_stride: Option<usize>,
    /// Training camera of a ZJU-MoCap capture, by folder or by number from 1 [default: the first]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// Most memory that a capture's bodies and decoded pictures may take, in MiB; where pictures do
    /// not fit they stay packed, and those beyond it are decoded whenever they are needed
    /// [default: 1024]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..=1 << 24))]
    memory: Option<u64>,
}

impl LoadArguments {
    /// The same for the library.
    pub fn options(&self) -> Result<LoadOptions> {
        Ok(LoadOptions {
            resize: self.resize,
            stride: self.stride.unwrap_or(1),
            max_frames: self.max_frames,
            eval_stride: self.eval_stride.unwrap_or(1),
            camera: self.camera.clone(),
            max_bytes: self.memory.map_or(LoadOptions::default().max_bytes, |mib| mib << 20),
            ..LoadOptions::default()
        })
    }

    /// Load options of the run to be resumed, checked against those of the command line.
    pub fn resumed(&self, saved: &LoadOptions) -> Result<LoadOptions> {
        let asked = self.options()?;
        if asked != LoadOptions::default() && asked != *saved {
            bail!(
                "the run to resume read its capture with other options; leave them out, or start a new run with --out"
            );
        }
        let max_bytes = if self.memory.is_some() { asked.max_bytes } else { saved.max_bytes };
        Ok(LoadOptions { max_bytes, ..saved.clone() })
    }
}

/// Loads `scene`, the demo if it is `None` or named [`DEMO`]; the body is `body`, the capture's
/// own, that of the variable SMPL_MODEL, or what lies near the scene.
pub fn load(scene: Option<&str>, body: Option<&Path>, options: &LoadOptions) -> Result<Source> {
    load_with(scene, body, options, |_, _| Ok(()))
}

/// The same, with `edit` applied to capture and body as they were read.
///
/// # Errors
/// Of `edit` too.
pub fn load_with(
    scene: Option<&str>,
    body: Option<&Path>,
    options: &LoadOptions,
    edit: impl FnOnce(&mut Capture, &mut BodyModel) -> Result<()>,
) -> Result<Source> {
    check_memory(0)?;
    let scene = scene.unwrap_or(DEMO);
    let directory = Path::new(if scene == DEMO { DEMO_FOLDER } else { scene });
    if directory.is_file() && is_character(directory) {
        bail!("{scene}: a character; film it with cargo lab synth {scene} --out DIR, then cargo xtask train DIR");
    }
    if directory.is_file() {
        bail!("{scene}: a file, expected a capture's folder; of a video: cargo xtask import --frames {scene} --help");
    }
    if !directory.is_dir() {
        let expected =
            if scene == DEMO { "the demo, in a clone of the sources" } else { "a capture, or no SCENE for the demo" };
        bail!("{}: no such directory; expected {expected}", directory.display());
    }
    let file = if scene == DEMO {
        None
    } else {
        let variable = || std::env::var_os(BODY_VARIABLE).map(PathBuf::from);
        match body.map(Path::to_owned).or_else(|| own_body(directory)).or_else(variable) {
            Some(file) => Some(file),
            None => Some(find_body(directory).with_context(|| {
                format!("a capture needs the body model it was fitted with (--body FILE.npz, or {BODY_VARIABLE})")
            })?),
        }
    };
    if let Some(file) = file.as_deref().filter(|file| file.exists() && !file.is_file()) {
        bail!("{}: not a plain file, which a run reads again", file.display());
    }
    let mut model = file.as_deref().map_or_else(|| Ok(BodyModel::embedded()), BodyModel::load)?;
    let mut capture = load_capture(directory, &model, options)?;
    edit(&mut capture, &mut model)?;
    // The demo's bodies have the lengths that the embedded body has.
    let model = if scene == DEMO { model } else { model.with_limb_lengths() };
    let (scene, load) = (scene.to_owned(), options.clone());
    Ok(Source { scene, body: file, load, capture, model, registered: RefCell::default() })
}

/// Adds the length and the bytes of a file to a hash.
pub fn hash_file(hash: &mut Sha256, path: &Path) -> Result<()> {
    let copied = File::open(path).and_then(|file| {
        let (mut file, mut length) = (BufReader::with_capacity(1 << 16, file), 0);
        loop {
            let bytes = file.fill_buf()?.len();
            if bytes == 0 {
                return Ok(length);
            }
            hash.update(file.buffer());
            file.consume(bytes);
            length += bytes as u64;
        }
    });
    hash.update(copied.with_context(|| path.display().to_string())?.to_le_bytes());
    Ok(())
}

/// A hash in hexadecimal digits.
pub fn hex(hash: Sha256) -> String {
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Whether `path` is named like a rigged character.
pub fn is_character(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    ["glb", "gltf", "vrm"].iter().any(|known| extension.eq_ignore_ascii_case(known))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_resumed_with_its_own_options_and_any_memory() {
        let load = |resize, memory| LoadArguments { resize, memory, ..LoadArguments::default() };
        let saved = load(Some(64), Some(9)).options().unwrap();
        for (resize, memory) in [(None, None), (Some(64), None), (None, Some(20)), (Some(64), Some(20))] {
            let resumed = load(resize, memory).resumed(&saved).unwrap();
            assert_eq!((resumed.max_bytes, &resumed), (memory.unwrap_or(9) << 20, &saved));
        }
        let stride = LoadArguments { stride: Some(2), ..LoadArguments::default() };
        assert!(load(Some(65), None).resumed(&saved).is_err() && stride.resumed(&saved).is_err());
    }
}
