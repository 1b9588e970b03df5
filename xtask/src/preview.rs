//! `train --preview`: a rendering during training.

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
/// Least time between two in multiples of the last rendering's.
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

    /// Renders the first training view, if due.
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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use occnerf::{Config, Method, Preset, Scene, Trainer};
    use synth::{DemoConfig, demo};

    use super::*;

    #[test]
    fn a_picture_is_drawn_when_it_is_due_and_then_not_for_a_while() {
        let folder = testkit::files::Directory::new("preview");
        let body = smpl::BodyModel::embedded();
        let capture =
            demo(&DemoConfig { size: 24, frames: 3, eval_cameras: 1, ..DemoConfig::default() }, &body).unwrap();
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        config.registration.rounds = 0;
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let trainer = Trainer::new(&scene, config).unwrap();
        let mut preview = Preview::new(folder.path());
        preview.draw(trainer.model()).unwrap();
        assert!(!preview.path.exists(), "not due yet");
        preview.due = Instant::now();
        preview.draw(trainer.model()).unwrap();
        let picture = image::open(&preview.path).unwrap().to_rgb8();
        assert_eq!(picture.dimensions(), (24, 24));
        assert!(picture.pixels().any(|pixel| pixel != picture.get_pixel(0, 0)), "nobody is to be seen");
        assert!(preview.due >= Instant::now() + EVERY / 2);
        std::fs::remove_file(&preview.path).unwrap();
        preview.draw(trainer.model()).unwrap();
        assert!(!preview.path.exists(), "drawn twice");
    }
}
