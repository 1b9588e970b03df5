//! Cost of casting rays at a body of 13776 triangles (a ball of 20480 where that is not at hand)
//! with every triangle split in two.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::hint::black_box;

use divan::Bencher;
use divan::counter::ItemsCount;
use glam::{Affine3A, Quat, Vec2, Vec3};
use testkit::TriMesh;
use visibility::{RayMesh, View};

fn main() {
    divan::main();
}

/// Every triangle in two, at the middle of its first edge.
fn split(mesh: &TriMesh) -> TriMesh {
    let mut vertices = mesh.vertices.clone();
    let faces = (mesh.faces.iter())
        .flat_map(|&[a, b, c]| {
            let m = vertices.len() as u32;
            vertices.push((vertices[a as usize] + vertices[b as usize]) / 2.0);
            [[a, m, c], [m, b, c]]
        })
        .collect();
    TriMesh { vertices, faces }
}

/// The rays through the pixels of a 256×256 image from 3 m in front, row by row; `focal` in sizes
/// of the image.
fn image_rays(focal: f32) -> Vec<(Vec3, Vec3)> {
    let turn = Quat::from_rotation_x(std::f32::consts::PI);
    let view = View {
        focal: Vec2::splat(256.0 * focal),
        centre: Vec2::splat(128.0),
        world_to_camera: Affine3A::from_rotation_translation(turn, Vec3::new(0.0, -0.2, 3.0)),
        width: 256,
        height: 256,
    };
    let origin = view.centre_of_projection().unwrap();
    let to_world = view.world_to_camera.inverse();
    (0..256 * 256)
        .map(|i| {
            let pixel = Vec2::new((i % 256) as f32 + 0.5, (i / 256) as f32 + 0.5);
            (origin, to_world.transform_vector3(((pixel - view.centre) / view.focal).extend(1.0)))
        })
        .collect()
}

/// The whole body in view, which most rays miss, and the chest filling the image, every ray a
/// hit.
const FOCALS: [f32; 2] = [1.2, 12.0];

/// One ray at a time, one thread.
#[divan::bench(args = FOCALS)]
fn first_hit_split(bencher: Bencher<'_, '_>, focal: f32) {
    let mesh = split(&testkit::body::body_or_ball());
    let mesh = RayMesh::new(&mesh.vertices, &mesh.faces).unwrap();
    let rays = image_rays(focal);
    bencher.counter(ItemsCount::new(rays.len())).bench_local(|| {
        for &(origin, direction) in &rays {
            black_box(mesh.first_hit(origin, direction));
        }
    });
}
