//! What a camera that circles a body by 120° sees of it while a box hides its left half: counts of each vertex,
//! shown from the front and from the back. Writes a PNG (first argument, default `visibility_map.png`).

#[path = "../tests/body/mod.rs"]
mod body;

use glam::{Affine3A, Mat3, Vec3};
use image::{Rgb, RgbImage};
use visibility::{RayMesh, View, VisibilityCounts, visible_vertices};

const SIZE: u32 = 480;

/// A camera on a circle of radius 3 about the y axis.
fn circling(angle: f32, middle: Vec3) -> View {
    let eye = middle + Vec3::new(angle.sin(), 0.0, angle.cos()) * 3.0;
    let forward = (middle - eye).normalize_or(Vec3::Z);
    let right = forward.cross(Vec3::Y).normalize_or(Vec3::X);
    let rotation = Mat3::from_cols(right, -Vec3::Y, forward).transpose();
    let (focal, centre) = (SIZE as f32 * 1.45, SIZE as f32 / 2.0);
    View {
        intrinsics: Mat3::from_cols(Vec3::X * focal, Vec3::Y * focal, Vec3::new(centre, centre, 1.0)),
        extrinsics: Affine3A::from_mat3_translation(rotation, rotation * -eye),
        width: SIZE,
        height: SIZE,
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).unwrap_or("visibility_map.png".into());
    let body = body::body_or_ball();
    let mesh = RayMesh::new(&body.vertices, &body.faces)?;
    let (min, max) = (body.vertices.iter()).fold((Vec3::MAX, Vec3::MIN), |(min, max), v| (min.min(*v), max.max(*v)));
    let middle = (min + max) / 2.0;

    let mut counts = VisibilityCounts::new(body.vertices.len());
    let hidden = |pixel: u32| (SIZE / 2..SIZE * 4 / 5).contains(&(pixel % SIZE));
    let usable: Vec<bool> = (0..SIZE * SIZE).map(|pixel| !hidden(pixel)).collect();
    let frames = 60;
    for frame in 0..frames {
        let view = circling((frame as f32 / frames as f32 - 0.5) * 2.1, middle);
        counts.add_visible(&visible_vertices(&mesh, &body.vertices, &view, Some(&usable)));
    }
    let never = counts.counts().iter().filter(|c| **c == 0).count();
    println!("{frames} frames, {never} of {} vertices never seen", body.vertices.len());

    let mut picture = RgbImage::new(2 * SIZE, SIZE);
    for (side, angle) in [(0, 0.3f32), (1, 0.3 + std::f32::consts::PI)] {
        let view = circling(angle, middle);
        let eye = view.centre().ok_or("a camera without a centre")?;
        let (to_world, to_camera) = (view.extrinsics.inverse(), view.intrinsics.inverse());
        for (row, column) in (0..SIZE).flat_map(|r| (0..SIZE).map(move |c| (r, c))) {
            let pixel = Vec3::new(column as f32 + 0.5, row as f32 + 0.5, 1.0);
            let direction = to_world.transform_vector3(to_camera * pixel);
            let Some(hit) = mesh.first_hit(eye, direction) else {
                continue;
            };
            let face = body.faces[hit.face as usize];
            let [a, b, c] = face.map(|i| body.vertices[i as usize]);
            let normal = (b - a).cross(c - a).normalize_or(Vec3::Y);
            let light = 0.35 + 0.65 * normal.dot(-direction.normalize_or(Vec3::Z)).abs();
            let seen: f32 = (0..3).map(|i| hit.barycentric[i] * counts.counts()[face[i] as usize] as f32).sum();
            let share = seen / frames as f32;
            // Red: never. Yellow to green: always.
            let colour = Vec3::new(1.0 - share, (share * 4.0).min(1.0) * 0.85, 0.15) * light;
            let colour = colour.to_array().map(|c| (c.clamp(0.0, 1.0).sqrt() * 255.0) as u8);
            picture.put_pixel(column + side * SIZE, row, Rgb(colour));
        }
    }
    picture.save(&path)?;
    println!("{path}: front and back");
    Ok(())
}
