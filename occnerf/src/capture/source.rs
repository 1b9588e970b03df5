//! The pixels of frames: in memory, or in files that are decoded when asked for.

use std::sync::{Arc, OnceLock};

use super::files::Files;
use super::pixels::{Edit, Pixels};
use super::{CaptureError, Image};

/// Where the pixels of a frame are. Copies share what is decoded.
#[derive(Clone, Debug)]
pub struct PixelSource(Place);

#[derive(Clone, Debug)]
enum Place {
    Memory(Arc<Pixels>),
    Disk(Arc<OnDisk>),
}

#[derive(Debug)]
struct OnDisk {
    files: Arc<Files>,
    edits: Vec<Edit>,
    /// Whether the pixels stay in memory once they are decoded.
    keep: bool,
    kept: OnceLock<Arc<Pixels>>,
}

impl From<Pixels> for PixelSource {
    fn from(pixels: Pixels) -> Self {
        Self(Place::Memory(Arc::new(pixels)))
    }
}

impl PixelSource {
    /// Pixels that are decoded when asked for, the first time only if `keep`.
    pub(super) fn on_disk(files: Files, keep: bool) -> Self {
        let on_disk = OnDisk { files: Arc::new(files), edits: Vec::new(), keep, kept: OnceLock::new() };
        Self(Place::Disk(Arc::new(on_disk)))
    }

    /// The pixels.
    ///
    /// # Errors
    /// For files that cannot be read any more, or never were readable; none for pixels in memory.
    pub fn pixels(&self) -> Result<Arc<Pixels>, CaptureError> {
        match &self.0 {
            Place::Memory(pixels) => Ok(Arc::clone(pixels)),
            Place::Disk(disk) => {
                if let Some(kept) = disk.kept.get() {
                    return Ok(Arc::clone(kept));
                }
                let mut pixels = disk.files.decode()?;
                disk.edits.iter().for_each(|edit| edit.apply(&mut pixels));
                let pixels = Arc::new(pixels);
                Ok(if disk.keep { Arc::clone(disk.kept.get_or_init(|| pixels)) } else { pixels })
            }
        }
    }

    /// The picture with what its mask hides; `None` for pixels in memory, which lack that.
    pub(crate) fn photograph(&self) -> Option<Result<Image, CaptureError>> {
        match &self.0 {
            Place::Memory(_) => None,
            Place::Disk(disk) => Some(disk.files.photograph()),
        }
    }

    /// Changes the pixels; they stay in memory from then on.
    ///
    /// # Errors
    /// As of [`PixelSource::pixels`].
    pub fn change(&mut self, change: impl FnOnce(&mut Pixels)) -> Result<(), CaptureError> {
        let mut pixels = Arc::unwrap_or_clone(self.pixels()?);
        change(&mut pixels);
        *self = pixels.into();
        Ok(())
    }

    /// Decodes what is to be kept, and looks at the headers of the rest.
    pub(super) fn check(&self) -> Result<(), CaptureError> {
        match &self.0 {
            Place::Disk(disk) if !disk.keep => disk.files.check(),
            _ => self.pixels().map(drop),
        }
    }

    /// Makes a change, now or whenever the pixels are decoded.
    pub(super) fn edit(&mut self, edit: Edit) {
        match &mut self.0 {
            Place::Memory(pixels) => edit.apply(Arc::make_mut(pixels)),
            Place::Disk(disk) => {
                let mut kept = match Arc::get_mut(disk) {
                    Some(own) => own.kept.take(),
                    None => disk.kept.get().cloned(),
                };
                if let Some(pixels) = &mut kept {
                    edit.apply(Arc::make_mut(pixels));
                }
                let edits = disk.edits.iter().cloned().chain([edit]).collect();
                let kept = kept.map_or_else(OnceLock::new, OnceLock::from);
                *disk = Arc::new(OnDisk { files: Arc::clone(&disk.files), edits, keep: disk.keep, kept });
            }
        }
    }
}
