//! Renders a striped ball of fog and its depth: `cargo run --release -p volrender --example
//! soft_sphere [OUT.png]`.

use glam::camera::rh::view::look_at_affine3a;
use glam::{Affine3A, Mat3, Vec3};
use volrender::{Aabb, Bins, Camera, RaySamples, composite};

const SIDE: u32 = 256;
const SAMPLES: usize = 96;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let intrinsics = Mat3::from_cols_array(&[300.0, 0.0, 0.0, 0.0, 300.0, 0.0, 128.0, 128.0, 1.0]);
    // glam's views are OpenGL's, y up and z backward; ours are OpenCV's, y down and z forward.
    let view = look_at_affine3a(Vec3::new(0.0, 1.0, -3.0), Vec3::ZERO, Vec3::Y);
    let camera = Camera::new(intrinsics, Affine3A::from_scale(Vec3::new(1.0, -1.0, -1.0)) * view, SIDE, SIDE)?;
    let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
    let mut image = image::RgbImage::new(2 * SIDE, SIDE);
    for (row, column) in (0..SIDE * SIDE).map(|i| (i / SIDE, i % SIDE)) {
        let ray = camera.ray(column as f32 + 0.5, row as f32 + 0.5);
        let sky = Vec3::new(0.55, 0.7, 0.95).lerp(Vec3::ONE, row as f32 / SIDE as f32);
        let (mut color, mut depth) = (sky, 0.0);
        if let Some((near, far)) = bounds.intersect(&ray) {
            let bins = Bins::new(near, far, SAMPLES);
            let t: [f32; SAMPLES] = std::array::from_fn(|i| bins.at(i, 0.5));
            let sigma = t.map(|t| 60.0 * ((0.9 - ray.at(t).length()) / 0.3).clamp(0.0, 1.0).powi(2));
            let (rgb, delta) = (t.map(|t| shade(ray.at(t))), [bins.width(); SAMPLES]);
            let samples = RaySamples { sigma: &sigma, likelihood: &[1.0; SAMPLES], delta: &delta, t: &t, rgb: &rgb };
            let pixel = composite(samples, sky, &mut [0.0; SAMPLES]);
            color = pixel.color;
            if pixel.opacity > 0.5 {
                depth = 1.0 - (pixel.depth / pixel.opacity - 2.2) / 1.2;
            }
        }
        image.put_pixel(column, row, rgb8(color));
        image.put_pixel(column + SIDE, row, rgb8(Vec3::splat(depth)));
    }
    image.save(std::env::args().nth(1).unwrap_or_else(|| "soft_sphere.png".into()))?;
    Ok(())
}

/// Stripes around the y axis under a directional light.
fn shade(p: Vec3) -> Vec3 {
    let light = 0.35 + 0.65 * p.normalize_or(Vec3::Y).dot(Vec3::new(0.48, 0.6, -0.64)).max(0.0);
    light * if (p.y * 3.0).rem_euclid(1.0) < 0.5 { Vec3::new(0.9, 0.35, 0.2) } else { Vec3::new(1.0, 0.9, 0.75) }
}

fn rgb8(color: Vec3) -> image::Rgb<u8> {
    image::Rgb(color.clamp(Vec3::ZERO, Vec3::ONE).to_array().map(|c| (c * 255.0 + 0.5) as u8))
}
