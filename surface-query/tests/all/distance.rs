//! Closest points and signs against brute force in `f64`.

use glam::{Quat, Vec3};
use proptest::prelude::*;
use surface_query::{Closest, MeshDistance};
use testkit::body::Random;
use testkit::{TriMesh, mesh, oracle, strategy};

/// Rounding of coordinates to `f32`, and a share of it for the oracle's different route.
fn tolerance(mesh: &TriMesh, q: Vec3) -> f64 {
    let size = mesh.vertices.iter().fold(0.0, |m: f32, v| m.max(v.abs().max_element()));
    f64::from(size.max(q.abs().max_element())) * 1.2e-7 + 3e-45
}

/// Everything a [`Closest`] claims, against the oracle.
fn check(mesh: &TriMesh, q: Vec3, found: &Closest) -> Result<(), TestCaseError> {
    let eps = tolerance(mesh, q);
    let (_, _, distance) = oracle::closest_point(&mesh.vertices, &mesh.faces, q);
    let unsigned = f64::from(found.signed_distance.abs());
    // A distance may be longer than any coordinate: its own rounding is half a unit in its last
    // place.
    let rounding = eps.max(distance * f64::from(f32::EPSILON) * 0.501);
    prop_assert!((unsigned - distance).abs() <= rounding, "{q}: {unsigned} instead of {distance}");
    // The point is rounded along each axis.
    let eps = 3.0 * eps;
    let [a, b, c] = found.barycentric;
    prop_assert!(a >= 0.0 && b >= 0.0 && c >= 0.0 && (a + b + c - 1.0).abs() < 1e-6);
    let corners = mesh.faces[found.face as usize].map(|i| mesh.vertices[i as usize].as_dvec3());
    let point = corners[0] * f64::from(a) + corners[1] * f64::from(b) + corners[2] * f64::from(c);
    prop_assert!(point.distance(found.point.as_dvec3()) <= eps, "{q}: {point} or {}", found.point);
    let reached = found.point.as_dvec3().distance(q.as_dvec3());
    prop_assert!((reached - unsigned).abs() <= eps, "{q}: {reached} or {unsigned}");
    Ok(())
}

fn check_sign(mesh: &TriMesh, q: Vec3, found: &Closest) -> Result<(), TestCaseError> {
    // On the surface the sign is rounding.
    if f64::from(found.signed_distance.abs()) > tolerance(mesh, q) {
        let inside = oracle::inside(&mesh.vertices, &mesh.faces, q);
        prop_assert_eq!(found.signed_distance < 0.0, inside, "{}: {:?}", q, found);
    }
    Ok(())
}

fn build(mesh: &TriMesh) -> MeshDistance {
    MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap()
}

/// A ball pulled into spikes: sharp convex and concave edges and corners.
fn spiky() -> impl Strategy<Value = TriMesh> {
    prop::collection::vec(0.25f32..1.5, 42).prop_map(|radii| {
        let mut radii = radii.into_iter();
        mesh::icosphere(1).map(|p| p * radii.next().unwrap())
    })
}

/// The query, in the frame of a random face: beside it, at a corner or an edge, near or on it.
fn at_a_face() -> impl Strategy<Value = (prop::sample::Index, [f32; 3], f32, Vec3)> {
    let weights = prop_oneof![
        prop::array::uniform3(0.0f32..1.0),
        Just([1.0, 0.0, 0.0]),
        (0.0f32..1.0).prop_map(|t| [t, 1.0 - t, 0.0]),
    ];
    let distance = prop::sample::select(vec![0.0f32, 1e-5, 1e-3, 0.05, 0.4]);
    (any::<prop::sample::Index>(), weights, distance, strategy::unit_vec3())
}

fn place(mesh: &TriMesh, at: &(prop::sample::Index, [f32; 3], f32, Vec3)) -> Vec3 {
    let (face, weights, distance, direction) = at;
    let sum: f32 = weights.iter().sum::<f32>().max(1e-3);
    let corners = face.get(&mesh.faces).map(|i| mesh.vertices[i as usize]);
    let on = (corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2]) / sum;
    on + *direction * *distance
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    #[test]
    fn closest_points_and_signs_equal_brute_force_at_sharp_edges_and_corners_too(
        mesh in prop_oneof![strategy::bumpy_sphere(), spiky()],
        queries in strategy::cloud(12..13, 2.0),
        near in prop::collection::vec(at_a_face(), 24),
    ) {
        let distance = build(&mesh);
        for q in queries.into_iter().chain(near.iter().map(|at| place(&mesh, at))) {
            let found = distance.closest(q);
            check(&mesh, q, &found)?;
            check_sign(&mesh, q, &found)?;
            prop_assert_eq!(distance.distance_to_face(q, found.face), found.signed_distance.abs());
        }
    }

    #[test]
    fn queries_of_any_magnitude_find_the_farthest_reaching_point_of_the_mesh_and_are_outside(
        mesh in spiky(), direction in strategy::unit_vec3(), exponent in 0.5f32..38.0,
    ) {
        let q = direction * 10f32.powf(exponent);
        let found = build(&mesh).closest(q);
        let corners = mesh.faces[found.face as usize].map(|i| mesh.vertices[i as usize].as_dvec3());
        let point = (0..3).map(|i| corners[i] * f64::from(found.barycentric[i])).sum::<glam::DVec3>();
        prop_assert!(point.distance(found.point.as_dvec3()) < 1e-6, "{}: {} is off the mesh", q, found.point);
        let (_, _, distance) = oracle::closest_point(&mesh.vertices, &mesh.faces, q);
        prop_assert!((f64::from(found.signed_distance) / distance - 1.0).abs() < 1e-7, "{}: {:?}", q, found);
        if exponent > 4.0 {
            let along = |p: glam::DVec3| p.dot(q.as_dvec3().normalize_or_zero());
            let farthest = mesh.vertices.iter().map(|v| along(v.as_dvec3())).fold(f64::MIN, f64::max);
            prop_assert!(along(point) > farthest - 1e-3, "{}: {:?}", q, found);
        }
    }

    #[test]
    fn triangle_soups_with_degenerate_faces_equal_brute_force(
        vertices in strategy::cloud(3..12, 1.0),
        picks in prop::collection::vec(any::<[prop::sample::Index; 3]>(), 1..40),
        queries in strategy::cloud(20..21, 1.5),
    ) {
        // Few vertices: many faces are segments, points, slivers, or the same.
        let mut vertices = vertices;
        vertices.extend_from_within(..1);
        vertices.push((vertices[0] + vertices[1]) / 2.0);
        let faces = picks.iter().map(|p| p.map(|i| i.index(vertices.len()) as u32)).collect();
        let soup = TriMesh { vertices, faces };
        let distance = build(&soup);
        for q in queries.into_iter().chain(soup.vertices.iter().copied()) {
            check(&soup, q, &distance.closest(q))?;
        }
    }

    #[test]
    fn a_bound_only_removes_what_is_beyond_it(
        mesh in strategy::bumpy_sphere(), q in strategy::vec3(2.0), bound in 0.0f32..1.0,
    ) {
        let distance = build(&mesh);
        let all = distance.closest(q);
        match distance.closest_within(q, bound) {
            Some(found) => {
                prop_assert!(found.signed_distance.abs() <= bound);
                prop_assert_eq!(found, all);
            }
            None => prop_assert!(all.signed_distance.abs() >= bound * (1.0 - 1e-6)),
        }
        // Exactly at the distance the point is still found.
        prop_assert!(distance.closest_within(q, all.signed_distance.abs() * (1.0 + 1e-6)).is_some());
    }

    #[test]
    fn a_refitted_mesh_answers_like_a_new_one(
        before in strategy::bumpy_sphere(),
        rotation in strategy::rotation(),
        shift in strategy::vec3(5.0),
        size in 0.015625f32..100.0,
        queries in strategy::cloud(10..11, 2.0),
    ) {
        let mut refitted = build(&before);
        let after = before.map(|p| (rotation * p + shift) * size);
        refitted.refit(&after.vertices);
        let fresh = build(&after);
        for q in queries {
            let q = (q + shift) * size;
            let (a, b) = (refitted.closest(q), fresh.closest(q));
            check(&after, q, &a)?;
            // The trees differ, so of equally near faces another may win.
            prop_assert!(f64::from((a.signed_distance - b.signed_distance).abs()) <= tolerance(&after, q));
        }
    }

    #[test]
    fn the_unit_of_length_does_not_matter(
        mesh in strategy::bumpy_sphere(), q in strategy::vec3(2.0), exponent in -100i32..100,
    ) {
        // Powers of two change no digit, so nothing but the exponents may change.
        let unit = 2f32.powi(exponent);
        let found = build(&mesh).closest(q);
        let scaled = build(&mesh.map(|p| p * unit)).closest(q * unit);
        prop_assert_eq!(found.face, scaled.face);
        prop_assert_eq!(found.barycentric, scaled.barycentric);
        prop_assert_eq!(found.signed_distance * unit, scaled.signed_distance);
    }
}

#[test]
fn distances_of_infinite_queries_are_nan() {
    let distance = build(&mesh::icosphere(2));
    let infinite = Vec3::new(f32::INFINITY, 0.0, 0.0);
    for q in [Vec3::NAN, infinite, Vec3::new(0.0, f32::NAN, 1.0)] {
        assert!(distance.closest(q).signed_distance.is_nan() && distance.closest_within(q, f32::INFINITY).is_none());
    }
    for bound in [f32::NAN, -1.0, f32::NEG_INFINITY] {
        assert_eq!(distance.closest_within(Vec3::X * 2.0, bound), None);
    }
    assert_eq!(distance.closest(Vec3::MAX).signed_distance, f32::INFINITY);
}

#[test]
fn degenerate_meshes_are_answered_or_refused() {
    for (name, vertices) in strategy::degenerate_clouds() {
        let n = vertices.len() as u32;
        let faces: Vec<[u32; 3]> = (0..n).map(|i| [i, (i + 1) % n, (i * 7 + 3) % n]).collect();
        let soup = TriMesh { vertices, faces };
        let distance = match MeshDistance::new(&soup.vertices, &soup.faces) {
            Ok(distance) => distance,
            Err(error) => {
                let expected = match soup.vertices.iter().position(|v| !v.is_finite()) {
                    Some(vertex) => format!("vertex {vertex} is not finite"),
                    None => "no faces".to_owned(),
                };
                assert!(error.to_string() == expected && (expected != "no faces" || n == 0), "{name}: {error}");
                continue;
            }
        };
        let size = soup.vertices.iter().fold(0.0, |m: f32, p| m.max(p.abs().max_element()));
        let mut random = Random(5);
        for _ in 0..40 {
            let q = random.vec3(size * 2.0);
            check(&soup, q, &distance.closest(q)).unwrap_or_else(|e| panic!("{name}: {e}"));
        }
    }
}

#[test]
fn faces_that_become_infinite_disappear_until_the_next_refit() {
    let cube = mesh::cuboid(Vec3::ONE);
    let mut distance = build(&cube);
    let mut broken = cube.vertices.clone();
    broken[7] = Vec3::new(f32::NAN, f32::INFINITY, 0.0);
    distance.refit(&broken);
    let q = Vec3::new(-3.0, 0.2, 0.1);
    assert_eq!(distance.closest(q).signed_distance, 2.0);
    for &p in &broken[..7] {
        let found = distance.closest(p * 1.1);
        assert!(!cube.faces[found.face as usize].contains(&7));
    }
    distance.refit(&[Vec3::NAN; 8]);
    assert!(distance.closest(q).signed_distance.is_nan());
    distance.refit(&cube.vertices);
    assert_eq!(distance.closest(Vec3::splat(2.0)).point, Vec3::ONE);
}

#[test]
fn seams_of_duplicated_vertices_do_not_change_the_sign() {
    let ball = mesh::icosphere(2).map(|p| p * Vec3::new(1.0, 0.3, 1.0));
    // Every face gets corners of its own.
    let vertices: Vec<Vec3> = (ball.faces.iter().flatten()).map(|&i| ball.vertices[i as usize]).collect();
    let faces: Vec<[u32; 3]> = (0..ball.faces.len() as u32).map(|f| [3 * f, 3 * f + 1, 3 * f + 2]).collect();
    let (whole, torn) = (build(&ball), MeshDistance::new(&vertices, &faces).unwrap());
    let mut random = Random(2);
    for _ in 0..2000 {
        let q = random.vec3(1.3);
        assert_eq!(whole.closest(q).signed_distance, torn.closest(q).signed_distance, "{q}");
    }
}

#[test]
fn an_open_sheet_is_positive_on_the_side_of_its_normals_even_beyond_its_border() {
    let distance = build(&mesh::open_grid(4));
    for (q, expected) in [
        (Vec3::new(0.1, 0.2, 0.5), 0.5),
        (Vec3::new(0.1, 0.2, -0.5), -0.5),
        (Vec3::new(4.0, 0.2, 4.0), 5.0),
        (Vec3::new(4.0, 0.2, -4.0), -5.0),
    ] {
        assert_eq!(distance.closest(q).signed_distance, expected);
    }
}

/// Two meshes as one.
fn together(mut a: TriMesh, b: TriMesh) -> TriMesh {
    let first = a.vertices.len() as u32;
    a.vertices.extend(b.vertices);
    a.faces.extend(b.faces.into_iter().map(|face| face.map(|v| v + first)));
    a
}

#[test]
fn the_surroundings_of_a_component_inside_another_are_positive() {
    let distance = build(&together(mesh::cuboid(Vec3::splat(3.0)), mesh::cuboid(Vec3::ONE)));
    let at = |x: f32| distance.closest(Vec3::X * x).signed_distance;
    assert_eq!([0.5, 1.5, 2.5, 4.0].map(at), [-0.5, 0.5, -0.5, 1.0]);
}

#[test]
fn outside_two_boxes_that_share_a_wall_every_distance_is_positive() {
    // Along the rim of the wall four faces meet at each edge.
    let boxes = together(mesh::cuboid(Vec3::ONE), mesh::cuboid(Vec3::ONE).map(|p| p + 2.0 * Vec3::X));
    let distance = build(&boxes);
    let mut random = Random(4);
    let rim = (0..500).map(|_| Vec3::X + (random.vec3(2.0) * Vec3::new(0.0, 1.0, 1.0)));
    for q in rim.collect::<Vec<_>>().into_iter().chain((0..2000).map(|_| random.vec3(4.0))) {
        let beyond = ((q - Vec3::X).abs() - Vec3::new(2.0, 1.0, 1.0)).max(Vec3::ZERO).length();
        if beyond > 0.0 {
            let found = distance.closest(q).signed_distance;
            assert!((found - beyond).abs() <= 1e-6, "{q}: {found}, expected {beyond}");
        }
    }
}

#[test]
fn signs_and_distances_of_the_open_body_equal_brute_force() {
    let Some(body) = testkit::body::open_body() else {
        return;
    };
    let posed = body.clone().map(|p| Quat::from_rotation_y(p.y) * p);
    let mut distance = build(&body);
    let mut random = Random(4);
    for mesh in [body, posed] {
        distance.refit(&mesh.vertices);
        let mut queries = random.near_surface(&mesh, 150, 0.1);
        queries.extend((0..50).map(|_| random.vec3(1.0)));
        for q in queries {
            let found = distance.closest(q);
            check(&mesh, q, &found).unwrap();
            check_sign(&mesh, q, &found).unwrap();
        }
    }
}

/// Faces that are equal, collapsed to a point, or so by the scale of one vertex far away: a second
/// at most, where pairs of equals were joined one a pass.
#[test]
fn a_tree_of_equal_faces_is_built_in_no_time() {
    let begun = std::time::Instant::now();
    for corners in [[Vec3::ZERO, Vec3::X, Vec3::Y], [Vec3::ONE; 3], [Vec3::ZERO; 3]] {
        let found = MeshDistance::new(&corners, &[[0, 1, 2]; 20_000]).unwrap().closest(Vec3::new(0.0, 0.0, -2.0));
        let expected = if corners[0] == Vec3::ONE { 11f32.sqrt() } else { 2.0 };
        assert!((found.signed_distance.abs() - expected).abs() < 1e-5, "{found:?}");
    }
    let mut grid = mesh::open_grid(100);
    grid.vertices[0] = Vec3::splat(1e12);
    MeshDistance::new(&grid.vertices, &grid.faces).unwrap();
    assert!(begun.elapsed().as_secs_f32() < 2.0, "{:?}", begun.elapsed());
}
