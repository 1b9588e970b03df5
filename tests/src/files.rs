//! Test directories, and the shared test data.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// An empty directory, removed when dropped.
pub struct Directory(PathBuf);

impl Directory {
    /// Makes it, empty.
    ///
    /// # Panics
    /// Where the system refuses; so do all methods.
    #[must_use]
    pub fn new(name: &str) -> Self {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let dir = std::env::temp_dir().join(format!("occnerf-{name}-{}-{count}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        make(&dir);
        Self(dir)
    }

    /// Its path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The path of a file below.
    #[must_use]
    pub fn file(&self, below: &str) -> PathBuf {
        self.0.join(below)
    }

    /// Writes a file below, and the directories it is in.
    pub fn write(&self, file: &str, bytes: impl AsRef<[u8]>) {
        let path = self.0.join(file);
        path.parent().into_iter().for_each(make);
        std::fs::write(&path, bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    }

    /// Writes a grey picture below whose middle columns are `level` and the others 0.
    pub fn stripe(&self, file: &str, (width, height): (u32, u32), level: u8) {
        self.picture(file, (width, height), |x, _| if x.abs_diff(width / 2) < 2 { level } else { 0 });
    }

    /// Writes a grey picture below.
    pub fn picture(&self, file: &str, (width, height): (u32, u32), value: impl Fn(u32, u32) -> u8) {
        self.write(file, "");
        let picture = image::GrayImage::from_fn(width, height, |x, y| image::Luma([value(x, y)]));
        let saved = picture.save(self.0.join(file));
        saved.unwrap_or_else(|error| panic!("{file}: {error}"));
    }

    /// Removes a file below.
    pub fn remove(&self, file: &str) {
        std::fs::remove_file(self.0.join(file)).unwrap_or_else(|error| panic!("{file}: {error}"));
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn make(dir: &Path) {
    std::fs::create_dir_all(dir).unwrap_or_else(|error| panic!("{}: {error}", dir.display()));
}

/// A directory or a file of the shared test data; `None`, with a message, where it is absent.
#[must_use]
pub fn shared(below: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(below);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: {} is absent", path.display());
    None
}

/// A `.npy` of little-endian `data`, row-major: its element type as numpy writes it, and its shape.
#[must_use]
pub fn npy(descr: &str, shape: &[usize], data: &[u8]) -> Vec<u8> {
    let shape: String = shape.iter().map(|n| format!("{n},")).collect();
    npy_of(&format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}\n"), data)
}

/// A `.npy` of any header.
#[must_use]
pub fn npy_of(header: &str, data: &[u8]) -> Vec<u8> {
    [b"\x93NUMPY\x01\0", &(header.len() as u16).to_le_bytes()[..], header.as_bytes(), data].concat()
}

/// An archive of files by name, not compressed.
///
/// # Panics
/// For two of a name.
#[must_use]
pub fn zip<N: AsRef<str>, B: AsRef<[u8]>>(files: impl IntoIterator<Item = (N, B)>) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for (name, bytes) in files {
        let name = name.as_ref();
        let written = zip.start_file(name, stored).and_then(|()| Ok(zip.write_all(bytes.as_ref())?));
        written.unwrap_or_else(|error| panic!("{name}: {error}"));
    }
    zip.finish().unwrap_or_else(|error| panic!("zip: {error}")).into_inner()
}

/// A .glb of one JSON and one binary chunk.
#[must_use]
pub fn glb(json: impl AsRef<[u8]>, binary: &[u8]) -> Vec<u8> {
    let mut json = json.as_ref().to_vec();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut out = b"glTF\x02\0\0\0".to_vec();
    out.extend((28 + json.len() as u32 + binary.len() as u32).to_le_bytes());
    out.extend((json.len() as u32).to_le_bytes());
    out.extend(b"JSON");
    out.extend(&json);
    out.extend((binary.len() as u32).to_le_bytes());
    out.extend(b"BIN\0");
    out.extend(binary);
    out
}
