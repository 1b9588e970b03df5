//! Test directories, and the shared test data.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::body::Random;

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

/// A tensor of [`torch`]: name, storage class, number of its storage, offset, shape and strides.
pub type Tensor<'a> = (&'a str, &'a str, usize, u32, Vec<u32>, Vec<u32>);

/// A state dictionary (an `OrderedDict` with `_metadata`) as `torch.save` writes it, in an archive
/// or, `legacy`, as before version 1.6; storages are bytes and the size of an element.
#[must_use]
pub fn torch(tensors: &[Tensor<'_>], storages: &[(Vec<u8>, usize)], legacy: bool) -> Vec<u8> {
    let text = |text: &str| [b"X", &(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
    let list = |numbers: &[u32]| {
        let items = numbers.iter().flat_map(|n| [b"J", &n.to_le_bytes()[..]].concat());
        [b"(", &items.collect::<Vec<u8>>()[..], b"t"].concat()
    };
    let mut pickle = b"\x80\x02ccollections\nOrderedDict\nq\x00)Rq\x01(".to_vec();
    for (name, class, storage, offset, shape, strides) in tensors {
        pickle.extend([text(name), b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec(), text("storage")].concat());
        pickle.extend(format!("ctorch\n{class}\n").bytes());
        pickle.extend([text(&storage.to_string()), text("cpu"), b"K\x08".to_vec()].concat());
        pickle.extend(if legacy { &b"NtQJ"[..] } else { b"tQJ" });
        pickle.extend([&offset.to_le_bytes()[..], &list(shape), &list(strides)].concat());
        pickle.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    }
    pickle.extend([b"u}", &text("_metadata")[..], b"h\x00)Rsb."].concat());
    if !legacy {
        let first = [("x/data.pkl".to_owned(), pickle), ("x/byteorder".to_owned(), b"little".to_vec())];
        let data = storages.iter().enumerate().map(|(key, storage)| (format!("x/data/{key}"), storage.0.clone()));
        return zip(first.into_iter().chain(data));
    }
    let mut out = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.".to_vec();
    out.extend(b"\x80\x02}X\x0d\x00\x00\x00little_endian\x88s.");
    out.extend(pickle);
    let keys = (0..storages.len()).map(|key| key.to_string());
    let keys = keys.flat_map(|key| [b"U", &[key.len() as u8][..], key.as_bytes()].concat());
    out.extend([b"\x80\x02](", &keys.collect::<Vec<u8>>()[..], b"e."].concat());
    for (bytes, size) in storages {
        out.extend([&(bytes.len() as u64 / *size as u64).to_le_bytes()[..], bytes].concat());
    }
    out
}

/// Variants of a file, each with a few bytes replaced, left out or repeated; always the same ones.
pub fn damaged(whole: &[u8], count: usize) -> impl Iterator<Item = Vec<u8>> + '_ {
    (0..count).map(|case| {
        let mut random = Random(case as u64);
        let mut bytes = whole.to_vec();
        for _ in 0..=case % 3 {
            let at = random.below(bytes.len());
            let end = (at + random.below(40)).min(bytes.len());
            match case % 4 {
                0 => drop(bytes.drain(at..end)),
                1 => bytes.extend_from_within(at..end),
                _ => bytes[at] = random.below(256) as u8,
            }
        }
        bytes
    })
}

/// JSON and binary data of a glTF rig: a strip of two triangles on two joints, the second 1 above
/// the first and turning about z.
#[must_use]
pub fn arm() -> (String, Vec<u8>) {
    let mut bytes: Vec<u8> = Vec::new();
    let mut floats = |values: &[f32]| bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    // 0: positions at 0, 4 × 3
    floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 1.0, 2.0, 0.0]);
    // 1: weights at 48, 4 × 4; not normalised on purpose
    floats(&[2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0]);
    // 2: inverse bind matrices at 112, 2 × 16: identity, and 1 down
    floats(&[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    floats(&[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 1.0]);
    // 3: times at 240, 2
    floats(&[1.0, 3.0]);
    // 4: rotations at 248, 2 × 4: none, and a quarter turn about z
    let half = std::f32::consts::FRAC_1_SQRT_2;
    floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, half, half]);
    // 5: cubic translations at 280, 6 × 3: in, value, out; from (0,1,0) at rest to (2,1,0) at rest
    floats(&[0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    // 6: joints at 352, 4 × 4 u8
    bytes.extend([0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0]);
    // 7: indices at 368, 6 u16
    bytes.extend([0u16, 1, 2, 2, 1, 3].iter().flat_map(|v| v.to_le_bytes()));
    let views = [(0, 48), (48, 64), (112, 128), (240, 8), (248, 32), (280, 72), (352, 16), (368, 12)];
    let views: Vec<String> =
        (views.iter()).map(|(at, n)| format!(r#"{{"buffer":0,"byteOffset":{at},"byteLength":{n}}}"#)).collect();
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0,2]}}],
"nodes":[{{"children":[1],"name":"root"}},{{"translation":[0,1,0],"name":"tip"}},{{"mesh":0,"skin":0}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"WEIGHTS_0":1,"JOINTS_0":6}},"indices":7}}]}}],
"skins":[{{"joints":[0,1],"inverseBindMatrices":2}}],
"animations":[{{"name":"bend","samplers":[{{"input":3,"output":4}},{{"input":3,"output":5,"interpolation":"CUBICSPLINE"}},{{"input":3,"output":4,"interpolation":"STEP"}}],
"channels":[{{"sampler":0,"target":{{"node":1,"path":"rotation"}}}}]}},
{{"samplers":[{{"input":3,"output":5,"interpolation":"CUBICSPLINE"}}],"channels":[{{"sampler":0,"target":{{"node":1,"path":"translation"}}}}]}},
{{"samplers":[{{"input":3,"output":4,"interpolation":"STEP"}}],"channels":[{{"sampler":0,"target":{{"node":1,"path":"rotation"}}}}]}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,2,0]}},
{{"bufferView":1,"componentType":5126,"count":4,"type":"VEC4"}},
{{"bufferView":2,"componentType":5126,"count":2,"type":"MAT4"}},
{{"bufferView":3,"componentType":5126,"count":2,"type":"SCALAR","min":[1],"max":[3]}},
{{"bufferView":4,"componentType":5126,"count":2,"type":"VEC4"}},
{{"bufferView":5,"componentType":5126,"count":6,"type":"VEC3"}},
{{"bufferView":6,"componentType":5121,"count":4,"type":"VEC4"}},
{{"bufferView":7,"componentType":5123,"count":6,"type":"SCALAR"}}],
"bufferViews":[{}],"buffers":[{{"byteLength":380}}]}}"#,
        views.join(",")
    );
    (json, bytes)
}
