//! Cost of rasterising a body of 13776 triangles (a ball of 20480 where that is not at hand).
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::collections::HashMap;

use divan::Bencher;
use divan::counter::ItemsCount;
use glam::{Affine3A, Quat, Vec2, Vec3};
use testkit::TriMesh;
use visibility::{RasterOptions, Rasterizer, Samples, View};

fn main() {
    divan::main();
}

/// The whole body from 3 m in front, four fifths of the picture high.
fn view(width: u32, height: u32) -> View {
    let focal = height as f32 * 1.4;
    View {
        focal: Vec2::splat(focal),
        centre: Vec2::new(width as f32, height as f32) / 2.0,
        world_to_camera: Affine3A::from_rotation_translation(
            Quat::from_rotation_x(std::f32::consts::PI),
            Vec3::new(0.0, -0.2, 3.0),
        ),
        width,
        height,
    }
}

/// Every triangle in four, `times` over.
fn subdivided(times: u32) -> TriMesh {
    let mut mesh = testkit::body::body_or_ball();
    for _ in 0..times {
        let TriMesh { vertices, faces } = &mut mesh;
        let mut middles = HashMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                vertices.push((vertices[a as usize] + vertices[b as usize]) / 2.0);
                vertices.len() as u32 - 1
            })
        };
        *faces = (faces.iter())
            .flat_map(|&[a, b, c]| {
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    mesh
}

fn pool(threads: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap()
}

fn draw(bencher: Bencher<'_, '_>, mesh: &TriMesh, view: &View, threads: usize, samples: Samples) {
    let options = RasterOptions { samples, cull_back: true, ..RasterOptions::default() };
    let mut out = vec![0u32; (view.width * view.height) as usize];
    let mut rasterizer = Rasterizer::default();
    let pool = pool(threads);
    bencher.counter(ItemsCount::new(out.len())).bench_local(|| {
        pool.install(|| {
            rasterizer.draw(&mesh.vertices, &mesh.faces, view, &options, &mut out, |pixel| {
                pixel.samples.first().copied().flatten().map_or(0, |f| f.face)
            })
        })
    });
}

/// A picture of 512 × 512, of meshes subdivided this many times, on two threads.
#[divan::bench(args = [0, 1, 2])]
fn faces_512(bencher: Bencher<'_, '_>, times: u32) {
    draw(bencher, &subdivided(times), &view(512, 512), 2, Samples::One);
}

/// The same on one.
#[divan::bench(args = [0, 1, 2])]
fn faces_512_one_thread(bencher: Bencher<'_, '_>, times: u32) {
    draw(bencher, &subdivided(times), &view(512, 512), 1, Samples::One);
}

/// Four samples a pixel.
#[divan::bench]
fn four_samples_512(bencher: Bencher<'_, '_>) {
    draw(bencher, &subdivided(1), &view(512, 512), 2, Samples::Four);
}

/// Pictures of other sizes.
#[divan::bench(args = [(256, 256), (1920, 1080)])]
fn faces(bencher: Bencher<'_, '_>, (width, height): (u32, u32)) {
    draw(bencher, &subdivided(1), &view(width, height), 2, Samples::One);
}
