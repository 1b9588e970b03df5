//! Pixels in a file without a name, for captures made on the spot that memory has no room for.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::packed::Rows;
use super::{CaptureError, Pixels};

/// Bytes of a pixel's colour and coverage.
const VALUE: usize = 16;

/// A file in the system's folder for temporary ones, gone with the process whatever ends it.
#[derive(Debug)]
pub(super) struct Spill {
    path: PathBuf,
    file: Mutex<File>,
}

/// Pixels in a [`Spill`].
#[derive(Debug)]
pub(super) struct Spilled {
    spill: Arc<Spill>,
    rows: Rows,
    start: u64,
}

impl Spill {
    /// An empty file.
    pub fn new() -> Result<Self, CaptureError> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let name = format!("occnerf-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(name);
        let mut options = File::options();
        let file = options.read(true).write(true).create_new(true).open(&path).map_err(CaptureError::io(&path))?;
        // Where an open file keeps its name, it goes when this is dropped.
        let _ = std::fs::remove_file(&path);
        Ok(Self { path, file: Mutex::new(file) })
    }

    /// Puts pixels behind those that are there.
    pub fn add(self: &Arc<Self>, pixels: &Pixels) -> Result<Spilled, CaptureError> {
        let (rows, values) = Rows::new(pixels);
        let bytes: Vec<u8> = values.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
        let start = self.with(|file| {
            let start = file.seek(SeekFrom::End(0))?;
            file.write_all(&bytes)?;
            Ok(start)
        })?;
        Ok(Spilled { spill: Arc::clone(self), rows, start })
    }

    fn with<T>(&self, work: impl FnOnce(&mut File) -> std::io::Result<T>) -> Result<T, CaptureError> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        work(&mut file).map_err(CaptureError::io(&self.path))
    }
}

impl Drop for Spill {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

impl Spilled {
    /// Where the pixels are.
    pub fn spill(&self) -> &Arc<Spill> {
        &self.spill
    }

    /// The pixels as they were.
    pub fn pixels(&self) -> Result<Pixels, CaptureError> {
        let mut bytes = vec![0; self.rows.len() * VALUE];
        self.spill.with(|file| {
            file.seek(SeekFrom::Start(self.start))?;
            file.read_exact(&mut bytes)
        })?;
        let float = |at: usize| f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        Ok(self.rows.pixels(|at| [0, 4, 8, 12].map(|part| float(at * VALUE + part))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Image;

    #[test]
    fn pixels_come_back_from_the_file_and_leave_nothing_behind() {
        let spill = Arc::new(Spill::new().unwrap());
        let made = |n: usize| {
            let mut image = Image::new(5, 4);
            image.pixels[3 * n..3 * n + 9].copy_from_slice(&[0.1, -0.0, 1e-30, 0.5, 0.25, f32::MAX, 0.0, 0.0, 1.0]);
            let mask = (0..20).map(|i| if i == n { 0.75 } else { 0.0 }).collect();
            Pixels { image, mask, occluder: (n.is_multiple_of(2)).then(|| (0..20).map(|i| i > n).collect()) }
        };
        let spilled: Vec<Spilled> = (0..9).map(|n| spill.add(&made(n)).unwrap()).collect();
        for (n, spilled) in spilled.iter().enumerate().rev() {
            assert_eq!(spilled.pixels().unwrap(), made(n));
        }
        let path = spill.path.clone();
        drop((spill, spilled));
        assert!(!path.exists());
    }
}
