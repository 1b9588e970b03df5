//! A tiny capture on disk.

use std::path::{Path, PathBuf};

use crate::testing::{Py, array, body, flat};

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
