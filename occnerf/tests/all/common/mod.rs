//! A capture small enough to prepare in no time: an upright ellipsoid with two joints, seen by
//! three cameras.

use std::sync::OnceLock;

use glam::{Affine3A, Mat3, Vec3};
use occnerf::capture::{Capture, EvalFrame, Frame, Image, Pixels};
use occnerf::{Config, Method, MotionKind, Preset, Scene};
use smpl::{BodyModel, Placement, SparseRows};
use visibility::RayMesh;
use volrender::Camera;

pub const SIZE: u32 = 32;

/// 1.7 high, 162 vertices, a joint in either half.
pub fn body() -> &'static BodyModel {
    static BODY: OnceLock<BodyModel> = OnceLock::new();
    BODY.get_or_init(|| {
        let mesh = testkit::mesh::icosphere(2).map(|v| v * Vec3::new(0.35, 0.85, 0.25));
        let half = |v: &Vec3| u32::from(v.y > 0.0);
        let of_half = |wanted: u32| {
            let of: Vec<u32> = (0..).zip(&mesh.vertices).filter(|(_, v)| half(v) == wanted).map(|(i, _)| i).collect();
            let share = 1.0 / of.len() as f32;
            of.into_iter().map(move |i| (i, share)).collect::<Vec<_>>()
        };
        BodyModel {
            shapedirs: mesh.vertices.iter().map(|v| Vec3::Y * v.y * 0.1).collect(),
            posedirs: SparseRows::from_rows(mesh.vertices.iter().map(|_| Vec::<(u32, Vec3)>::new())),
            weights: SparseRows::from_rows(mesh.vertices.iter().map(|v| [(half(v), 1.0f32)])),
            j_regressor: SparseRows::from_rows([of_half(0), of_half(1)]),
            parents: vec![None, Some(0)],
            v_template: mesh.vertices,
            faces: mesh.faces,
        }
    })
}

/// Three metres from the middle, at an angle about the vertical.
fn camera(turn: f32) -> Camera {
    let flip = Mat3::from_cols(Vec3::X, -Vec3::Y, -Vec3::Z);
    let focal = 1.4 * SIZE as f32;
    let middle = 0.5 * SIZE as f32;
    let intrinsics = Mat3::from_cols(Vec3::X * focal, Vec3::Y * focal, Vec3::new(middle, middle, 1.0));
    let extrinsics = Affine3A::from_mat3_translation(flip * Mat3::from_rotation_y(-turn), Vec3::Z * 3.0);
    Camera::new(intrinsics, extrinsics, SIZE, SIZE).unwrap()
}

/// What a camera sees of the ellipsoid, coloured by position; the left `hidden` columns are behind
/// something.
fn frame(index: usize, turn: f32, hidden: usize) -> Frame {
    let placement = Placement::Origin { rotation: Vec3::ZERO, translation: Vec3::ZERO };
    let pose = vec![Vec3::ZERO; 2];
    let posed = body().pose(&body().shaped(&[]), &pose, placement);
    let mesh = RayMesh::new(&posed.vertices, &body().faces).unwrap();
    let camera = camera(turn);
    let (mut image, mut mask) = (Image::new(SIZE, SIZE), vec![0.0; (SIZE * SIZE) as usize]);
    for i in 0..mask.len() {
        let (column, row) = (i % SIZE as usize, i / SIZE as usize);
        let ray = camera.ray(column as f32 + 0.5, row as f32 + 0.5);
        if let Some(hit) = mesh.first_hit(ray.origin, ray.direction).filter(|_| column >= hidden) {
            let color = 0.45 + 0.4 * ray.at(hit.t);
            color.write_to_slice(&mut image.pixels[3 * i..]);
            mask[i] = 1.0;
        }
    }
    let name = format!("frame_{index:06}");
    Frame {
        name,
        source: Pixels { image, mask, occluder: None }.into(),
        camera,
        pose,
        placement,
        betas: vec![0.0],
        keypoints: Vec::new(),
    }
}

/// Two training frames three metres away, the second half hidden, and two frames kept back.
pub fn capture() -> Capture {
    let eval = [2.0, 4.0].into_iter().enumerate().map(|(train_index, turn)| EvalFrame {
        camera_name: format!("Camera_B{}", train_index + 2),
        train_index,
        frame: frame(train_index, turn, 0),
    });
    let half = SIZE as usize / 2;
    Capture {
        name: "ellipsoid".to_owned(),
        train: vec![frame(0, 0.0, 0), frame(1, 1.0, half)],
        eval: eval.collect(),
        mean_betas: vec![0.0],
    }
}

/// A field that trains in no time.
pub fn config(method: Method) -> Config {
    let mut config = Config::preset(Preset::Fast, method);
    config.steps = 6;
    config.registration.rounds = 0;
    (config.patches, config.patch_size, config.samples) = (2, 8, 12);
    (config.field.width, config.field.depth) = (16, 1);
    (config.encoding.levels, config.encoding.log2_table_size, config.encoding.n_max) = (2, 6, 24);
    config.motion.kind = MotionKind::Surface;
    // Every part of the parameters is there.
    config.rates.vertices = 1e-4;
    (config.surface.k, config.surface.coarse_levels) = (4, 1);
    config.surface.surface_term = method == Method::Occnerf;
    config
}

pub fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| Scene::new(&capture(), body(), &config(Method::Occnerf)).unwrap())
}

/// `text` with its first line that sets `key`, or opens the table `key`, replaced.
pub fn replace_line(text: &str, key: &str, by: &str) -> String {
    let setting = format!("{key} = ");
    let mut lines: Vec<&str> = text.lines().collect();
    let found = lines.iter().position(|line| *line == key || line.starts_with(&setting));
    lines[found.unwrap_or_else(|| panic!("no `{key}` in\n{text}"))] = by;
    lines.join("\n")
}
