//! Draws the embedded body at rest, walking, sitting, and in its shapes. Usage: `pose_picture
//! [OUT.png [BODY.npz]]`.

use std::error::Error;
use std::f32::consts::FRAC_PI_2;
use std::path::PathBuf;

use glam::{Vec2, Vec3};
use smpl::{BodyModel, Placement, Posed};

const WIDTH: usize = 420;
const HEIGHT: usize = 460;

/// What is in the middle of a picture, and pixels a metre.
const WHOLE: (Vec3, f32) = (Vec3::new(0.0, -0.28, 0.0), 232.0);

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1).map(PathBuf::from);
    let out = arguments.next().unwrap_or_else(|| "poses.png".into());
    let body = match arguments.next() {
        Some(path) => BodyModel::load(&path)?,
        None => BodyModel::embedded(),
    };
    println!("{} vertices, {} faces", body.num_vertices(), body.faces.len());

    let joint = |rotations: &[(usize, [f32; 3])]| {
        let mut pose = vec![Vec3::ZERO; body.num_joints()];
        for &(joint, rotation) in rotations {
            pose[joint] = Vec3::from(rotation);
        }
        pose
    };
    let rest = joint(&[]);
    let walk = joint(&[
        (1, [-0.5, 0.0, 0.0]),
        (2, [0.35, 0.0, 0.0]),
        (4, [0.35, 0.0, 0.0]),
        (5, [0.7, 0.0, 0.0]),
        (16, [0.3, 0.0, -1.25]),
        (17, [-0.4, 0.0, 1.25]),
        (18, [0.0, -0.4, 0.0]),
        (19, [0.0, 0.6, 0.0]),
    ]);
    let sit = joint(&[
        (1, [-1.5, 0.1, 0.0]),
        (2, [-1.5, -0.1, 0.0]),
        (4, [1.6, 0.0, 0.0]),
        (5, [1.6, 0.0, 0.0]),
        (12, [0.2, 0.0, 0.0]),
        (16, [0.0, -0.9, -0.6]),
        (17, [0.0, 0.5, 1.1]),
        (18, [0.0, -1.8, 0.0]),
        (19, [0.0, 1.4, 0.0]),
    ]);
    let last = body.num_betas().min(4);
    let shape = |beta: usize, value: f32| {
        let mut betas = vec![0.0; last];
        if let Some(b) = betas.get_mut(beta) {
            *b = value;
        }
        betas
    };
    let views = [
        (&rest, vec![], 0.0, WHOLE),
        (&rest, vec![], 0.7, WHOLE),
        (&rest, vec![], FRAC_PI_2, WHOLE),
        (&rest, vec![], 3.6, WHOLE),
        (&walk, vec![], 0.5, WHOLE),
        (&walk, vec![], FRAC_PI_2, WHOLE),
        (&sit, vec![], 0.8, WHOLE),
        (&rest, vec![], 0.6, (Vec3::new(0.0, 0.42, 0.0), 1500.0)),
        (&walk, shape(1, 2.0), 0.5, WHOLE),
        (&walk, shape(1, -2.0), 0.5, WHOLE),
        (&walk, shape(2, -2.0), 0.5, WHOLE),
        (&walk, shape(3, 2.0), 0.5, WHOLE),
    ];
    let mut sheet = image::GrayImage::new((4 * WIDTH) as u32, (3 * HEIGHT) as u32);
    for (i, (pose, betas, turn, (centre, scale))) in views.into_iter().enumerate() {
        let posed = body.pose(&body.shaped(&betas), pose, Placement::default());
        let picture = draw(&body, &posed, turn, centre, scale);
        let corner = ((i % 4) * WIDTH, (i / 4) * HEIGHT);
        image::imageops::replace(&mut sheet, &picture, corner.0 as i64, corner.1 as i64);
    }
    // Drawn larger, for smooth edges.
    let (width, height) = (sheet.width() * 2 / 5, sheet.height() * 2 / 5);
    image::imageops::resize(&sheet, width, height, image::imageops::FilterType::Triangle).save(&out)?;
    println!("wrote {}", out.display());
    Ok(())
}

/// Smooth-shaded orthographic view, the body turned about the vertical by `turn` radians.
fn draw(body: &BodyModel, posed: &Posed, turn: f32, centre: Vec3, scale: f32) -> image::GrayImage {
    let rotation = glam::Mat3::from_rotation_y(turn);
    let vertices: Vec<Vec3> = posed.vertices.iter().map(|&v| rotation * v).collect();
    let mut normals = vec![Vec3::ZERO; vertices.len()];
    for face in &body.faces {
        let [a, b, c] = face.map(|i| vertices[i as usize]);
        face.iter().for_each(|&i| normals[i as usize] += (b - a).cross(c - a));
    }
    let light = Vec3::new(0.4, 0.5, 0.8).normalize_or_zero();
    let middle = Vec2::new(WIDTH as f32, HEIGHT as f32) / 2.0;
    let screen = |v: Vec3| middle + scale * Vec2::new(v.x - centre.x, centre.y - v.y);
    let mut depth = vec![f32::NEG_INFINITY; WIDTH * HEIGHT];
    let mut picture = image::GrayImage::from_pixel(WIDTH as u32, HEIGHT as u32, image::Luma([245]));
    for face in &body.faces {
        let corners = face.map(|i| vertices[i as usize]);
        let [a, b, c] = corners.map(screen);
        let area = (b - a).perp_dot(c - a);
        let (low, high) = (a.min(b).min(c).max(Vec2::ZERO), a.max(b).max(c));
        for y in low.y as usize..(high.y as usize + 1).min(HEIGHT) {
            for x in low.x as usize..(high.x as usize + 1).min(WIDTH) {
                let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let w = [(c - b).perp_dot(p - b), (a - c).perp_dot(p - c), (b - a).perp_dot(p - a)];
                let w = w.map(|w| w / area);
                if w.iter().any(|w| w.is_nan() || *w < 0.0) {
                    continue;
                }
                let z: f32 = (0..3).map(|i| w[i] * corners[i].z).sum();
                if z > depth[y * WIDTH + x] {
                    depth[y * WIDTH + x] = z;
                    let normal: Vec3 = (0..3).map(|i| w[i] * normals[face[i] as usize]).sum();
                    let shade = normal.normalize_or_zero().dot(light).max(0.0);
                    picture.put_pixel(x as u32, y as u32, image::Luma([(45.0 + 190.0 * shade) as u8]));
                }
            }
        }
    }
    picture
}
