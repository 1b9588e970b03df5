//! The pixels of frames: in memory, or in files that are decoded when asked for.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use glam::Vec3;

use super::files::Files;
use super::packed::Packed;
use super::pixels::{Edit, Pixels};
use super::spill::{Spill, Spilled};
use super::{CaptureError, Image};

/// Where the pixels of a frame are. Copies share what is decoded.
#[derive(Clone, Debug)]
pub struct PixelSource {
    place: Place,
    /// The pixels before their mask was made wrong, where no file has them.
    before: Option<Arc<PixelSource>>,
}

#[derive(Clone, Debug)]
enum Place {
    Memory(Arc<Pixels>),
    Spilled(Arc<Spilled>),
    Disk(Arc<OnDisk>),
}

#[derive(Debug)]
struct OnDisk {
    files: Arc<Files>,
    edits: Vec<Edit>,
    keep: Keep,
    /// What the first decoding left; `None` where there was no room.
    kept: OnceLock<Option<Kept>>,
}

/// What stays in memory of pixels once they are decoded.
#[derive(Clone, Debug)]
pub(super) enum Keep {
    /// All, as they are.
    Whole,
    /// Few bytes that say the same, while there is room.
    Packed(Arc<Allowance>),
}

#[derive(Clone, Debug)]
enum Kept {
    Whole(Arc<Pixels>),
    Packed(Arc<(Packed, Room)>),
}

/// Bytes for packed pixels, first come, first served.
#[derive(Debug)]
pub(super) struct Allowance {
    left: AtomicU64,
    /// Whether somebody had to go without.
    spent: AtomicBool,
}

/// Bytes of an [`Allowance`], given back when dropped.
#[derive(Debug)]
struct Room {
    of: Arc<Allowance>,
    bytes: u64,
}

impl Allowance {
    pub fn new(bytes: u64) -> Self {
        Self { left: AtomicU64::new(bytes), spent: AtomicBool::new(false) }
    }

    fn take(self: &Arc<Self>, bytes: u64) -> Option<Room> {
        let less = |left: u64| left.checked_sub(bytes);
        if self.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less).is_err() {
            self.spent.store(true, Ordering::Relaxed);
            return None;
        }
        Some(Room { of: Arc::clone(self), bytes })
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        self.of.left.fetch_add(self.bytes, Ordering::Relaxed);
    }
}

impl Keep {
    fn of(&self, pixels: &Arc<Pixels>) -> Option<Kept> {
        match self {
            Self::Whole => Some(Kept::Whole(Arc::clone(pixels))),
            Self::Packed(allowance) => {
                let packed = Packed::new(pixels);
                let room = allowance.take(packed.bytes())?;
                Some(Kept::Packed(Arc::new((packed, room))))
            }
        }
    }
}

/// Pixels to look at one by one.
pub(crate) struct Shown(Kept);

impl Shown {
    /// Premultiplied colour and coverage of a pixel.
    ///
    /// # Panics
    /// Outside the picture.
    pub fn at(&self, pixel: u32) -> (Vec3, f32) {
        match &self.0 {
            Kept::Whole(pixels) => {
                let i = pixel as usize;
                (Vec3::from_slice(&pixels.image.pixels[3 * i..]), pixels.mask[i])
            }
            Kept::Packed(packed) => packed.0.at(pixel),
        }
    }
}

impl From<Pixels> for PixelSource {
    fn from(pixels: Pixels) -> Self {
        Place::Memory(Arc::new(pixels)).into()
    }
}

impl From<Place> for PixelSource {
    fn from(place: Place) -> Self {
        Self { place, before: None }
    }
}

impl PixelSource {
    /// Pixels that are decoded when asked for, and kept as `keep` says.
    pub(super) fn on_disk(files: Files, keep: Keep) -> Self {
        let on_disk = OnDisk { files: Arc::new(files), edits: Vec::new(), keep, kept: OnceLock::new() };
        Place::Disk(Arc::new(on_disk)).into()
    }

    /// Pixels in a file.
    pub(super) fn spilled(pixels: &Pixels, spill: &Arc<Spill>) -> Result<Self, CaptureError> {
        Ok(Place::Spilled(Arc::new(spill.add(pixels)?)).into())
    }

    /// The pixels.
    ///
    /// # Errors
    /// For files that cannot be read any more, or never were readable; none for pixels in memory.
    pub fn pixels(&self) -> Result<Arc<Pixels>, CaptureError> {
        match &self.place {
            Place::Memory(pixels) => Ok(Arc::clone(pixels)),
            Place::Spilled(spilled) => spilled.pixels().map(Arc::new),
            Place::Disk(disk) => match disk.kept.get() {
                Some(Some(Kept::Whole(kept))) => Ok(Arc::clone(kept)),
                Some(Some(Kept::Packed(packed))) => Ok(Arc::new(packed.0.pixels())),
                found => {
                    let mut pixels = disk.files.decode()?;
                    disk.edits.iter().for_each(|edit| edit.apply(&mut pixels));
                    let pixels = Arc::new(pixels);
                    if found.is_none() {
                        disk.kept.get_or_init(|| disk.keep.of(&pixels));
                    }
                    Ok(pixels)
                }
            },
        }
    }

    /// The pixels where a few of them are asked for: packed ones stay so.
    ///
    /// # Errors
    /// As of [`PixelSource::pixels`].
    pub(crate) fn shown(&self) -> Result<Shown, CaptureError> {
        if let Place::Disk(disk) = &self.place
            && let Some(Some(kept)) = disk.kept.get()
        {
            return Ok(Shown(kept.clone()));
        }
        Ok(Shown(Kept::Whole(self.pixels()?)))
    }

    /// The picture with what its mask hides; `None` for pixels that were never photographed.
    pub(crate) fn photograph(&self) -> Option<Result<Image, CaptureError>> {
        match (&self.place, &self.before) {
            (Place::Disk(disk), _) => Some(disk.files.photograph()),
            (_, Some(before)) => Some(before.pixels().map(|pixels| pixels.image.clone())),
            _ => None,
        }
    }

    /// Whether an obstacle that no photograph shows hides a pixel of a picture of this width.
    pub(crate) fn hides(&self, pixel: usize, width: u32) -> bool {
        let Place::Disk(disk) = &self.place else { return false };
        let edited = disk.edits.iter().any(|edit| matches!(edit, Edit::Hide(area) if area.contains(pixel, width)));
        edited || disk.files.hidden.is_some()
    }

    /// Changes the pixels, which do not come from their files from then on.
    ///
    /// # Errors
    /// As of [`PixelSource::pixels`].
    pub fn change(&mut self, change: impl FnOnce(&mut Pixels)) -> Result<(), CaptureError> {
        let mut pixels = Arc::unwrap_or_clone(self.pixels()?);
        change(&mut pixels);
        *self = match &self.place {
            Place::Spilled(spilled) => Self::spilled(&pixels, spilled.spill())?,
            _ => pixels.into(),
        };
        Ok(())
    }

    /// Decodes what is to be kept, and looks at the headers of the rest.
    pub(super) fn check(&self) -> Result<(), CaptureError> {
        match &self.place {
            Place::Disk(disk) if matches!(&disk.keep, Keep::Packed(room) if room.spent.load(Ordering::Relaxed)) => {
                disk.files.check()
            }
            _ => self.pixels().map(drop),
        }
    }

    /// Makes the mask wrong, and leaves the photograph as it is: pixels that are in memory alone
    /// are kept as they were, too.
    ///
    /// # Errors
    /// As of [`PixelSource::pixels`] for pixels in a file of their own.
    pub(super) fn spoil(&mut self, edit: Edit) -> Result<(), CaptureError> {
        let before = match &self.place {
            Place::Disk(_) => None,
            _ => Some(self.before.clone().unwrap_or_else(|| Arc::new(self.clone()))),
        };
        self.edit(edit)?;
        self.before = before;
        Ok(())
    }

    /// Makes a change, now or whenever the pixels are decoded.
    ///
    /// # Errors
    /// As of [`PixelSource::pixels`] for pixels in a file of their own.
    pub(super) fn edit(&mut self, edit: Edit) -> Result<(), CaptureError> {
        match &mut self.place {
            Place::Memory(pixels) => edit.apply(Arc::make_mut(pixels)),
            Place::Spilled(_) => {
                let before = self.before.take();
                self.change(|pixels| edit.apply(pixels))?;
                self.before = before;
            }
            Place::Disk(disk) => {
                let kept = match Arc::get_mut(disk) {
                    Some(own) => own.kept.take(),
                    None => disk.kept.get().cloned(),
                };
                let edits = disk.edits.iter().cloned().chain([edit.clone()]).collect();
                // Packed pixels are decoded and packed again.
                let kept = match kept.flatten() {
                    Some(Kept::Whole(mut pixels)) => {
                        edit.apply(Arc::make_mut(&mut pixels));
                        OnceLock::from(Some(Kept::Whole(pixels)))
                    }
                    _ => OnceLock::new(),
                };
                *disk = Arc::new(OnDisk { files: Arc::clone(&disk.files), edits, keep: disk.keep.clone(), kept });
            }
        }
        Ok(())
    }
}
