//! Test directories, and the shared test data.

use std::path::{Path, PathBuf};

/// An empty directory, removed when dropped.
pub struct Directory(PathBuf);

impl Directory {
    /// Makes it, empty.
    ///
    /// # Panics
    /// Where the system refuses; so do all methods.
    #[must_use]
    pub fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("occnerf-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        make(&dir);
        Self(dir)
    }

    /// Its path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
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
