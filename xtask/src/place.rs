//! Atomic replacement of folders.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};

use crate::process::unwritten;

/// Errors unless `out` is absent, empty, or with `force` an earlier result marked by the file
/// `mark`.
pub fn vacant(out: &Path, force: bool, mark: &str) -> Result<()> {
    let Ok(entries) = std::fs::read_dir(out) else {
        ensure!(!out.exists(), "{}: not a directory", out.display());
        return Ok(());
    };
    if entries.count() == 0 {
        return Ok(());
    }
    let command = mark.trim_end_matches(".json");
    ensure!(out.join(mark).is_file(), "{}: not empty, and not written by {command} (no {mark})", out.display());
    ensure!(force, "{}: already holds a capture (--force replaces it)", out.display());
    Ok(())
}

/// Errors for an input within `out`, which is replaced.
pub fn not_within(path: &Path, out: &Path, what: &str) -> Result<()> {
    let (Ok(path), Ok(out)) = (path.canonicalize(), out.canonicalize()) else { return Ok(()) };
    ensure!(!path.starts_with(&out), "{}: lies in --out, which is replaced ({what})", path.display());
    Ok(())
}

/// Moves the complete directory `partial` to `out`, replacing what [`vacant`] permits.
pub fn take_place(partial: &Path, out: &Path, force: bool, mark: &str) -> Result<()> {
    let old = beside(out, "old")?;
    if out.exists() {
        vacant(out, force, mark)?;
        // Renamed first: a directory whose removal is interrupted would lose its mark.
        std::fs::rename(out, &old).map_err(unwritten(out))?;
    }
    if let Err(error) = std::fs::rename(partial, out) {
        let back = if old.exists() { std::fs::rename(&old, out) } else { Ok(()) };
        let error = unwritten(out)(error);
        return Err(if back.is_ok() { error } else { error.context(format!("{}: what stood there", old.display())) });
    }
    if old.exists() { std::fs::remove_dir_all(&old).map_err(unwritten(&old)) } else { Ok(()) }
}

/// A free name in the same folder.
pub fn beside(out: &Path, what: &str) -> Result<PathBuf> {
    let Some(name) = out.file_name() else { bail!("{}: not a name for a directory", out.display()) };
    let free = out.with_file_name(format!("{}.{what}-{}", name.to_string_lossy(), std::process::id()));
    ensure!(!free.exists(), "{}: in the way", free.display());
    Ok(free)
}
