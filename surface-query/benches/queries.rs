//! Cost of the queries on a body of 6890 vertices (a ball of 10242 where that is not at hand).
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::hint::black_box;
use std::num::NonZero;

use divan::Bencher;
use divan::counter::ItemsCount;
use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use surface_query::{MeshDistance, Pyramid, SurfaceQuery, SurfaceQueryConfig};
use testkit::TriMesh;
use testkit::body::Random;

/// A grid for a body in metres.
const GRID: SurfaceQueryConfig = SurfaceQueryConfig { k: 5, coarse_levels: 3, ratio: 0.25, cell: 0.02, margin: 0.12 };

fn main() {
    divan::main();
}

fn near(mesh: &TriMesh) -> Vec<Vec3> {
    Random(1).near_surface(mesh, 20_000, 0.05)
}

/// k = 5 at 4 scales, blend and signed distance, random order, within 5 cm of the surface.
#[divan::bench]
fn neighbours_and_blend_grid(bencher: Bencher<'_, '_>) {
    let mesh = testkit::body::body_or_ball();
    let query = SurfaceQuery::new(&mesh.vertices, &mesh.faces, &GRID).unwrap();
    let points = near(&mesh);
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| {
        let mut out = [0; 20];
        let mut sum = 0.0;
        for &p in &points {
            query.neighbours(p, &mut out);
            sum += query.blend(p, &out[..5]).signed_distance;
        }
        sum
    });
}

/// The 20 neighbours alone, from four trees of plain kiddo (ties as they fall).
#[divan::bench]
fn neighbours_plain_kiddo(bencher: Bencher<'_, '_>) {
    let mesh = testkit::body::body_or_ball();
    let tree = |level: &Vec<u32>| {
        let points: Vec<[f32; 3]> = level.iter().map(|&i| mesh.vertices[i as usize].to_array()).collect();
        ImmutableKdTree::new_from_slice(&points).unwrap()
    };
    let trees: Vec<ImmutableKdTree<f32, 3>> = Pyramid::new(&mesh.vertices, 0.25, 3).levels.iter().map(tree).collect();
    let points = near(&mesh);
    let k = NonZero::new(5).unwrap();
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| {
        for p in &points {
            for tree in &trees {
                black_box(tree.query(&p.to_array()).nearest_n::<SquaredEuclidean<f32>>(k).execute());
            }
        }
    });
}

/// Exact closest point with sign, by the largest distance asked for, in cm.
#[divan::bench(args = [6, 100])]
fn mesh_distance(bencher: Bencher<'_, '_>, reach: u32) {
    let mesh = testkit::body::body_or_ball();
    let distance = MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
    let points = near(&mesh);
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| {
        for &p in &points {
            black_box(distance.closest_within(p, reach as f32 * 0.01));
        }
    });
}

/// Along lines, as the samples of rays are; one thread.
#[divan::bench]
fn mesh_distance_along_rays(bencher: Bencher<'_, '_>) {
    let mesh = testkit::body::body_or_ball();
    let distance = MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
    let points: Vec<Vec3> = (near(&mesh).chunks(2).take(400))
        .flat_map(|ends| (0..50).map(|i| ends[0] + Vec3::Z * (i as f32 * 0.002 - 0.05)).collect::<Vec<_>>())
        .collect();
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| {
        for &p in &points {
            black_box(distance.closest_within(p, 0.06));
        }
    });
}

#[divan::bench]
fn mesh_distance_refit(bencher: Bencher<'_, '_>) {
    let mesh = testkit::body::body_or_ball();
    let mut distance = MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
    bencher.bench_local(|| distance.refit(&mesh.vertices));
}

#[divan::bench]
fn mesh_distance_build(bencher: Bencher<'_, '_>) {
    let mesh = testkit::body::body_or_ball();
    bencher.bench_local(|| MeshDistance::new(&mesh.vertices, &mesh.faces));
}

#[divan::bench(sample_count = 5)]
fn surface_query_build(bencher: Bencher<'_, '_>) {
    let mesh = testkit::body::body_or_ball();
    bencher.bench_local(|| SurfaceQuery::new(&mesh.vertices, &mesh.faces, &GRID));
}
