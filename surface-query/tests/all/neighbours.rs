//! Neighbour lists against brute force, bit for bit.

use glam::Vec3;
use proptest::prelude::*;
use surface_query::{SurfaceQuery, SurfaceQueryConfig, vertex_normals};
use testkit::body::Random;
use testkit::{mesh, strategy};

/// Sorts everything by the distance and tie rule the documentation states.
fn brute_force(points: &[Vec3], level: &[u32], q: Vec3, k: usize) -> Vec<u32> {
    let mut all: Vec<(f32, u32)> = (level.iter())
        .map(|&i| {
            let d = q - points[i as usize];
            let squared = d.x * d.x + d.y * d.y + d.z * d.z;
            (if q.is_finite() { squared } else { f32::INFINITY }, i)
        })
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let found = k.min(all.len());
    (0..k).map(|j| all[j % found].1).collect()
}

fn check(query: &SurfaceQuery, points: &[Vec3], k: usize, q: Vec3) -> Result<(), TestCaseError> {
    let mut found = vec![0; query.neighbours_per_query()];
    query.neighbours(q, &mut found);
    for (l, level) in query.pyramid().levels.iter().enumerate() {
        let expected = brute_force(points, level, q, k);
        prop_assert_eq!(&found[l * k..][..k], &expected[..], "level {} of {}", l, q);
    }
    Ok(())
}

fn config(k: usize, cell: f32, margin: f32) -> SurfaceQueryConfig {
    SurfaceQueryConfig { k, cell, margin, ..Default::default() }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn neighbours_equal_brute_force_in_and_outside_the_grid(
        points in strategy::cloud(1..400, 1.0),
        queries in strategy::cloud(60..61, 1.6),
        (direction, exponent) in (strategy::unit_vec3(), 0i32..38),
        k in 1usize..9,
        cell in prop::sample::select(vec![0.0f32, 0.05, 0.2, 0.7, 5.0]),
    ) {
        let query = SurfaceQuery::new(&points, &[], &config(k, cell, 0.3)).unwrap();
        // Far away distances round to ties.
        let far = direction * 10f32.powi(exponent);
        for q in queries.into_iter().chain(points.iter().copied()).chain([far]) {
            check(&query, &points, k, q)?;
        }
    }

    #[test]
    fn neighbours_on_a_lattice_break_every_tie_by_index(
        shuffle in Just((0..343u32).collect::<Vec<_>>()).prop_shuffle(),
        at in prop::array::uniform3(0u8..29),
        k in 1usize..12,
        cell in prop::sample::select(vec![0.0f32, 0.25, 0.4, 1.0]),
    ) {
        // Quarter steps: corners, edge, face and cell centres of the lattice, all distances exact.
        let points: Vec<Vec3> = (shuffle.iter())
            .map(|&i| Vec3::new((i % 7) as f32, (i / 7 % 7) as f32, (i / 49) as f32))
            .collect();
        let query = SurfaceQuery::new(&points, &[], &config(k, cell, 1.0)).unwrap();
        check(&query, &points, k, Vec3::from(at.map(f32::from)) * 0.25)?;
        check(&query, &points, k, Vec3::from(at.map(f32::from)) * 0.5 - 3.0)?;
    }
}

#[test]
fn neighbours_of_degenerate_clouds_equal_brute_force_or_are_refused() {
    for (name, points) in strategy::degenerate_clouds() {
        for settings in [SurfaceQueryConfig::default(), config(3, 0.1, 0.2)] {
            let query = match SurfaceQuery::new(&points, &[], &settings) {
                Ok(query) => query,
                Err(error) => {
                    let message = error.to_string();
                    let expected = match points.iter().position(|p| !p.is_finite()) {
                        _ if points.is_empty() => message == "no vertices",
                        Some(vertex) => message == format!("vertex {vertex} is not finite"),
                        None => name == "huge" && settings.cell > 0.0 && message.starts_with("cell: "),
                    };
                    assert!(expected, "{name}: {message}");
                    continue;
                }
            };
            let mut random = Random(1);
            let scale = points.iter().fold(0.0, |m: f32, p| m.max(p.abs().max_element()));
            let mut queries: Vec<Vec3> = (0..50).map(|_| random.vec3(scale * 1.5)).collect();
            queries.extend(&points);
            queries.extend([Vec3::NAN, Vec3::INFINITY, Vec3::MAX, Vec3::MIN, Vec3::ZERO]);
            queries.push(Vec3::new(0.0, f32::NEG_INFINITY, f32::NAN));
            for q in queries {
                check(&query, &points, settings.k, q).unwrap_or_else(|e| panic!("{name}: {e}"));
            }
        }
    }
}

#[test]
fn neighbours_on_cell_faces_of_a_grid_far_from_the_origin_equal_brute_force() {
    // At 4096 the cell is a few hundred ulp: the rounding of the cell lookup matters here.
    let mut random = Random(7);
    let points: Vec<Vec3> = (0..600).map(|_| random.vec3(0.5) + 4096.0).collect();
    let query = SurfaceQuery::new(&points, &[], &config(5, 0.1, 0.2)).unwrap();
    let corner = points.iter().fold(Vec3::MAX, |m, p| m.min(*p)) - 0.3;
    for i in 0..3000 {
        let cells = Vec3::new((i % 15) as f32, (i / 15 % 15) as f32, (i / 225) as f32);
        let on_face = corner + cells * 0.1;
        check(&query, &points, 5, on_face).unwrap();
    }
}

#[test]
fn more_than_65536_vertices_are_searched_too() {
    let mut random = Random(5);
    let points: Vec<Vec3> = (0..70_000).map(|_| random.vec3(1.0)).collect();
    let settings = SurfaceQueryConfig { coarse_levels: 0, ..config(5, 0.1, 0.05) };
    let query = SurfaceQuery::new(&points, &[], &settings).unwrap();
    for _ in 0..50 {
        check(&query, &points, 5, random.vec3(1.0)).unwrap();
    }
}

#[test]
fn long_lists_equal_brute_force() {
    let mut random = Random(6);
    let mut points: Vec<Vec3> = (0..200).map(|_| random.vec3(1.0)).collect();
    points.extend_from_within(50..150);
    for k in [64, 65, 150, 300] {
        for cell in [0.0, 0.5] {
            let query =
                SurfaceQuery::new(&points, &[], &SurfaceQueryConfig { coarse_levels: 0, ..config(k, cell, 0.3) });
            let query = query.unwrap();
            for _ in 0..20 {
                check(&query, &points, k, random.vec3(1.5)).unwrap();
            }
        }
    }
}

#[test]
fn bad_meshes_and_settings_are_errors() {
    let ball = mesh::icosphere(1);
    let build = |settings| SurfaceQuery::new(&ball.vertices, &ball.faces, &settings).map(|_| ());
    for (name, settings) in [
        ("k", SurfaceQueryConfig { k: 0, ..Default::default() }),
        ("k", SurfaceQueryConfig { k: 65_537, ..Default::default() }),
        ("ratio", SurfaceQueryConfig { ratio: 0.0, ..Default::default() }),
        ("ratio", SurfaceQueryConfig { ratio: f32::NAN, ..Default::default() }),
        ("cell", SurfaceQueryConfig { cell: -1.0, ..Default::default() }),
        ("margin", SurfaceQueryConfig { margin: f32::INFINITY, ..Default::default() }),
        ("coarse_levels", SurfaceQueryConfig { coarse_levels: 33, ..Default::default() }),
    ] {
        let message = build(settings).unwrap_err().to_string();
        assert!(message.split(": ").next().is_some_and(|names| names.contains(name)), "{message}");
    }
    let fine = build(config(5, 1e-6, 1.0)).unwrap_err().to_string();
    assert!(fine.starts_with("cell: 0.000001 gives a grid of "), "{fine}");
    let far = SurfaceQuery::new(&[Vec3::ZERO, Vec3::X * 1.1e18], &[], &SurfaceQueryConfig::default());
    assert_eq!(far.unwrap_err().to_string(), "vertex 1 has a coordinate beyond 1e18");
    let outside = SurfaceQuery::new(&ball.vertices, &[[0, 1, 42]], &SurfaceQueryConfig::default());
    assert_eq!(outside.unwrap_err().to_string(), "face 0 has vertex index 42, but there are only 42 vertices");
}

#[test]
fn vertex_normals_weigh_faces_by_angle() {
    // All faces at a cube's corner span 90° together, however they are triangulated.
    let cube = mesh::cuboid(Vec3::ONE);
    for (v, n) in cube.vertices.iter().zip(vertex_normals(&cube.vertices, &cube.faces)) {
        assert!(n.distance(v.normalize_or_zero()) < 1e-6, "{v}: {n}");
    }
    let lonely = vertex_normals(&[Vec3::ZERO, Vec3::X, Vec3::X * 2.0], &[[0, 1, 2], [0, 0, 0]]);
    assert_eq!(lonely, [Vec3::Y; 3]);
}
