//! Detection of a directory's layout and of its body model.

use std::path::{Path, PathBuf};

use super::CaptureError;

/// A published dataset format, see [`load_capture`](super::load_capture).
///
/// ```
/// use capture::Layout;
///
/// assert_eq!(Layout::detect("../../xtask/demo".as_ref())?, Layout::HumanNerf);
/// # Ok::<(), capture::CaptureError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Raw ZJU-MoCap.
    ZjuMocap,
    /// HumanNeRF's layout for videos from anywhere, in which OcMotion is distributed too.
    Wild,
    /// HumanNeRF's prepared layout.
    HumanNerf,
}

impl Layout {
    /// In order of precedence: HumanNeRF's tool writes its files beside the `metadata.json`.
    const ALL: [(&'static [&'static str], &'static str, Self); 3] = [
        (&["annots.npy"], "raw ZJU-MoCap", Self::ZjuMocap),
        (&["metadata.json"], "HumanNeRF's wild layout", Self::Wild),
        (&["mesh_infos.pkl", "cameras.pkl"], "HumanNeRF's prepared layout", Self::HumanNerf),
    ];

    /// The layout of the capture in `dir`, by the files that are there.
    ///
    /// # Errors
    /// [`CaptureError::Missing`] where there is no such directory, [`CaptureError::Invalid`] where
    /// it has no known layout.
    pub fn detect(dir: &Path) -> Result<Self, CaptureError> {
        if !dir.is_dir() {
            return Err(CaptureError::missing(dir, "directory"));
        }
        let found = Self::ALL.iter().find(|(files, _, _)| files.iter().any(|file| dir.join(file).is_file()));
        found.map(|(_, _, layout)| *layout).ok_or_else(|| {
            let expected = Self::ALL.map(|(files, name, _)| format!("{} ({name})", files.join(" and "))).join(", or ");
            CaptureError::invalid(dir, "format", expected, "none of them")
        })
    }
}

/// The body model that belongs to the capture in `dir`: its own `body.npz` or `body.safetensors`,
/// else the first `.npz` with a body in a directory `body` beside it or beside the nearest of the
/// directories above it.
///
/// # Errors
/// [`CaptureError::Missing`] or [`CaptureError::Invalid`] where `dir` is no capture of a known
/// layout, and [`CaptureError::Missing`] where no body is found.
pub fn find_body(dir: &Path) -> Result<PathBuf, CaptureError> {
    Layout::detect(dir)?;
    if let Some(found) = own_body(dir) {
        return Ok(found);
    }
    // The ancestors of a relative path are incomplete.
    let whole = dir.canonicalize().map_err(CaptureError::io(dir))?;
    let found = near_bodies(&whole, &["npz"]).into_iter().find(|path| is_body(path));
    found.ok_or_else(|| {
        CaptureError::missing(
            &dir.join("body.npz"),
            "body model (nor body.safetensors, nor any body/*.npz near the capture)",
        )
    })
}

/// The body model in a capture's directory: `body.npz` or `body.safetensors`.
pub fn own_body(dir: &Path) -> Option<PathBuf> {
    ["body.npz", "body.safetensors"].map(|name| dir.join(name)).into_iter().find(|path| path.is_file())
}

/// Files with one of `extensions` in directories `body` beside `place` and its ancestors, the
/// nearest first, by name.
pub(super) fn near_bodies(place: &Path, extensions: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for above in place.ancestors() {
        let files = std::fs::read_dir(above.join("body")).into_iter().flatten().filter_map(|e| Some(e.ok()?.path()));
        let known = |path: &PathBuf| path.extension().is_some_and(|e| extensions.iter().any(|known| e == *known));
        let mut files: Vec<PathBuf> = files.filter(known).collect();
        files.sort();
        found.extend(files);
    }
    found
}

/// Whether an archive holds a template, not poses or reference values.
fn is_body(path: &Path) -> bool {
    array_files::npz::Npz::open(path).is_ok_and(|npz| npz.keys().iter().any(|key| key == "v_template"))
}
