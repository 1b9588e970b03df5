//! Finding pictures by name.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::CaptureError;
use super::names::FrameName;

/// Last component of a path.
pub(super) fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}

/// Whether there is a directory at `path`.
///
/// # Errors
/// [`CaptureError::Io`] for a broken or circular link, and for unreadable metadata.
pub(super) fn is_directory(path: &Path) -> Result<bool, CaptureError> {
    match std::fs::metadata(path) {
        Ok(found) => Ok(found.is_dir()),
        Err(_) if std::fs::symlink_metadata(path).is_err_and(|error| error.kind() == ErrorKind::NotFound) => Ok(false),
        Err(error) => Err(CaptureError::io(path)(error)),
    }
}

/// Whether a file has one of these extensions in any case, and is none that systems leave behind
/// (`._x.png`, `.DS_Store`).
pub(super) fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    !file_name(path).starts_with('.') && extension.is_some_and(|e| extensions.contains(&e.as_str()))
}

/// Files of a directory with one of these extensions, by name without extension, `10` after `9`.
pub(super) fn listed(dir: &Path, extensions: &[&str]) -> Result<Vec<(String, PathBuf)>, CaptureError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(CaptureError::io(dir))? {
        let path = entry.map_err(CaptureError::io(dir))?.path();
        if has_extension(&path, extensions) {
            found.push((path.file_stem().unwrap_or_default().to_string_lossy().into_owned(), path));
        }
    }
    found.sort_by(|a, b| FrameName(&a.0).cmp(&FrameName(&b.0)).then_with(|| a.1.cmp(&b.1)));
    Ok(found)
}

/// PNG and JPEG files of a directory by name without extension, in the order of the names.
pub(super) struct Pictures {
    dir: PathBuf,
    found: Vec<(String, PathBuf)>,
}

impl Pictures {
    pub fn list(dir: &Path) -> Result<Self, CaptureError> {
        let found = listed(dir, &["png", "jpg", "jpeg"])?;
        if let Some(pair) = found.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            let actual = format!("{} and {}", file_name(&pair[0].1), file_name(&pair[1].1));
            return Err(CaptureError::invalid(dir, &pair[0].0, "one picture", actual));
        }
        Ok(Self { dir: dir.to_owned(), found })
    }

    /// The picture called `name`.
    pub fn get(&self, name: &str) -> Option<PathBuf> {
        let at = self.found.binary_search_by(|(found, _)| FrameName(found).cmp(&FrameName(name)));
        at.ok().map(|at| self.found[at].1.clone())
    }

    /// The picture called `name`, which `user` mentions.
    pub fn demand(&self, name: &str, user: &Path) -> Result<PathBuf, CaptureError> {
        self.get(name).ok_or_else(|| {
            let what = format!("picture (nor .jpg) of `{name}` in {}", user.display());
            CaptureError::missing(&self.dir.join(format!("{name}.png")), what)
        })
    }

    /// Names and files.
    pub fn iter(&self) -> impl Iterator<Item = &(String, PathBuf)> {
        self.found.iter()
    }

    pub fn into_vec(self) -> Vec<(String, PathBuf)> {
        self.found
    }
}
