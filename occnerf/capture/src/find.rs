//! Which layout a directory has, and where its body model is.

use std::path::{Path, PathBuf};

use super::CaptureError;

/// A published dataset format, see [`load_capture`](super::load_capture).
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
    /// In the order in which they are looked for: HumanNeRF's tool puts its files beside the
    /// `metadata.json` that it made them from.
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
    // Ancestors of a relative path end where the path does, not at the root of the file system.
    let whole = dir.canonicalize().map_err(CaptureError::io(dir))?;
    let found = whole.ancestors().find_map(|above| {
        let mut files: Vec<PathBuf> = std::fs::read_dir(above.join("body"))
            .ok()?
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(|path| path.extension().is_some_and(|e| e == "npz"))
            .collect();
        files.sort();
        files.into_iter().find(|path| is_body(path))
    });
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

/// Whether an archive holds a template; poses and reference values may lie beside the body.
fn is_body(path: &Path) -> bool {
    array_files::npz::Npz::open(path).is_ok_and(|npz| npz.keys().iter().any(|key| key == "v_template"))
}
