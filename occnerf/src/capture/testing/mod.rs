//! A tiny body, a writer of the few pickle opcodes that captures take, and directories that go
//! away.

use std::path::{Path, PathBuf};

use glam::Vec3;
use smpl::{BodyModel, SparseRows};

/// A box with a joint at either end and one beta that lengthens it.
pub fn body() -> BodyModel {
    let corner = |i: u32, axis: u32| if i >> axis & 1 == 1 { 1.0 } else { -1.0 };
    let v_template: Vec<Vec3> =
        (0..8).map(|i| Vec3::new(corner(i, 0) * 0.2, corner(i, 1) * 0.85, corner(i, 2) * 0.1)).collect();
    let face = |[a, b, c, d]: [u32; 4]| [[a, b, c], [a, c, d]];
    let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let top = |i: u32| u32::from(i >> 1 & 1 == 1);
    BodyModel {
        faces: quads.into_iter().flat_map(face).collect(),
        shapedirs: v_template.iter().map(|v| Vec3::Y * v.y * 0.1).collect(),
        posedirs: SparseRows::from_rows((0..8).map(|_| Vec::<(u32, Vec3)>::new())),
        weights: SparseRows::from_rows((0..8).map(|i| [(top(i), 1.0f32)])),
        j_regressor: SparseRows::from_rows([[0, 1, 4, 5], [2, 3, 6, 7]].map(|row: [u32; 4]| row.map(|v| (v, 0.25f32)))),
        parents: vec![None, Some(0)],
        v_template,
    }
}

pub use crate::capture::write::pickle::Py;

impl Py {
    /// Replaces the entry at a path of keys, or adds it.
    pub fn set(&mut self, keys: &[&str], value: Py) {
        let Self::Dict(items) = self else { panic!("not a dictionary") };
        let found = items.iter_mut().find(|(key, _)| key == keys[0]);
        match (found, &keys[1..]) {
            (Some((_, slot)), []) => *slot = value,
            (Some((_, slot)), rest) => slot.set(rest, value),
            (None, _) => items.push((keys[0].to_owned(), value)),
        }
    }

    pub fn remove(&mut self, keys: &[&str]) {
        let Self::Dict(items) = self else { panic!("not a dictionary") };
        if let [last] = keys {
            items.retain(|(key, _)| key != last);
        } else if let Some((_, slot)) = items.iter_mut().find(|(key, _)| key == keys[0]) {
            slot.remove(&keys[1..]);
        }
    }

    /// The item at a path of keys; a number is a place in a list.
    pub fn at(&mut self, keys: &[&str]) -> &mut Py {
        let Some((first, rest)) = keys.split_first() else { return self };
        let found = match self {
            Self::Dict(items) => items.iter_mut().find(|(key, _)| key == first).map(|(_, value)| value),
            Self::List(items) => first.parse().ok().and_then(|i: usize| items.get_mut(i)),
            _ => None,
        };
        found.expect("no such item").at(rest)
    }
}

fn npy_header(descr: &str, shape: &str) -> Vec<u8> {
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((header.len() as u16).to_le_bytes());
    out.extend(header.as_bytes());
    out
}

/// An array of points as `numpy.save` writes it.
pub fn points_npy(points: &[Vec3]) -> Vec<u8> {
    let mut out = npy_header("<f4", &format!("({}, 3)", points.len()));
    out.extend(points.iter().flat_map(|p| p.to_array()).flat_map(f32::to_le_bytes));
    out
}

pub fn array(shape: &[u32], values: &[f64]) -> Py {
    Py::Array(shape.to_vec(), values.to_vec())
}

pub fn flat(points: &[Vec3]) -> Vec<f64> {
    points.iter().flat_map(|p| p.to_array()).map(f64::from).collect()
}

/// An empty directory, removed when dropped.
pub struct Directory(PathBuf);

impl Directory {
    pub fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("occnerf-capture-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        std::fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Writes a file below, and the directories it is in.
    pub fn write(&self, file: &str, bytes: impl AsRef<[u8]>) {
        let path = self.0.join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    /// Writes a grey picture below whose middle columns are `level` and the others 0.
    pub fn stripe(&self, file: &str, (width, height): (u32, u32), level: u8) {
        self.picture(file, (width, height), |x, _| if x.abs_diff(width / 2) < 2 { level } else { 0 });
    }

    /// Writes a grey picture below.
    pub fn picture(&self, file: &str, (width, height): (u32, u32), value: impl Fn(u32, u32) -> u8) {
        self.write(file, "");
        let picture = image::GrayImage::from_fn(width, height, |x, y| image::Luma([value(x, y)]));
        picture.save(self.0.join(file)).unwrap();
    }

    pub fn remove(&self, file: &str) {
        std::fs::remove_file(self.0.join(file)).unwrap();
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Variants of a file, each with a few bytes replaced, left out or repeated; always the same ones.
pub fn damaged(whole: &[u8], count: usize) -> impl Iterator<Item = Vec<u8>> + '_ {
    (0..count).map(|case| {
        let mut stream = crate::random::Stream::new(&[0x6461_6d61, case as u64]);
        let mut bytes = whole.to_vec();
        for _ in 0..=case % 3 {
            let at = (stream.uniform() * bytes.len() as f32) as usize % bytes.len().max(1);
            let end = (at + (stream.uniform() * 40.0) as usize).min(bytes.len());
            match case % 4 {
                0 => drop(bytes.drain(at..end)),
                1 => bytes.extend_from_within(at..end),
                _ => bytes[at] = (stream.uniform() * 256.0) as u8,
            }
        }
        bytes
    })
}

/// The directory of shared test data; `None`, with a message, where it is absent.
pub fn shared(below: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data").join(below);
    if path.is_dir() {
        return Some(path);
    }
    println!("skipped: {} is absent", path.display());
    None
}

impl super::Frame {
    /// Its pixels, which can be read.
    #[track_caller]
    pub fn shown(&self) -> std::sync::Arc<super::Pixels> {
        self.pixels().unwrap()
    }
}

/// Overlap of the posed body's silhouette with the mask, over the pixels that no known occluder
/// covers.
pub fn overlap(frame: &super::Frame, body: &BodyModel) -> f32 {
    let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
    let mesh = visibility::RayMesh::new(&posed.vertices, &body.faces).unwrap();
    let (mut both, mut either) = (0, 0);
    for (i, &mask) in frame.shown().mask.iter().enumerate() {
        if frame.shown().occluder.as_ref().is_some_and(|o| o[i]) {
            continue;
        }
        let (column, row) = (i as u32 % frame.shown().image.width, i as u32 / frame.shown().image.width);
        let ray = frame.camera.ray(column as f32 + 0.5, row as f32 + 0.5);
        let (covered, subject) = (mesh.first_hit(ray.origin, ray.direction).is_some(), mask > 0.5);
        both += usize::from(covered && subject);
        either += usize::from(covered || subject);
    }
    both as f32 / either.max(1) as f32
}
