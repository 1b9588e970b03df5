//! Slice through the signed distance of a trefoil tube: blue inside, orange outside, white at the
//! surface. Writes a PNG (first argument, default `slice.png`).

use std::f32::consts::TAU;

use glam::Vec3;
use image::{Rgb, RgbImage};
use surface_query::MeshDistance;

const RINGS: u32 = 200;
const SIDES: u32 = 24;

/// Vertex `side` of the tube's `ring`.
fn vertex(ring: u32, side: u32) -> Vec3 {
    let (t, s) = (ring as f32 / RINGS as f32 * TAU, side as f32 / SIDES as f32 * TAU);
    let centre = Vec3::new(t.sin() + 2.0 * (2.0 * t).sin(), t.cos() - 2.0 * (2.0 * t).cos(), -(3.0 * t).sin());
    let tangent = Vec3::new(t.cos() + 4.0 * (2.0 * t).cos(), 4.0 * (2.0 * t).sin() - t.sin(), -3.0 * (3.0 * t).cos());
    let across = tangent.cross(Vec3::Z).normalize_or(Vec3::X);
    let up = across.cross(tangent).normalize_or(Vec3::Z);
    centre + 0.5 * (s.cos() * across + s.sin() * up)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let vertices: Vec<Vec3> = (0..RINGS * SIDES).map(|i| vertex(i / SIDES, i % SIDES)).collect();
    let index = |ring: u32, side: u32| ring % RINGS * SIDES + side % SIDES;
    let quad = |i: u32| {
        let (r, s) = (i / SIDES, i % SIDES);
        let [a, b, c, d] = [index(r, s), index(r + 1, s), index(r + 1, s + 1), index(r, s + 1)];
        [[a, b, c], [a, c, d]]
    };
    let faces: Vec<[u32; 3]> = (0..RINGS * SIDES).flat_map(quad).collect();

    let mesh = MeshDistance::new(&vertices, &faces)?;
    let picture = RgbImage::from_fn(480, 480, |column, row| {
        let query = Vec3::new(column as f32 - 240.0, 240.0 - row as f32, 0.0) / 60.0;
        let d = mesh.closest(query).signed_distance;
        // Bands of 0.1 that fade with the distance.
        let band = (d.abs() / 0.1).floor();
        let fade = (-0.08 * band).exp() * if band % 2.0 == 0.0 { 1.0 } else { 0.88 };
        let colour = if d < 0.0 { [0.3, 0.55, 1.0] } else { [1.0, 0.7, 0.3] };
        if d.abs() < 0.02 { Rgb([255; 3]) } else { Rgb(colour.map(|c| (c * fade * 255.0) as u8)) }
    });
    let path = std::env::args().nth(1).unwrap_or("slice.png".into());
    picture.save(path)?;
    Ok(())
}
