//! A run's person as an avatar, baked when it is first asked for.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, Result};
use occnerf::bake::{Avatar, BakeOptions, bake};
use occnerf::{Model, Scene};

use crate::run::{CHECKPOINT, RunConfig};

/// The avatar's file in a run directory.
pub const AVATAR: &str = "avatar.safetensors";

/// Where the avatar of a run lies.
pub fn path(run: &Path) -> PathBuf {
    run.join(AVATAR)
}

/// The avatar of a run: that in its directory where it is not older than the checkpoint, else
/// baked, and written there. Baking looks at the capture again, where it is still to be had.
pub fn avatar(run: &Path, model: &Model) -> Result<Avatar> {
    let path = path(run);
    let written = |path: &Path| -> Option<SystemTime> { path.metadata().ok()?.modified().ok() };
    if let (Some(avatar), Some(checkpoint)) = (written(&path), written(&run.join(CHECKPOINT)))
        && avatar >= checkpoint
    {
        return Ok(Avatar::load(&path)?);
    }
    let scene = scene(run).map_err(|error| eprintln!("baking without the capture: {error:#}")).ok();
    let (avatar, report) = bake(model, scene.as_ref(), &BakeOptions::default())?;
    avatar.save(&path).with_context(|| path.display().to_string())?;
    let (side, faces, seconds) = (report.side, report.faces, report.seconds);
    println!("baked {faces} triangles and an atlas of {side} × {side} in {seconds:.1} s: {}", path.display());
    Ok(avatar)
}

fn scene(run: &Path) -> Result<Scene> {
    let config = RunConfig::read(run)?;
    let source = config.source()?;
    Ok(Scene::new(&source.capture, &source.model, &config.train)?)
}
