//! The avatar of a run, baked on first use.

use std::path::{Path, PathBuf};

use anyhow::{Error, Result};
use occnerf::bake::{Avatar, bake};

use crate::process::{is_read_only, note, one_line, results_in, say, telling};
use crate::run::{AVATAR, RunConfig, identity, model};

/// Path of the avatar of a run.
pub fn path(run: &Path) -> PathBuf {
    run.join(AVATAR)
}

/// The saved avatar of a run with a field if it is of the run's model, else baked and saved; of a
/// run that cannot be written it is not kept. Baking uses the capture if it is still available.
pub fn avatar(run: &Path, config: &RunConfig) -> Result<Avatar> {
    // Before the model is read: of a model that is replaced meanwhile the avatar is stale.
    let (path, source) = (path(run), identity(run)?);
    let old = if path.exists() { Some(Avatar::load(&path)?) } else { None };
    if let Some(avatar) = old.filter(|avatar| avatar.source == source) {
        return Ok(avatar);
    }
    let model = model(run, config)?;
    let scene = config.source(run).and_then(|source| source.scene(&config.train));
    let scene = scene.map_err(|error| note!("baking without the capture: {error:#}")).ok();
    let (mut avatar, report) = telling("baking", || bake(&model, scene.as_ref()))?;
    avatar.source = source;
    match avatar.save(&path).map_err(Error::from).map_err(results_in(run)) {
        Err(error) if is_read_only(&error) => note!("{}: the baked person is not kept", one_line(&error)),
        saved => saved?,
    }
    let (side, faces, seconds) = (report.side, report.faces, report.seconds);
    say!("baked {faces} triangles and an atlas of {side} × {side} in {seconds:.1} s: {}", path.display());
    Ok(avatar)
}
