//! Share of 100 views from a half circle in front of a body in which each vertex is visible: red
//! never, green always. Writes a PNG of both sides (first argument, default `visibility.png`).

use std::f32::consts::PI;

use glam::{Affine3A, Vec2, Vec3};
use image::{Rgb, RgbImage};
use visibility::{RasterOptions, Rasterizer, RayMesh, View, VisibilityCounts, visible_vertices};

const SIZE: u32 = 320;

/// A camera at distance 3 of `target`, turned by `angle` about the y axis.
fn camera(target: Vec3, angle: f32) -> View {
    let world_to_camera = Affine3A::from_translation(Vec3::Z * 3.0)
        * Affine3A::from_rotation_x(PI)
        * Affine3A::from_rotation_y(angle)
        * Affine3A::from_translation(-target);
    let (focal, centre) = (Vec2::splat(1.45 * SIZE as f32), Vec2::splat(SIZE as f32 / 2.0));
    View { focal, centre, world_to_camera, width: SIZE, height: SIZE }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let smpl::BodyModel { v_template: vertices, faces, .. } = smpl::BodyModel::embedded();
    let middle = vertices.iter().sum::<Vec3>() / vertices.len() as f32;

    let mesh = RayMesh::new(&vertices, &faces)?;
    let mut counts = VisibilityCounts::new(vertices.len());
    for frame in 0..100 {
        let view = camera(middle, (frame as f32 / 100.0 - 0.5) * PI);
        counts.add_visible(&visible_vertices(&mesh, &vertices, &view, None));
    }

    let mut picture = RgbImage::from_pixel(2 * SIZE, SIZE, Rgb([255; 3]));
    for (left, angle) in [(0, 0.6), (SIZE, 0.6 + PI)] {
        let view = camera(middle, angle);
        let fragments = Rasterizer::default().faces(&vertices, &faces, &view, &RasterOptions::default())?;
        for (i, fragment) in (0..).zip(fragments) {
            let Some(fragment) = fragment else { continue };
            let corners = faces[fragment.face as usize].into_iter().zip(fragment.barycentric);
            let share: f32 = corners.map(|(v, weight)| weight * counts.counts()[v as usize] as f32 / 100.0).sum();
            let colour = [2.0 - 2.0 * share, 1.7 * share, 0.15].map(|c| (c.clamp(0.0, 1.0).sqrt() * 255.0) as u8);
            picture.put_pixel(left + i % SIZE, i / SIZE, Rgb(colour));
        }
    }
    picture.save(std::env::args().nth(1).unwrap_or("visibility.png".into()))?;
    Ok(())
}
