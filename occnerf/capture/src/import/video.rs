//! The frames of a video.

use std::path::{Path, PathBuf};

use crate::CaptureError;
use crate::image::dimensions;
use crate::names::FrameName;
use crate::pictures::Pictures;

/// A video's frames as files, in order.
pub(super) struct Video {
    pub names: Vec<String>,
    pub paths: Vec<PathBuf>,
    pub size: (u32, u32),
}

impl Video {
    /// The pictures of a folder, all of one size.
    pub fn list(dir: &Path) -> Result<Self, CaptureError> {
        let pictures = Pictures::list(dir)?;
        let mut found: Vec<(&String, &PathBuf)> = pictures.iter().collect();
        found.sort_by(|a, b| FrameName(a.0).cmp(&FrameName(b.0)));
        let Some((_, first)) = found.first() else {
            return Err(CaptureError::invalid(dir, "files", "the video's frames, .png or .jpg", "none"));
        };
        let size = dimensions(first)?;
        for (_, path) in &found {
            let other = dimensions(path)?;
            if other != size {
                let expected = format!("{}×{}, as the first frame", size.0, size.1);
                return Err(CaptureError::invalid(path, "size", expected, format!("{}×{}", other.0, other.1)));
            }
        }
        Ok(Self {
            names: found.iter().map(|(name, _)| (*name).clone()).collect(),
            paths: found.iter().map(|(_, path)| (*path).clone()).collect(),
            size,
        })
    }

    /// Width and height.
    pub fn sides(&self) -> [f64; 2] {
        [self.size.0.into(), self.size.1.into()]
    }

    /// The image centre, most estimators' principal point.
    pub fn middle(&self) -> [f64; 2] {
        self.sides().map(|side| side / 2.0)
    }
}
