//! Sources of a frame's pixels: memory, or files decoded on demand.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use super::files::{Files, FrameFiles};
use super::packed::PackedPixels;
use super::pixels::{Area, Pixels};
use super::{CaptureError, Image};

/// The pixels of a frame, packed in memory or in files. Clones share decoded pixels.
///
/// ```
/// use capture::{Area, LoadOptions, load_capture};
///
/// let few = LoadOptions { max_frames: Some(2), ..LoadOptions::default() };
/// let mut capture = load_capture("../../xtask/demo".as_ref(), &smpl::BodyModel::embedded(), &few)?;
/// let source = &mut capture.train[0].source;
/// source.hide(Area { columns: 0..192, rows: 0..192 });
/// assert!(source.pixels()?.mask.iter().all(|coverage| *coverage == 0.0));
/// # Ok::<(), capture::CaptureError>(())
/// ```
#[derive(Clone, Debug)]
pub struct PixelSource(Place);

#[derive(Clone, Debug)]
enum Place {
    Memory(PixelReader),
    Disk(Arc<OnDisk>),
}

/// An edit of pixels, repeated at each decoding.
type Edit = Arc<dyn Fn(&mut Pixels) + Send + Sync>;

struct OnDisk {
    files: Arc<Files>,
    edits: Vec<Edit>,
    allowance: Arc<Allowance>,
    /// Packed pixels after the first decoding; `None` with the allowance exhausted.
    kept: OnceLock<Option<PixelReader>>,
}

/// Random access to packed pixels, which are in memory or take room of an allowance.
#[derive(Clone, Debug)]
pub struct PixelReader(Arc<(PackedPixels, Option<Room>)>);

/// Bytes for packed pixels, first come, first served.
#[derive(Debug)]
pub(super) struct Allowance {
    left: AtomicU64,
    /// Whether a request was refused.
    spent: AtomicBool,
}

/// Bytes of an [`Allowance`], returned on drop.
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

impl fmt::Debug for OnDisk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("OnDisk").field("files", &self.files).finish_non_exhaustive()
    }
}

impl OnDisk {
    fn decode(&self) -> Result<Pixels, CaptureError> {
        let mut pixels = self.files.decode()?;
        self.edits.iter().for_each(|edit| edit(&mut pixels));
        Ok(pixels)
    }

    /// Keeps the decoded pixels packed, within the allowance.
    fn keep(&self, pixels: &Pixels) {
        self.kept.get_or_init(|| {
            let packed = PackedPixels::new(pixels);
            let room = self.allowance.take(packed.bytes())?;
            Some(PixelReader(Arc::new((packed, Some(room)))))
        });
    }

    /// A copy without decoded pixels.
    fn undecoded(&self) -> Self {
        Self {
            files: Arc::clone(&self.files),
            edits: self.edits.clone(),
            allowance: Arc::clone(&self.allowance),
            kept: OnceLock::new(),
        }
    }
}

impl std::ops::Deref for PixelReader {
    type Target = PackedPixels;

    fn deref(&self) -> &PackedPixels {
        &self.0.0
    }
}

impl From<&Pixels> for PixelReader {
    fn from(pixels: &Pixels) -> Self {
        Self(Arc::new((PackedPixels::new(pixels), None)))
    }
}

impl From<Pixels> for PixelSource {
    fn from(pixels: Pixels) -> Self {
        Self(Place::Memory((&pixels).into()))
    }
}

impl PixelSource {
    /// Pixels decoded on demand, and kept packed within `allowance`.
    pub(super) fn on_disk(files: Files, allowance: Arc<Allowance>) -> Self {
        let (files, edits, kept) = (Arc::new(files), Vec::new(), OnceLock::new());
        Self(Place::Disk(Arc::new(OnDisk { files, edits, allowance, kept })))
    }

    /// The pixels, unpacked or decoded.
    ///
    /// # Errors
    /// Unreadable files; none for pixels in memory.
    pub fn pixels(&self) -> Result<Pixels, CaptureError> {
        match &self.0 {
            Place::Memory(packed) => Ok(packed.pixels()),
            Place::Disk(disk) => match disk.kept.get() {
                Some(Some(kept)) => Ok(kept.pixels()),
                Some(None) => disk.decode(),
                None => {
                    let pixels = disk.decode()?;
                    disk.keep(&pixels);
                    Ok(pixels)
                }
            },
        }
    }

    /// Random access without unpacking.
    ///
    /// # Errors
    /// As of [`PixelSource::pixels`].
    pub fn reader(&self) -> Result<PixelReader, CaptureError> {
        let disk = match &self.0 {
            Place::Memory(packed) => return Ok(packed.clone()),
            Place::Disk(disk) => disk,
        };
        if disk.kept.get().is_none() {
            self.pixels()?;
        }
        match disk.kept.get() {
            Some(Some(kept)) => Ok(kept.clone()),
            _ => Ok((&self.pixels()?).into()),
        }
    }

    /// The unmasked picture; `None` for pixels in memory.
    #[must_use]
    pub fn photograph(&self) -> Option<Result<Image, CaptureError>> {
        match &self.0 {
            Place::Disk(disk) => Some(disk.files.photograph()),
            Place::Memory(_) => None,
        }
    }

    /// Files of picture and masks, and how they are decoded; none for pixels in memory.
    #[must_use]
    pub fn origin(&self) -> (Vec<&Path>, String) {
        let Place::Disk(disk) = &self.0 else { return Default::default() };
        let FrameFiles { image, masks, occluder, labels, hidden, lens } = &disk.files.of;
        let paths = [image].into_iter().chain(masks).chain(occluder).map(PathBuf::as_path).collect();
        (paths, format!("{labels} {hidden:?} {lens:?} {:?}", disk.files.to))
    }

    /// Whether a simulated obstacle, absent from the photograph, masks pixels.
    #[must_use]
    pub fn is_hidden(&self) -> bool {
        matches!(&self.0, Place::Disk(disk) if disk.files.of.hidden.is_some())
    }

    /// Decodes within the allowance, and checks headers beyond it.
    pub(super) fn check(&self) -> Result<(), CaptureError> {
        match &self.0 {
            Place::Disk(disk) if disk.allowance.spent.load(Ordering::Relaxed) => disk.files.check(),
            _ => self.pixels().map(drop),
        }
    }

    /// Edits the pixels, now or at each decoding; the photograph is unchanged.
    pub fn edit(&mut self, edit: impl Fn(&mut Pixels) + Send + Sync + 'static) {
        match &mut self.0 {
            Place::Memory(packed) => {
                let mut pixels = packed.pixels();
                edit(&mut pixels);
                *self = pixels.into();
            }
            Place::Disk(disk) => {
                let mut changed = disk.undecoded();
                if let Some(Some(kept)) = disk.kept.get() {
                    let mut pixels = kept.pixels();
                    edit(&mut pixels);
                    changed.keep(&pixels);
                }
                changed.edits.push(Arc::new(edit));
                *disk = Arc::new(changed);
            }
        }
    }

    /// Simulates an obstacle over an area of pixels, replacing an earlier one.
    pub fn hide(&mut self, area: Area) {
        match &mut self.0 {
            Place::Memory(_) => self.edit(move |pixels| pixels.hide(&area)),
            Place::Disk(disk) => {
                let files = Arc::new(disk.files.hidden_behind(&area));
                *disk = Arc::new(OnDisk { files, ..disk.undecoded() });
            }
        }
    }
}
