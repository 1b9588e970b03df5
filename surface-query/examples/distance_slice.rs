//! A slice through the signed distance of a body: exact on the left, blended in the middle, and on
//! the right where the two disagree, red where they differ in sign. Writes a PNG (first argument,
//! default `distance_slice.png`) and prints how far apart they are.

#[path = "../tests/body/mod.rs"]
mod body;

use body::Random;
use glam::Vec3;
use image::{Rgb, RgbImage};
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
use testkit::TriMesh;

const SIZE: u32 = 256;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).unwrap_or("distance_slice.png".into());
    let mesh = body::body_or_ball();
    let exact = MeshDistance::new(&mesh.vertices, &mesh.faces)?;
    let surface = SurfaceQuery::new(&mesh.vertices, &mesh.faces, &SurfaceQueryConfig::BODY)?;
    let (min, max) = (mesh.vertices.iter()).fold((Vec3::MAX, Vec3::MIN), |(min, max), v| (min.min(*v), max.max(*v)));
    // The upper half, cut between front and back.
    let centre = Vec3::new((min.x + max.x) / 2.0, max.y - 0.45, (min.z + max.z) / 2.0);

    let mut picture = RgbImage::new(3 * SIZE, SIZE);
    let mut neighbours = vec![0; surface.neighbours_per_query()];
    let (mut inside, mut flipped, mut error) = (0, 0, 0.0f64);
    for (row, column) in (0..SIZE).flat_map(|row| (0..SIZE).map(move |column| (row, column))) {
        let at = |i: u32| (i as f32 + 0.5) / SIZE as f32 - 0.5;
        let x = centre + Vec3::new(at(column), -at(row), 0.0) * 1.1;
        let Some(closest) = exact.closest(x, f32::INFINITY) else {
            continue;
        };
        surface.neighbours(x, &mut neighbours);
        let d = closest.signed_distance;
        let blended = surface.blend(x, &neighbours[..5]).signed_distance;
        let wrong = (d < 0.0) != (blended < 0.0);
        inside += u32::from(d < 0.0);
        flipped += u32::from(wrong);
        error += f64::from((d - blended).abs());
        picture.put_pixel(column, row, colour(d));
        picture.put_pixel(column + SIZE, row, colour(blended));
        let off = ((d - blended).abs() / 0.02).min(1.0);
        let grey = (255.0 * (1.0 - (8.0 * off).round() / 8.0)) as u8;
        let difference = if wrong { [220, 30, 30] } else { [grey; 3] };
        picture.put_pixel(column + 2 * SIZE, row, Rgb(difference));
    }
    compare(&mesh, &exact, &surface);
    picture.save(&path)?;
    let pixels = f64::from(SIZE * SIZE);
    println!("{path}: {SIZE} × {SIZE} points, {inside} inside");
    println!("blended against exact: mean difference {:.2} mm", error / pixels * 1e3);
    println!("sign differs at {:.3} %", f64::from(flipped) / pixels * 100.0);
    Ok(())
}

/// Prints how far the blended distance is off at points a given distance from the faces, by area.
fn compare(mesh: &TriMesh, exact: &MeshDistance, surface: &SurfaceQuery) {
    let mut random = Random(1);
    let corners = |f: &[u32; 3]| f.map(|i| mesh.vertices[i as usize]);
    let areas = (mesh.faces.iter()).scan(0.0, |sum, face| {
        let [a, b, c] = corners(face);
        *sum += (b - a).cross(c - a).length();
        Some(*sum)
    });
    let areas: Vec<f32> = areas.collect();
    let mut neighbours = vec![0; surface.neighbours_per_query()];
    println!("distance   sign differs   mean difference");
    for distance in [0.002f32, 0.005, 0.01, 0.02, 0.05, 0.1] {
        let (mut n, mut flipped, mut error) = (0, 0, 0.0);
        for _ in 0..20_000 {
            let at = random.unit() * areas.last().unwrap_or(&0.0);
            let face = areas.partition_point(|a| *a <= at).min(areas.len() - 1);
            let [a, b, c] = corners(&mesh.faces[face]);
            let (u, v) = (random.unit(), random.unit());
            let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            let side = if random.unit() < 0.5 { -1.0 } else { 1.0 };
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let x = a + (b - a) * u + (c - a) * v + normal * (side * distance);
            // Another part of the body may be nearer.
            let closest = exact.closest(x, 1.02 * distance);
            let Some(d) = closest.map(|c| c.signed_distance).filter(|d| d.abs() > 0.98 * distance) else {
                continue;
            };
            surface.neighbours(x, &mut neighbours);
            let blended = surface.blend(x, &neighbours[..5]).signed_distance;
            n += 1;
            flipped += u32::from((d < 0.0) != (blended < 0.0));
            error += (d - blended).abs();
        }
        let n = n as f32;
        println!("{:5.0} mm {:12.2} % {:14.2} mm", distance * 1e3, flipped as f32 / n * 100.0, error / n * 1e3);
    }
}

/// Blue inside, orange outside, in bands of 2 cm, white at the surface.
fn colour(d: f32) -> Rgb<u8> {
    if d.abs() < 0.003 {
        return Rgb([255; 3]);
    }
    let band = (d.abs() / 0.02).floor();
    let fade = (-0.08 * band).exp() * if band % 2.0 == 0.0 { 1.0 } else { 0.88 };
    let base = if d < 0.0 { [0.3, 0.55, 1.0] } else { [1.0, 0.7, 0.3] };
    Rgb(base.map(|c| (c * fade * 255.0) as u8))
}
