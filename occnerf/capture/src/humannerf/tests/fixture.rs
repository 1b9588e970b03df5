//! A tiny capture on disk.

use crate::testing::{Directory, Py, array, body, flat};

pub const SIZE: (u32, u32) = (6, 4);

/// A capture of three frames with an evaluation camera at two of them.
pub struct Fixture {
    pub dir: Directory,
    pub cameras: Py,
    pub mesh_infos: Py,
    pub canonical: Py,
}

impl Fixture {
    pub fn new(name: &str) -> Self {
        let joints = array(&[2, 3], &flat(&body().shaped(&[0.5]).joints));
        let camera = Py::record([
            ("intrinsics", array(&[3, 3], &[8.0, 0.0, 3.0, 0.0, 8.0, 2.0, 0.0, 0.0, 1.0])),
            // Looks along −z of the world from 4 in front of the body.
            ("extrinsics", extrinsics([1.0, -1.0, -1.0], 4.0)),
            ("distortions", array(&[5], &[0.0; 5])),
        ]);
        let info = Py::record([
            ("Rh", array(&[3], &[0.0, 0.5, 0.0])),
            ("Th", array(&[3], &[0.125, 0.0, 0.0])),
            ("poses", array(&[6], &[0.0, 0.0, 0.0, 0.0, 0.25, 0.0])),
            ("betas", array(&[1], &[0.5])),
            ("tpose_joints", joints.clone()),
        ]);
        let all = |value: &Py| Py::Dict((0..3).map(|i| (format!("frame_{i:06}"), value.clone())).collect());
        let fixture = Self {
            dir: Directory::new(name),
            cameras: all(&camera),
            mesh_infos: all(&info),
            canonical: Py::record([("joints", joints), ("avg_betas", array(&[1], &[0.5]))]),
        };
        for frame in ["frame_000000", "frame_000001", "frame_000002"] {
            let kept_back = (frame != "frame_000001").then_some("eval/Camera_B2/");
            for below in ["", kept_back.unwrap_or_default()] {
                fixture.dir.picture(&format!("{below}images/{frame}.png"), SIZE, |_, _| 200);
                fixture.dir.stripe(&format!("{below}masks/{frame}.png"), SIZE, 255);
            }
        }
        fixture.write();
        fixture
    }

    /// Writes the pickles, after a test has changed their contents.
    pub fn write(&self) {
        self.dir.write("cameras.pkl", self.cameras.pickle());
        self.dir.write("mesh_infos.pkl", self.mesh_infos.pickle());
        self.dir.write("canonical_joints.pkl", self.canonical.pickle());
        let (mut cameras, mut infos) = (self.cameras.clone(), self.mesh_infos.clone());
        cameras.remove(&["frame_000001"]);
        infos.remove(&["frame_000001"]);
        self.dir.write("eval/Camera_B2/cameras.pkl", cameras.pickle());
        self.dir.write("eval/Camera_B2/mesh_infos.pkl", infos.pickle());
    }
}

/// World to camera: a diagonal, and a translation along z.
pub fn extrinsics([a, b, c]: [f64; 3], z: f64) -> Py {
    array(&[4, 4], &[a, 0.0, 0.0, 0.0, 0.0, b, 0.0, 0.0, 0.0, 0.0, c, z, 0.0, 0.0, 0.0, 1.0])
}
