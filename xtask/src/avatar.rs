//! The avatar of a run for export, with additional motion clips.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use occnerf::bake::{Avatar, Clip, export};
use occnerf::{Method, Model};
use smpl::MotionClip;

use crate::baked;
use crate::process::{say, unwritten};
use crate::run::RunConfig;

/// The baked person of a run: see [`baked::avatar`].
pub fn of_run(run: &Path) -> Result<Avatar> {
    ensure!(run.is_dir(), "{}: no such run", run.display());
    let method = RunConfig::read(run).ok().map(|run| run.train.method);
    ensure!(method != Some(Method::Prior), "{} has no field to bake", run.display());
    if method == Some(Method::Surface) {
        return Ok(Avatar::load(&baked::path(run))?);
    }
    match baked::fresh(run)? {
        Some(avatar) => Ok(avatar),
        None => baked::avatar(run, &Model::load(run)?),
    }
}

/// Reads a motion of `fps` frames per second, by default as many as the file says.
pub fn load_motion(path: &Path, fps: Option<f32>) -> Result<MotionClip> {
    let mut motion = MotionClip::load(path)?;
    if let Some(fps) = fps {
        ensure!((1e-3..=1e6).contains(&fps), "--fps {fps}: expected 0.001 to 1000000");
        motion.fps = fps;
    } else if MotionClip::rate_of(path)?.is_none() {
        say!("{}: no frames per second in it, {} are assumed (--fps)", path.display(), motion.fps);
    }
    Ok(motion)
}

/// Adds a motion from a file, named after it.
pub fn add_motion(avatar: &mut Avatar, path: &Path, fps: Option<f32>) -> Result<()> {
    let motion = load_motion(path, fps)?;
    let root = avatar.skeleton[0].rest;
    let motion = export::fit_motion(&motion, avatar.num_joints(), root).with_context(|| path.display().to_string())?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let taken = |name: &str| avatar.clips.iter().any(|clip| clip.name == name);
    let others = (2..).map(|i| format!("{stem} {i}"));
    let name = std::iter::once(stem.clone()).chain(others).find(|name| !taken(name)).unwrap_or(stem);
    avatar.clips.push(Clip { name, motion });
    Ok(())
}

/// Makes the parent folder of the file `out`.
pub fn check_folder(out: &Path) -> Result<()> {
    let folder = match out.parent() {
        Some(parent) if parent != Path::new("") => parent.to_owned(),
        _ => PathBuf::from("."),
    };
    std::fs::create_dir_all(&folder).map_err(unwritten(&folder))?;
    ensure!(!out.is_dir(), "--out {}: is a folder, expected a file", out.display());
    Ok(())
}
