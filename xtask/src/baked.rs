//! The avatar of a run, baked on first use.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Error, Result};
use occnerf::bake::{Avatar, BakeOptions, bake};
use occnerf::{Model, Scene};

use crate::process::{note, results_in, say};
use crate::run::{AVATAR, CHECKPOINT, RunConfig};

/// Path of the avatar of a run.
pub fn path(run: &Path) -> PathBuf {
    run.join(AVATAR)
}

/// The saved avatar of a run, unless the checkpoint is newer.
pub fn fresh(run: &Path) -> Result<Option<Avatar>> {
    let written = |path: PathBuf| -> Option<SystemTime> { path.metadata().ok()?.modified().ok() };
    let (avatar, checkpoint) = (written(path(run)), written(run.join(CHECKPOINT)));
    let fresh = avatar.is_some() && avatar >= checkpoint;
    Ok(if fresh { Some(Avatar::load(&path(run))?) } else { None })
}

/// The saved avatar of a run if [`fresh`], else baked and saved. Baking uses the capture if it is
/// still available.
pub fn avatar(run: &Path, model: &Model) -> Result<Avatar> {
    if let Some(avatar) = fresh(run)? {
        return Ok(avatar);
    }
    let path = path(run);
    let scene = scene(run).map_err(|error| note!("baking without the capture: {error:#}")).ok();
    let (avatar, report) = bake(model, scene.as_ref(), &BakeOptions::default())?;
    avatar.save(&path).map_err(Error::from).map_err(results_in(run))?;
    let (side, faces, seconds) = (report.side, report.faces, report.seconds);
    say!("baked {faces} triangles and an atlas of {side} × {side} in {seconds:.1} s: {}", path.display());
    Ok(avatar)
}

fn scene(run: &Path) -> Result<Scene> {
    let config = RunConfig::read(run)?;
    let source = config.source(run)?;
    source.scene(&config.train)
}
