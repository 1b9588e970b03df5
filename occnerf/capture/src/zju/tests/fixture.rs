//! A tiny capture of two cameras and three instants on disk.

use crate::testing::{Directory, Py, array, body, points_npy};

pub const SIZE: (u32, u32) = (12, 8);

pub struct Fixture {
    pub dir: Directory,
    pub annots: Py,
    pub params: Py,
}

fn both(value: Py) -> Py {
    Py::List(vec![value.clone(), value])
}

impl Fixture {
    pub fn new(name: &str) -> Self {
        let paths = |list: &[&str]| Py::record([("ims", Py::List(list.iter().map(|p| Py::text(p)).collect()))]);
        let annots = Py::record([
            (
                "cams",
                Py::record([
                    ("K", both(array(&[3, 3], &[16.0, 0.0, 6.0, 0.0, 16.0, 4.0, 0.0, 0.0, 1.0]))),
                    ("R", both(array(&[3, 3], &[1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0]))),
                    ("T", both(array(&[3, 1], &[0.0, 0.0, 4000.0]))),
                    ("D", both(array(&[5, 1], &[0.0; 5]))),
                ]),
            ),
            (
                "ims",
                Py::List(vec![
                    paths(&["Camera_B1/000000.png", "Camera_B2/000000.png"]),
                    paths(&["Camera_B1/000001.png"]),
                    paths(&["Camera_B1/000002.png", "Camera_B2/000002.png"]),
                ]),
            ),
        ]);
        let params = Py::record([
            ("Rh", array(&[1, 3], &[0.0, 0.5, 0.0])),
            ("Th", array(&[1, 3], &[0.125, 0.0, 0.0])),
            ("poses", array(&[1, 6], &[0.0, 0.0, 0.0, 0.0, 0.25, 0.0])),
            ("shapes", array(&[1, 1], &[0.5])),
        ]);
        let fixture = Self { dir: Directory::new(name), annots, params };
        for picture in ["Camera_B1/000000", "Camera_B1/000001", "Camera_B1/000002", "Camera_B2/000000"] {
            fixture.dir.picture(&format!("{picture}.png"), SIZE, |_, _| 200);
            fixture.masks(picture, true);
        }
        fixture.masks("Camera_B2/000002", true);
        fixture.write();
        fixture
    }

    /// Masks that show columns 4 to 7 between them: labels 1 and 2 on 4 to 6 in one, 1 on 7 in the
    /// other.
    pub fn masks(&self, picture: &str, shown: bool) {
        let shown = u8::from(shown);
        let labels = |x, _| shown * [0, 0, 0, 0, 1, 2, 1, 0, 0, 0, 0, 0][x as usize];
        self.dir.picture(&format!("mask_cihp/{picture}.png"), SIZE, labels);
        self.dir.picture(&format!("mask/{picture}.png"), SIZE, |x, _| shown * u8::from(x == 7));
    }

    /// Writes the pickles, after a test has changed their contents, and the vertices of the last
    /// instant.
    pub fn write(&self) {
        self.dir.write("annots.npy", self.annots.npy());
        for i in 0..3 {
            self.dir.write(&format!("new_params/{i}.npy"), self.params.npy());
        }
    }

    /// Writes the vertices of an instant, all moved by `offset`.
    pub fn vertices(&self, instant: usize, offset: f32) {
        let body = body();
        let placement = smpl::Placement::Origin {
            rotation: glam::Vec3::new(0.0, 0.5, 0.0),
            translation: glam::Vec3::new(0.125 + offset, 0.0, 0.0),
        };
        let pose = [glam::Vec3::ZERO, glam::Vec3::new(0.0, 0.25, 0.0)];
        let posed = body.pose(&body.shaped(&[0.5]), &pose, placement);
        self.dir.write(&format!("new_vertices/{instant}.npy"), points_npy(&posed.vertices));
    }

    pub fn occlusion(&self, camera: &str, size: [u32; 2], [x0, y0, x1, y1]: [u32; 4], frames: &[usize]) {
        let rect = serde_json::json!({"x0": x0, "y0": y0, "x1": x1, "y1": y1});
        let file = serde_json::json!({"camera": camera, "image_size": size, "rect": rect, "frames": frames, "mid": 1});
        self.dir.write("occlusion.json", file.to_string());
    }
}
