//! A tiny capture on disk, and a writer of the few pickle opcodes it takes.

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

/// What a test pickle is made of.
#[derive(Clone)]
pub enum Py {
    Dict(Vec<(String, Py)>),
    Array(Vec<u32>, Vec<f64>),
    Text(&'static str),
}

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

    fn write(&self, out: &mut Vec<u8>) {
        match self {
            Self::Dict(items) => {
                out.extend(b"}(");
                for (key, value) in items {
                    text(key, out);
                    value.write(out);
                }
                out.push(b'u');
            }
            Self::Text(words) => text(words, out),
            Self::Array(shape, values) => {
                // _reconstruct(ndarray, (0,), b'b'), then its state (1, shape, dtype('<f8'), False, bytes).
                out.extend(b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\0\x85C\x01b\x87R(K\x01(");
                for &n in shape {
                    out.push(b'J');
                    out.extend(n.to_le_bytes());
                }
                out.extend(b"tcnumpy\ndtype\n");
                text("f8", out);
                out.extend(b"K\0K\x01\x87R(K\x03");
                text("<", out);
                out.extend(b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0tb\x89B");
                out.extend((values.len() as u32 * 8).to_le_bytes());
                out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
                out.extend(b"tb");
            }
        }
    }

    /// A pickle of protocol 3.
    pub fn pickle(&self) -> Vec<u8> {
        let mut out = vec![0x80, 3];
        self.write(&mut out);
        out.push(b'.');
        out
    }
}

fn text(words: &str, out: &mut Vec<u8>) {
    out.push(b'X');
    out.extend((words.len() as u32).to_le_bytes());
    out.extend(words.as_bytes());
}

pub fn array(shape: &[u32], values: &[f64]) -> Py {
    Py::Array(shape.to_vec(), values.to_vec())
}

fn flat(points: &[Vec3]) -> Vec<f64> {
    points.iter().flat_map(|p| p.to_array()).map(f64::from).collect()
}

/// A capture of three frames with an evaluation camera at two of them, removed when dropped.
pub struct Fixture {
    pub dir: PathBuf,
    pub cameras: Py,
    pub mesh_infos: Py,
    pub canonical: Py,
}

impl Fixture {
    pub fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("occnerf-capture-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        let names = [0, 1, 2].map(|i| format!("frame_{i:06}"));
        let joints = flat(&body().shaped(&[0.5]).joints);
        let record = |pairs: &[(&str, Py)]| {
            Py::Dict(pairs.iter().map(|(key, value)| ((*key).to_owned(), value.clone())).collect())
        };
        let camera = record(&[
            ("intrinsics", array(&[3, 3], &[8.0, 0.0, 3.0, 0.0, 8.0, 2.0, 0.0, 0.0, 1.0])),
            (
                "extrinsics",
                array(
                    &[4, 4],
                    // Looks along −z of the world from 4 in front of the body.
                    &[1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 4.0, 0.0, 0.0, 0.0, 1.0],
                ),
            ),
            ("distortions", array(&[5], &[0.0; 5])),
        ]);
        let info = record(&[
            ("Rh", array(&[3], &[0.0, 0.5, 0.0])),
            ("Th", array(&[3], &[0.125, 0.0, 0.0])),
            ("poses", array(&[6], &[0.0, 0.0, 0.0, 0.0, 0.25, 0.0])),
            ("betas", array(&[1], &[0.5])),
            ("tpose_joints", array(&[2, 3], &joints)),
        ]);
        let all = |value: &Py| Py::Dict(names.iter().map(|name| (name.clone(), value.clone())).collect());
        let fixture = Self {
            cameras: all(&camera),
            mesh_infos: all(&info),
            canonical: record(&[("joints", array(&[2, 3], &joints)), ("avg_betas", array(&[1], &[0.5]))]),
            dir,
        };
        fixture.directory("");
        fixture.directory("eval/Camera_B2");
        for kind in ["images", "masks"] {
            let path = fixture.dir.join("eval/Camera_B2").join(kind).join("frame_000001.png");
            std::fs::remove_file(path).unwrap();
        }
        fixture.write();
        fixture
    }

    fn directory(&self, below: &str) {
        let dir = self.dir.join(below);
        for kind in ["images", "masks"] {
            std::fs::create_dir_all(dir.join(kind)).unwrap();
        }
        for i in 0..3 {
            let at = |kind: &str| Path::new(below).join(format!("{kind}/frame_{i:06}.png"));
            let white = image::RgbImage::from_pixel(6, 4, image::Rgb([200; 3]));
            white.save(self.dir.join(at("images"))).unwrap();
            self.mask(at("masks"), 6, 4, 255);
        }
    }

    /// A mask with its middle columns at `level`.
    pub fn mask(&self, path: impl AsRef<Path>, width: u32, height: u32, level: u8) {
        let mask = image::RgbImage::from_fn(width, height, |x, _| {
            image::Rgb([if x.abs_diff(width / 2) < 2 { level } else { 0 }; 3])
        });
        mask.save(self.dir.join(path)).unwrap();
    }

    /// Writes the pickles, after a test has changed what is in them.
    pub fn write(&self) {
        let put = |path: &str, value: &Py| std::fs::write(self.dir.join(path), value.pickle()).unwrap();
        put("cameras.pkl", &self.cameras);
        put("mesh_infos.pkl", &self.mesh_infos);
        put("canonical_joints.pkl", &self.canonical);
        let (mut cameras, mut infos) = (self.cameras.clone(), self.mesh_infos.clone());
        cameras.remove(&["frame_000001"]);
        infos.remove(&["frame_000001"]);
        put("eval/Camera_B2/cameras.pkl", &cameras);
        put("eval/Camera_B2/mesh_infos.pkl", &infos);
    }
}

impl Drop for Fixture {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.dir);
    }
}
