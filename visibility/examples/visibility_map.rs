//! Exact visibility against the paper's running counts: a camera circles a body once while a fixed
//! rectangle hides half of the picture. Exact: in how many frames was each vertex seen. Counted:
//! random pixels of the visible subject are traced to the skin, as training does with the
//! termination points of its rays, and each adds 1 to its five nearest vertices. Prints Spearman's
//! rank correlation of the two and writes a PNG (first argument, default `visibility_map.png`):
//! exact from the front and the back, then counted.
//!
//! A second argument names a body model to use in place of the embedded one.

#[path = "../tests/body/mod.rs"]
mod body;

use std::path::Path;

use body::Random;
use glam::{Affine3A, Mat3, Vec3};
use image::{Rgb, RgbImage};
use smpl::BodyModel;
use testkit::statistics::{ranks, spearman};
use visibility::{RayMesh, View, VisibilityCounts, visible_vertices};

const SIZE: u32 = 240;
const FRAMES: usize = 100;
/// Rays of a frame that land on the subject, in training: six patches of 32×32 pixels, about a
/// sixth of them subject.
const RAYS: usize = 1000;
/// Vertices that a termination point counts for.
const K: usize = 5;

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

/// The rays through the pixels of a view.
fn rays(view: &View) -> Vec<(Vec3, Vec3)> {
    let (to_world, to_camera) = (view.extrinsics.inverse(), view.intrinsics.inverse());
    let eye = view.centre().unwrap_or_default();
    let pixel = |i: u32| Vec3::new((i % SIZE) as f32 + 0.5, (i / SIZE) as f32 + 0.5, 1.0);
    (0..SIZE * SIZE).map(|i| (eye, to_world.transform_vector3(to_camera * pixel(i)))).collect()
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().unwrap_or("visibility_map.png".into());
    let model = match arguments.next() {
        Some(body) => BodyModel::load(Path::new(&body))?,
        None => BodyModel::embedded(),
    };
    let (vertices, faces) = (&model.v_template, &model.faces);
    let mesh = RayMesh::new(vertices, faces)?;
    let (min, max) = (vertices.iter()).fold((Vec3::MAX, Vec3::MIN), |(min, max), v| (min.min(*v), max.max(*v)));
    let middle = (min + max) / 2.0;

    let mut exact = VisibilityCounts::new(vertices.len());
    let mut counted = exact.clone();
    // Right of the middle, from the head down.
    let usable: Vec<bool> = (0..SIZE * SIZE).map(|i| i % SIZE < SIZE / 2 || i / SIZE < SIZE / 6).collect();
    let mut random = Random(1);
    let mut casting = std::time::Duration::ZERO;
    for frame in 0..FRAMES {
        let view = circling(frame as f32 / FRAMES as f32 * std::f32::consts::TAU, middle);
        let start = std::time::Instant::now();
        exact.add_visible(&visible_vertices(&mesh, vertices, &view, Some(&usable)));
        casting += start.elapsed();
        let rays = rays(&view);
        let hits: Vec<_> = rays.iter().map(|&(o, d)| mesh.first_hit(o, d)).collect();
        let subject: Vec<usize> = (0..hits.len()).filter(|&i| usable[i] && hits[i].is_some()).collect();
        for _ in 0..RAYS.min(subject.len() * RAYS) {
            let pixel = subject[(random.unit() * subject.len() as f32) as usize % subject.len()];
            if let Some(hit) = hits[pixel] {
                let (origin, direction) = rays[pixel];
                counted.add(&nearest(vertices, origin + direction * hit.t));
            }
        }
    }
    let never = |counts: &VisibilityCounts| counts.counts().iter().filter(|c| **c == 0).count();
    println!("{FRAMES} frames of {} vertices cast in {:.0} ms", vertices.len(), casting.as_secs_f64() * 1e3);
    println!("never seen: {} vertices, never counted: {}", never(&exact), never(&counted));
    println!("Spearman's rank correlation: {:.3}", spearman(exact.counts(), counted.counts()));

    let mut picture = RgbImage::from_pixel(4 * SIZE, SIZE, Rgb([255; 3]));
    for (panel, (counts, angle)) in
        [(&exact, 0.3), (&exact, 3.44), (&counted, 0.3), (&counted, 3.44)].into_iter().enumerate()
    {
        // Shares of the highest rank, so that both are on one scale.
        let ranks = ranks(counts.counts());
        let view = circling(angle, middle);
        let rays = rays(&view);
        for (i, &(o, d)) in (0u32..).zip(&rays) {
            let Some(hit) = mesh.first_hit(o, d) else { continue };
            let face = faces[hit.face as usize].map(|v| v as usize);
            let [a, b, c] = face.map(|v| vertices[v]);
            let normal = (b - a).cross(c - a).normalize_or(Vec3::Y);
            let light = 0.35 + 0.65 * normal.dot(-rays[i as usize].1.normalize_or(Vec3::Z)).abs();
            let share: f64 =
                (0..3).map(|k| f64::from(hit.barycentric[k]) * ranks[face[k]]).sum::<f64>() / vertices.len() as f64;
            let share = share as f32;
            // Red: least seen. Green: most.
            let colour = Vec3::new((2.0 - 2.0 * share).min(1.0), (2.0 * share).min(1.0) * 0.85, 0.15) * light;
            let colour = colour.to_array().map(|c| (c.clamp(0.0, 1.0).sqrt() * 255.0) as u8);
            picture.put_pixel(i % SIZE + panel as u32 * SIZE, i / SIZE, Rgb(colour));
        }
    }
    picture.save(&path)?;
    println!("{path}: exact front and back, counted front and back");
    Ok(())
}

/// The K vertices nearest to `x`.
fn nearest(vertices: &[Vec3], x: Vec3) -> [u32; K] {
    let mut best = [(f32::INFINITY, 0); K];
    for (i, v) in (0u32..).zip(vertices) {
        let d = v.distance_squared(x);
        if d < best[K - 1].0 {
            let at = best.partition_point(|b| b.0 <= d);
            best.copy_within(at..K - 1, at + 1);
            best[at] = (d, i);
        }
    }
    best.map(|b| b.1)
}
