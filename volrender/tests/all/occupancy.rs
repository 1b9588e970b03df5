//! Occupancy grids against brute-force distances.

use glam::Vec3;
use proptest::prelude::*;
use testkit::oracle;
use volrender::{Occupancy, OccupancyConfig};

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn every_point_within_its_faces_margin_or_the_depth_is_occupied(
        mesh in testkit::strategy::bumpy_sphere(), near in 0.0f32..0.3, far in 0.0f32..0.3,
        depth in 0.0f32..0.3, cell in 0.02f32..0.1,
        places in prop::collection::vec((any::<prop::sample::Index>(), -0.3f32..0.3, testkit::strategy::vec3(0.1)), 200)
    ) {
        // Different margins above and below, so that they differ at few edges.
        let above = |face: &[u32; 3]| face.iter().map(|&v| mesh.vertices[v as usize].z).sum::<f32>() > 0.0;
        let margins: Vec<f32> = mesh.faces.iter().map(|f| if above(f) { near } else { far }).collect();
        let mut occupancy = Occupancy::default();
        occupancy.rebuild(&mesh.vertices, &mesh.faces, &margins, OccupancyConfig { margin: 0.3, depth, cell });
        for (face, along, shift) in places {
            let [a, b, c] = mesh.faces[face.index(mesh.faces.len())].map(|v| mesh.vertices[v as usize]);
            let q = (a + b + c) / 3.0 + along * (b - a).cross(c - a).normalize_or_zero() + shift;
            let (face, _, distance) = oracle::closest_point(&mesh.vertices, &mesh.faces, q);
            let d = if oracle::inside(&mesh.vertices, &mesh.faces, q) { -distance } else { distance } as f32;
            let margin = if q.z.abs() < 0.5 { near.min(far) } else { margins[face as usize] };
            if d <= margin && -d <= depth {
                prop_assert!(occupancy.is_occupied(q), "{q} at {d}: margin {margin}, depth {depth}");
            }
        }
    }
}

/// Occupied cells are within the margin of a face's plane and of its box.
#[test]
fn points_away_from_the_surface_are_free_on_both_sides() {
    let mesh = testkit::mesh::icosphere(3);
    let (margin, cell) = (0.05, 0.03);
    let edge = |[a, b, _]: &[u32; 3]| mesh.vertices[*a as usize].distance(mesh.vertices[*b as usize]);
    let longest = mesh.faces.iter().map(edge).fold(0.0, f32::max);
    let beside = 3.0f32.sqrt() * (longest + 2.0 * cell) + margin;
    // Distance of a face's plane from the sphere at the end of its box.
    let far = margin + 2.0 * cell + 0.5 * beside * beside;
    let mut occupancy = Occupancy::default();
    let margins = vec![margin; mesh.faces.len()];
    occupancy.rebuild(&mesh.vertices, &mesh.faces, &margins, OccupancyConfig { margin, depth: 0.04, cell });
    let (mut free, mut total) = (0, 0);
    for i in 0..24 * 24 * 24 {
        let q = (Vec3::new((i % 24) as f32, (i / 24 % 24) as f32, (i / 576) as f32) + 0.5) / 12.0 - 1.0;
        let from_surface = (q.length() - 1.0).abs();
        total += 1;
        free += usize::from(!occupancy.is_occupied(q));
        if from_surface > far {
            assert!(!occupancy.is_occupied(q), "{q}");
        } else if from_surface < 0.03 {
            assert!(occupancy.is_occupied(q), "{q}");
        }
    }
    // A shell 9 cm thick is an eighth of the cube.
    assert!(free * 2 > total, "{free} of {total}");
}

#[test]
fn far_points_and_empty_meshes_are_free() {
    let mut occupancy = Occupancy::default();
    assert!(!occupancy.is_occupied(Vec3::ZERO));
    occupancy.rebuild(&[], &[], &[], OccupancyConfig { margin: 0.1, depth: 1.0, cell: 0.1 });
    assert!(!occupancy.is_occupied(Vec3::ZERO) && occupancy.region().is_empty());
    let mesh = testkit::mesh::icosphere(1);
    let (margins, config) = (vec![0.1; mesh.faces.len()], OccupancyConfig { margin: 0.1, depth: 2.0, cell: 0.1 });
    occupancy.rebuild(&mesh.vertices, &mesh.faces, &margins, config);
    assert!(occupancy.is_occupied(Vec3::ZERO) && !occupancy.is_occupied(Vec3::splat(1.4)));
    assert!(!occupancy.is_occupied(Vec3::splat(f32::NAN)) && !occupancy.is_occupied(Vec3::splat(1e30)));
}

#[test]
fn invalid_lengths_count_as_zero_and_invalid_vertices_leave_the_grid_empty() {
    let mesh = testkit::mesh::icosphere(1);
    let margins = vec![f32::NAN; mesh.faces.len()];
    let mut occupancy = Occupancy::default();
    for [margin, depth, cell] in [[f32::NAN, -1.0, -1.0], [0.0, f32::NAN, f32::NAN], [-1.0, 0.0, 0.0]] {
        occupancy.rebuild(&mesh.vertices, &mesh.faces, &margins, OccupancyConfig { margin, depth, cell });
        assert!(occupancy.is_occupied(mesh.vertices[0]) && !occupancy.is_occupied(2.0 * mesh.vertices[0]));
    }
    occupancy.rebuild(&[Vec3::ONE; 3], &[[0, 1, 2]], &[0.0], OccupancyConfig { margin: 0.0, depth: 0.0, cell: 0.0 });
    assert!(occupancy.is_occupied(Vec3::ONE) && !occupancy.is_occupied(Vec3::ZERO));
    let config = OccupancyConfig { margin: 0.1, depth: 0.1, cell: 0.1 };
    occupancy.rebuild(&mesh.vertices, &mesh.faces, &margins, OccupancyConfig { margin: f32::INFINITY, ..config });
    assert!(occupancy.region().is_empty() && !occupancy.is_occupied(Vec3::ZERO));
    let huge: Vec<Vec3> = mesh.vertices.iter().map(|v| 1.69e38 * *v).collect();
    occupancy.rebuild(&huge, &mesh.faces, &margins, config);
    assert!(occupancy.region().is_empty() && !occupancy.is_occupied(Vec3::ZERO));
    let mut broken = mesh.vertices.clone();
    broken[3].y = f32::NAN;
    occupancy.rebuild(&broken, &mesh.faces, &margins, config);
    assert!(occupancy.region().is_empty() && !occupancy.is_occupied(mesh.vertices[0]));
}
