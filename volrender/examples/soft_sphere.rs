//! Renders a soft, striped sphere over a sky: `cargo run --release -p volrender --example
//! soft_sphere [OUT.png]`.
//!
//! Left the colours, right the depth of what was hit (near is bright).

use glam::{Affine3A, Mat3, Vec3};
use volrender::{Aabb, Bins, Camera, RaySamples, composite};

const SIDE: u32 = 256;
const SAMPLES: usize = 96;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).unwrap_or_else(|| "soft_sphere.png".into());
    let intrinsics = Mat3::from_cols_array(&[300.0, 0.0, 0.0, 0.0, 300.0, 0.0, 128.0, 128.0, 1.0]);
    // One metre up and three back, looking at the origin; y is down in the camera.
    let eye = Vec3::new(0.0, 1.0, -3.0);
    let forward = (-eye).normalize_or(Vec3::Z);
    let right = forward.cross(Vec3::Y).normalize_or(Vec3::X);
    let down = forward.cross(right);
    let camera_to_world = Affine3A::from_mat3_translation(Mat3::from_cols(right, down, forward), eye);
    let camera = Camera::new(intrinsics, camera_to_world.inverse(), SIDE, SIDE)?;

    let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
    let mut weights = [0.0; SAMPLES];
    let mut state = 1u32;
    let mut image = image::RgbImage::new(2 * SIDE, SIDE);
    for row in 0..SIDE {
        for column in 0..SIDE {
            let ray = camera.ray(column as f32 + 0.5, row as f32 + 0.5);
            let sky = Vec3::new(0.55, 0.7, 0.95).lerp(Vec3::ONE, (row as f32 + 0.5) / SIDE as f32);
            let (mut color, mut depth) = (sky, 0.0);
            if let Some((near, far)) = bounds.intersect(&ray) {
                let bins = Bins::new(near, far, SAMPLES);
                let delta = [bins.width(); SAMPLES];
                let t: [f32; SAMPLES] = std::array::from_fn(|i| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    bins.at(i, (state >> 8) as f32 / (1u32 << 24) as f32)
                });
                let sigma = t.map(|t| 60.0 * ((0.9 - ray.at(t).length()) / 0.3).clamp(0.0, 1.0).powi(2));
                let rgb = t.map(|t| shade(ray.at(t)));
                let samples =
                    RaySamples { sigma: &sigma, likelihood: &[1.0; SAMPLES], delta: &delta, t: &t, rgb: &rgb };
                let pixel = composite(samples, sky, &mut weights);
                color = pixel.color;
                if pixel.opacity > 0.5 {
                    depth = 1.0 - (pixel.depth / pixel.opacity - 2.2) / 1.2;
                }
            }
            image.put_pixel(column, row, rgb8(color));
            image.put_pixel(column + SIDE, row, rgb8(Vec3::splat(depth)));
        }
    }
    image.save(&out)?;
    println!("wrote {out}");
    Ok(())
}

/// Stripes around the y axis, lit from above left.
fn shade(p: Vec3) -> Vec3 {
    let normal = p.normalize_or(Vec3::Y);
    let light = 0.35 + 0.65 * normal.dot(Vec3::new(0.48, 0.6, -0.64)).max(0.0);
    let stripe = if (p.y * 6.0).rem_euclid(2.0) < 1.0 { Vec3::new(0.9, 0.35, 0.2) } else { Vec3::new(0.98, 0.9, 0.75) };
    stripe * light
}

fn rgb8(color: Vec3) -> image::Rgb<u8> {
    image::Rgb(color.clamp(Vec3::ZERO, Vec3::ONE).to_array().map(|c| (c * 255.0 + 0.5) as u8))
}
