//! Ray casts against brute force in `f64`.

use glam::Vec3;
use proptest::prelude::*;
use testkit::body::Random;
use testkit::{TriMesh, mesh, oracle, strategy};
use visibility::RayMesh;

fn build(mesh: &TriMesh) -> RayMesh {
    RayMesh::new(&mesh.vertices, &mesh.faces).unwrap()
}

/// Whether the mesh moved by a hair either way along x, y and z would give the oracle another
/// answer: such rays graze an edge, and rounding decides.
fn is_clear(mesh: &TriMesh, o: Vec3, d: Vec3) -> Option<Option<(u32, f64)>> {
    let answer = oracle::first_hit(&mesh.vertices, &mesh.faces, o, d);
    let size = mesh.vertices.iter().fold(0.0, |m: f32, v| m.max(v.abs().max_element()));
    for axis in [Vec3::X, Vec3::Y, Vec3::Z] {
        for sign in [-1.0, 1.0] {
            let moved = o + axis * (sign * 4e-6 * size.max(o.abs().max_element()));
            let other = oracle::first_hit(&mesh.vertices, &mesh.faces, moved, d);
            if answer.map(|a| a.0) != other.map(|a| a.0) {
                return None;
            }
        }
    }
    Some(answer)
}

fn check(mesh: &TriMesh, rays: &RayMesh, o: Vec3, d: Vec3) -> Result<(), TestCaseError> {
    let found = rays.first_hit(o, d);
    if let Some(hit) = found {
        let [a, b, c] = hit.barycentric;
        prop_assert!(a >= 0.0 && b >= 0.0 && c >= 0.0 && (a + b + c - 1.0).abs() < 1e-5);
        prop_assert!(hit.t >= 0.0);
        let corners = mesh.faces[hit.face as usize].map(|i| mesh.vertices[i as usize]);
        let on_face = corners[0] * a + corners[1] * b + corners[2] * c;
        let on_ray = o + d * hit.t;
        let reach = o.abs().max_element().max(on_face.abs().max_element());
        prop_assert!(on_face.distance(on_ray) < 1e-5 * reach, "{o} {d}: {hit:?}");
    }
    if let Some(expected) = is_clear(mesh, o, d) {
        prop_assert_eq!(found.map(|h| h.face), expected.map(|e| e.0), "{} {}", o, d);
        if let (Some(found), Some((_, t))) = (found, expected) {
            let error = (f64::from(found.t) - t).abs() * f64::from(d.length());
            prop_assert!(error < 2e-5 * f64::from(o.length().max(1.0)), "{o} {d}: {} or {t}", found.t);
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn first_hits_of_bumpy_spheres_equal_brute_force(
        mesh in strategy::bumpy_sphere(),
        rays in prop::collection::vec((strategy::vec3(2.0), strategy::vec3(1.0)), 12),
    ) {
        let built = build(&mesh);
        for (o, target) in rays {
            check(&mesh, &built, o, target - o)?;
        }
    }

    #[test]
    fn first_hits_of_triangle_soups_with_degenerate_faces_equal_brute_force(
        vertices in strategy::cloud(4..14, 1.0),
        picks in prop::collection::vec(any::<[prop::sample::Index; 3]>(), 1..40),
        rays in prop::collection::vec((strategy::vec3(2.0), strategy::vec3(1.0)), 16),
    ) {
        let mut vertices = vertices;
        vertices.extend_from_within(..1);
        vertices.push((vertices[0] + vertices[1]) / 2.0);
        let faces = picks.iter().map(|p| p.map(|i| i.index(vertices.len()) as u32)).collect();
        let soup = TriMesh { vertices, faces };
        let built = build(&soup);
        for (o, target) in rays {
            let found = built.first_hit(o, target - o);
            // Faces may lie on each other: the same place through another face is right too.
            let clear = is_clear(&soup, o, target - o);
            if let Some(expected) = clear {
                let (a, b) = (found.map(|h| f64::from(h.t)), expected.map(|e| e.1));
                prop_assert_eq!(a.is_some(), b.is_some(), "{} {}", o, target);
                prop_assert!((a.unwrap_or(0.0) - b.unwrap_or(0.0)).abs() < 1e-3, "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn no_ray_slips_through_an_edge_or_a_vertex(
        mesh in strategy::bumpy_sphere(),
        face in any::<prop::sample::Index>(),
        t in 0.0f32..1.0,
        origin in strategy::vec3(0.3),
        far in strategy::unit_vec3(),
    ) {
        let built = build(&mesh);
        let corners = face.get(&mesh.faces).map(|i| mesh.vertices[i as usize]);
        for target in [corners[0], corners[0].lerp(corners[1], t), corners[1].lerp(corners[2], 0.5)] {
            // From within every direction leaves the mesh; from without through it, it enters.
            prop_assert!(built.first_hit(origin, target - origin).is_some(), "{origin} {target}");
            let outside = far * 3.0;
            let inner = built.first_hit(outside, target * 0.5 - outside);
            prop_assert!(inner.is_some(), "{outside} {target}");
        }
    }

    #[test]
    fn the_unit_of_length_does_not_matter_and_t_is_in_units_of_the_direction(
        mesh in strategy::bumpy_sphere(), o in strategy::vec3(3.0), target in strategy::vec3(1.0),
        exponent in -100i32..100, longer in -30i32..30,
    ) {
        let (unit, longer, d) = (2f32.powi(exponent), 2f32.powi(longer), target - o);
        let a = build(&mesh).first_hit(o, d);
        let scaled = build(&mesh.map(|p| p * unit));
        prop_assert_eq!(a, scaled.first_hit(o * unit, d * unit));
        let b = scaled.first_hit(o * unit, d * unit * longer);
        prop_assert_eq!(a.map(|h| (h.face, h.t)), b.map(|h| (h.face, h.t * longer)));
    }
}

#[test]
fn both_sides_and_the_surface_itself_are_hit() {
    let sheet = build(&mesh::open_grid(2));
    let from = |z: f32, dz: f32| sheet.first_hit(Vec3::new(0.3, 0.1, z), Vec3::Z * dz).map(|h| h.t);
    assert_eq!(from(2.0, -1.0), Some(2.0));
    assert_eq!(from(-2.0, 4.0), Some(0.5));
    assert_eq!(from(2.0, 1.0), None);
    assert_eq!(from(0.0, 1.0), Some(0.0));
    // In the plane of the sheet.
    assert_eq!(sheet.first_hit(Vec3::X * 5.0, -Vec3::X), None);
}

#[test]
fn axis_parallel_rays_along_the_faces_of_boxes_hit() {
    let cube = build(&mesh::cuboid(Vec3::ONE));
    for zero in [0.0, -0.0] {
        let hit = cube.first_hit(Vec3::new(1.0, -1.0, 4.0), Vec3::new(zero, -zero, -1.0));
        assert_eq!(hit.map(|h| h.t), Some(3.0));
    }
    for (x, y) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (-1.0, 0.3)] {
        let hit = cube.first_hit(Vec3::new(x, y, 4.0), -Vec3::Z);
        assert_eq!(hit.map(|h| h.t), Some(3.0), "{x} {y}");
    }
    assert_eq!(cube.first_hit(Vec3::new(1.0001, 0.0, 4.0), -Vec3::Z), None);
}

#[test]
fn rays_without_a_direction_not_finite_or_from_too_far_hit_nothing() {
    let ball = build(&mesh::icosphere(1));
    for (o, d) in [
        (Vec3::ZERO, Vec3::ZERO),
        (Vec3::ZERO, Vec3::NAN),
        (Vec3::ZERO, Vec3::new(f32::INFINITY, 0.0, 0.0)),
        (Vec3::NAN, Vec3::X),
        (Vec3::splat(f32::INFINITY), -Vec3::ONE),
        (Vec3::splat(1e30), -Vec3::ONE),
    ] {
        assert_eq!(ball.first_hit(o, d), None);
    }
    assert!(ball.first_hit(Vec3::ZERO, Vec3::X * 1e-42).is_some());
    let nothing = RayMesh::new(&[], &[]).unwrap();
    assert_eq!(nothing.first_hit(Vec3::ZERO, Vec3::X), None);
}

#[test]
fn degenerate_meshes_are_hit_as_by_brute_force_or_are_errors() {
    for (name, vertices) in strategy::degenerate_clouds() {
        let n = vertices.len() as u32;
        let faces: Vec<[u32; 3]> = (0..n).map(|i| [i, (i + 1) % n, (i * 7 + 3) % n]).collect();
        let soup = TriMesh { vertices, faces };
        match RayMesh::new(&soup.vertices, &soup.faces) {
            Ok(built) => {
                let size = soup.vertices.iter().fold(0.0, |m: f32, p| m.max(p.abs().max_element()));
                let mut random = Random(5);
                for _ in 0..40 {
                    let (o, target) = (random.vec3(size * 2.0), random.vec3(size));
                    if let Some(Some((_, t))) = is_clear(&soup, o, target - o) {
                        let found = built.first_hit(o, target - o);
                        let found = found.unwrap_or_else(|| panic!("{name}: {o} {target} missed"));
                        // Denormal coordinates have few digits.
                        let tolerance = if name == "denormal" { 0.1 } else { 1e-3 };
                        assert!((f64::from(found.t) - t).abs() < tolerance, "{name}: {found:?} {t}");
                    }
                }
            }
            Err(error) => {
                let vertex = soup.vertices.iter().position(|v| !v.is_finite());
                let expected = vertex.map(|vertex| format!("vertex {vertex} is not finite"));
                assert_eq!(Some(error.to_string()), expected, "{name}");
            }
        }
    }
    let refused = RayMesh::new(&[Vec3::ZERO], &[[0, 0, 1]]).unwrap_err();
    assert_eq!(refused.to_string(), "face 0 has vertex index 1, but there are only 1 vertices");
}

/// Faces that are equal, collapsed to a point, or so by the scale of one vertex far away: a second
/// at most, where pairs of equals were joined one a pass.
#[test]
fn a_tree_of_equal_faces_is_built_in_no_time() {
    let body = mesh::open_grid(100);
    let mut far = body.vertices.clone();
    far[0] = Vec3::splat(1e12);
    let corners = [Vec3::ZERO, Vec3::X, Vec3::Y];
    let begun = std::time::Instant::now();
    let hit = RayMesh::new(&corners, &[[0, 1, 2]; 20_000]).unwrap();
    assert!(hit.first_hit(Vec3::new(0.2, 0.2, 1.0), Vec3::NEG_Z).is_some());
    RayMesh::new(&[Vec3::ZERO; 3], &[[0, 1, 2]; 20_000]).unwrap();
    RayMesh::new(&far, &body.faces).unwrap();
    assert!(begun.elapsed().as_secs_f32() < 1.0, "{:?}", begun.elapsed());
}
