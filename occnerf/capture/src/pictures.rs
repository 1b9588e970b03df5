//! Finding pictures by name.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::CaptureError;

/// Last component of a path.
pub(super) fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str());
    name.to_string_lossy().into_owned()
}

/// Whether a file is one that systems leave behind: `._x.png`, `.DS_Store`.
pub(super) fn is_hidden(path: &Path) -> bool {
    file_name(path).starts_with('.')
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

/// PNG and JPEG files of a directory by name without extension.
pub(super) struct Pictures {
    dir: PathBuf,
    found: BTreeMap<String, PathBuf>,
}

impl Pictures {
    pub fn list(dir: &Path) -> Result<Self, CaptureError> {
        let mut found = BTreeMap::new();
        for entry in std::fs::read_dir(dir).map_err(CaptureError::io(dir))? {
            let path = entry.map_err(CaptureError::io(dir))?.path();
            if is_hidden(&path) {
                continue;
            }
            let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
            if !matches!(extension.as_deref(), Some("png" | "jpg" | "jpeg")) {
                continue;
            }
            let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned());
            let stem = stem.unwrap_or_default();
            if let Some(other) = found.insert(stem.clone(), path.clone()) {
                let actual = format!("{} and {}", file_name(&other), file_name(&path));
                return Err(CaptureError::invalid(dir, stem, "one picture", actual));
            }
        }
        Ok(Self { dir: dir.to_owned(), found })
    }

    /// The picture called `name`.
    pub fn get(&self, name: &str) -> Option<PathBuf> {
        self.found.get(name).cloned()
    }

    /// The picture called `name`, which `user` mentions.
    pub fn demand(&self, name: &str, user: &Path) -> Result<PathBuf, CaptureError> {
        self.get(name).ok_or_else(|| {
            let what = format!("picture (nor .jpg) of `{name}` in {}", user.display());
            CaptureError::missing(&self.dir.join(format!("{name}.png")), what)
        })
    }

    /// Names and files in the order of the names.
    pub fn iter(&self) -> impl Iterator<Item = (&String, &PathBuf)> {
        self.found.iter()
    }
}
