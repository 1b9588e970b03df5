//! Filming a character or the embedded person, with a bar.

use std::path::Path;

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};
use smpl::{Character, MotionClip};
use synth::{SynthConfig, Synthetic, synthesise};

/// Whether `path` is named like a rigged character.
pub fn is_character(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    ["glb", "gltf"].iter().any(|known| extension.eq_ignore_ascii_case(known))
}

/// Films `character`, or the embedded person, with a bar.
pub fn film(character: Option<&Path>, motion: Option<&Path>, config: &SynthConfig) -> Result<Synthetic> {
    let named = |path: &Path| path.display().to_string();
    let character = character.map(|path| Character::load(path).map(|c| (c, named(path)))).transpose()?;
    let motion = motion.map(MotionClip::load).transpose()?;
    let bar = bar("filming", config.frames);
    let synthetic = synthesise(character.as_ref().map(|(c, _)| c), motion.as_ref(), config, &|_| bar.inc(1));
    bar.finish_and_clear();
    match character {
        Some((_, name)) => synthetic.context(name),
        None => Ok(synthetic?),
    }
}

/// A bar of `length` steps.
pub fn bar(what: &'static str, length: usize) -> ProgressBar {
    let bar = ProgressBar::new(length as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:28} {pos}/{len} {msg}  {elapsed}") {
        bar.set_style(style);
    }
    bar.with_message(what)
}
