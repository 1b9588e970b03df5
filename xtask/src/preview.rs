//! `train --preview`: a picture of the person while training goes on.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Result;
use glam::Vec3;
use occnerf::{FieldRenderer, Model, Renderer};

use crate::pictures;

/// The picture's file in a run directory.
pub const PREVIEW: &str = "preview.png";
/// Least time between two pictures.
const EVERY: Duration = Duration::from_secs(5);
/// Least time between two, in times of what the last one took: drawing is a hundredth of training.
const SHARE: u32 = 100;

/// A picture that is replaced every few seconds.
pub struct Preview {
    path: PathBuf,
    due: Instant,
}

impl Preview {
    pub fn new(directory: &Path) -> Self {
        Self { path: directory.join(PREVIEW), due: Instant::now() + EVERY }
    }

    /// Draws the first training view as `model` has it, if it is time for that.
    pub fn draw(&mut self, model: &Model) -> Result<()> {
        let start = Instant::now();
        let Some(view) = model.frames().first().filter(|_| start >= self.due) else { return Ok(()) };
        let drawn = FieldRenderer::new(model)?.render(view, Vec3::ZERO)?;
        let (width, height) = (view.camera.width, view.camera.height);
        let picture = pictures::over_grey(&drawn.image.pixels, &drawn.opacity, width, height);
        let written = pictures::save(&picture, &self.path);
        self.due = start + EVERY.max(SHARE * start.elapsed());
        written
    }
}
