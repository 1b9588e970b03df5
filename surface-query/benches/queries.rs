//! Cost of the queries on a body of 6890 vertices (a ball of 10242 where that is not at hand).
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

#[path = "../tests/body/mod.rs"]
mod body;

use std::hint::black_box;

use body::Random;
use divan::Bencher;
use divan::counter::ItemsCount;
use glam::Vec3;
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig, farthest_points};
use testkit::TriMesh;

fn main() {
    divan::main();
}

fn near(mesh: &TriMesh) -> Vec<Vec3> {
    Random(1).near_surface(mesh, 20_000, 0.05)
}

fn whole_query(bencher: Bencher<'_, '_>, config: &SurfaceQueryConfig) {
    let mesh = body::body_or_ball();
    let query = SurfaceQuery::new(&mesh.vertices, &mesh.faces, config).unwrap();
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

/// k = 5 at 4 scales, blend and signed distance, random order, within 5 cm of the surface.
#[divan::bench]
fn neighbours_and_blend_grid(bencher: Bencher<'_, '_>) {
    whole_query(bencher, &SurfaceQueryConfig::BODY);
}

/// The same through the k-d trees.
#[divan::bench]
fn neighbours_and_blend_trees(bencher: Bencher<'_, '_>) {
    whole_query(bencher, &SurfaceQueryConfig::TREES);
}

#[divan::bench]
fn blend(bencher: Bencher<'_, '_>) {
    let mesh = body::body_or_ball();
    let query = SurfaceQuery::new(&mesh.vertices, &mesh.faces, &SurfaceQueryConfig::BODY).unwrap();
    let points = near(&mesh);
    let lists: Vec<[u32; 20]> = (points.iter())
        .map(|&p| {
            let mut out = [0; 20];
            query.neighbours(p, &mut out);
            out
        })
        .collect();
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| {
        for (&p, list) in points.iter().zip(&lists) {
            black_box(query.blend(p, &list[..5]));
        }
    });
}

/// Exact closest point with sign, by the largest distance asked for, in cm.
#[divan::bench(args = [6, 100])]
fn mesh_distance(bencher: Bencher<'_, '_>, reach: u32) {
    let mesh = body::body_or_ball();
    let distance = MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
    let points = near(&mesh);
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| {
        for &p in &points {
            black_box(distance.closest(p, reach as f32 * 0.01));
        }
    });
}

/// The same for points along lines, as the samples of rays are.
#[divan::bench]
fn mesh_distance_along_rays(bencher: Bencher<'_, '_>) {
    let mesh = body::body_or_ball();
    let distance = MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
    let points: Vec<Vec3> = (near(&mesh).chunks(2).take(400))
        .flat_map(|ends| (0..50).map(|i| ends[0] + Vec3::Z * (i as f32 * 0.002 - 0.05)).collect::<Vec<_>>())
        .collect();
    bencher.counter(ItemsCount::new(points.len())).bench_local(|| {
        for &p in &points {
            black_box(distance.closest(p, 0.06));
        }
    });
}

#[divan::bench]
fn mesh_distance_refit(bencher: Bencher<'_, '_>) {
    let mesh = body::body_or_ball();
    let mut distance = MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
    bencher.bench_local(|| distance.refit(&mesh.vertices));
}

#[divan::bench]
fn mesh_distance_build(bencher: Bencher<'_, '_>) {
    let mesh = body::body_or_ball();
    bencher.bench_local(|| MeshDistance::new(&mesh.vertices, &mesh.faces));
}

#[divan::bench(sample_count = 5)]
fn surface_query_build(bencher: Bencher<'_, '_>) {
    let mesh = body::body_or_ball();
    bencher.bench_local(|| SurfaceQuery::new(&mesh.vertices, &mesh.faces, &SurfaceQueryConfig::BODY));
}

/// Farthest point sampling of a quarter of the vertices.
#[divan::bench]
fn farthest_points_quarter(bencher: Bencher<'_, '_>) {
    let mesh = body::body_or_ball();
    bencher.bench_local(|| farthest_points(&mesh.vertices, mesh.vertices.len() / 4));
}
