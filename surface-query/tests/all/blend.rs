//! The blend: its definition, its special cases, and its gradient.

use glam::{DVec3, Vec3};
use proptest::prelude::*;
use surface_query::{Blended, SurfaceQuery, SurfaceQueryConfig};
use testkit::gradient::{Tolerance, check};
use testkit::{mesh, strategy};

fn build(mesh: &testkit::TriMesh) -> SurfaceQuery {
    SurfaceQuery::new(&mesh.vertices, &mesh.faces, &SurfaceQueryConfig::default()).unwrap()
}

fn finest(query: &SurfaceQuery, q: Vec3) -> [u32; 5] {
    let mut all = [0; 20];
    query.neighbours(q, &mut all);
    [0, 1, 2, 3, 4].map(|i| all[i])
}

/// No vertex and no tangent plane within reach of a difference's step.
fn off_the_kinks(query: &SurfaceQuery, vertices: &[Vec3], q: Vec3, list: &[u32]) -> bool {
    let height = |i: u32| (q - vertices[i as usize]).dot(query.normals()[i as usize]);
    list.iter().all(|&i| height(i).abs() > 0.03)
}

/// The blend's equations in `f64`: v̂, n̂, d.
fn plain(query: &SurfaceQuery, vertices: &[Vec3], q: Vec3, list: &[u32]) -> (DVec3, DVec3, f64) {
    let q = q.as_dvec3();
    let at = |i: &u32| {
        let v = vertices[*i as usize].as_dvec3();
        (v, query.normals()[*i as usize].as_dvec3())
    };
    let weights: Vec<f64> = list
        .iter()
        .map(at)
        .map(|(v, n)| if q == v { 1.0 } else { ((q - v).dot(n) / (q - v).length()).abs() })
        .collect();
    let sum: f64 = weights.iter().sum();
    let mix = |pick: &dyn Fn((DVec3, DVec3)) -> DVec3| {
        list.iter().zip(&weights).fold(DVec3::ZERO, |s, (i, w)| s + pick(at(i)) * *w)
    };
    let point = mix(&|(v, _)| v) / sum;
    let normal = mix(&|(_, n)| n).normalize_or_zero();
    (point, normal, (q - point).dot(normal))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn the_blend_is_the_normal_weighted_mean(
        mesh in strategy::bumpy_sphere(), q in strategy::vec3(1.6),
    ) {
        let query = build(&mesh);
        for q in [q, q * 0.001 + mesh.vertices[3], mesh.vertices[3]] {
            let list = finest(&query, q);
            let (point, normal, distance) = plain(&query, &mesh.vertices, q, &list);
            let blended = query.blend(q, &list);
            // Where all cosines are small the rounding of each weighs more.
            prop_assert!(blended.point.as_dvec3().distance(point) < 2e-5, "{blended:?} {point}");
            prop_assert!(blended.normal.as_dvec3().distance(normal) < 2e-5);
            prop_assert!((f64::from(blended.signed_distance) - distance).abs() < 2e-5);
        }
    }

    #[test]
    fn the_gradient_of_the_blend_is_that_of_finite_differences(
        mesh in strategy::bumpy_sphere(),
        direction in strategy::unit_vec3(),
        r in 0.25f32..2.0,
        d_point in strategy::vec3(1.0),
        d_signed_distance in -1.0f32..1.0,
    ) {
        let query = build(&mesh);
        let q = direction * r;
        let list = finest(&query, q);
        prop_assume!(off_the_kinks(&query, &mesh.vertices, q, &list));
        let d_query = query.blend_backward(q, &list, d_point, d_signed_distance);
        let step = 2e-3;
        // Third derivatives are of the order of 1/r³ with r ≥ 0.03, reached by few samples.
        let tolerance = Tolerance { abs: 3e-3, rel: 2e-2 };
        let outcome = check("blend", &q.to_array(), &d_query.to_array(), step, tolerance, |x| {
            let (point, _, distance) = plain(&query, &mesh.vertices, Vec3::from_slice(x), &list);
            point.dot(d_point.as_dvec3()) + distance * f64::from(d_signed_distance)
        });
        prop_assert!(outcome.is_ok(), "{}", outcome.unwrap_err());
    }

    #[test]
    fn blends_of_far_queries_stay_near_the_mesh(
        mesh in strategy::bumpy_sphere(), direction in strategy::unit_vec3(), exponent in 2.0f32..38.0,
    ) {
        let query = build(&mesh);
        let q = direction * 10f32.powf(exponent);
        let list = finest(&query, q);
        let Blended { point, normal, signed_distance } = query.blend(q, &list);
        let farthest = mesh.vertices.iter().map(|v| v.length()).fold(0.0, f32::max);
        prop_assert!(point.length() < farthest + 1e-3 && normal.is_normalized(), "{q}: {point} {normal}");
        let along = (q - point).dot(normal);
        prop_assert!((signed_distance - along).abs() <= 1e-6 * q.length(), "{q}: {signed_distance} {along}");
        prop_assert!(query.blend_backward(q, &list, Vec3::ONE, 1.0).is_finite());
    }

    #[test]
    fn blends_of_degenerate_meshes_are_finite(q in strategy::vec3(2.0)) {
        for (name, vertices) in strategy::degenerate_clouds() {
            let n = vertices.len() as u32;
            let faces: Vec<[u32; 3]> = (0..n).map(|i| [i, (i + 1) % n, (i + 2) % n]).collect();
            let Ok(query) = SurfaceQuery::new(&vertices, &faces, &SurfaceQueryConfig::default()) else {
                continue;
            };
            for q in [q, vertices[0], vertices[0] + q * 1e-20] {
                let list = finest(&query, q);
                let blended = query.blend(q, &list);
                let back = query.blend_backward(q, &list, Vec3::ONE, 1.0);
                prop_assert!(blended.point.is_finite(), "{name} {q}: {blended:?}");
                prop_assert!((blended.normal.length() - 1.0).abs() < 1e-5, "{name} {q}: {blended:?}");
                prop_assert!(blended.signed_distance.is_finite(), "{name} {q}: {blended:?}");
                // At 1e-12 from a vertex the weights do turn that quickly.
                prop_assert!(back.is_finite() || ["tiny", "denormal"].contains(&name), "{name} {q}: {back}");
            }
        }
    }
}

#[test]
fn the_gradient_of_inverse_distance_weights_is_that_of_finite_differences() {
    // In the plane of a flat sheet every cosine is 0, and stays 0 while the query moves in the
    // plane.
    let grid = mesh::open_grid(6);
    let query = build(&grid);
    let q = Vec3::new(0.13, -0.22, 0.0);
    let list = finest(&query, q);
    let d_point = Vec3::new(0.7, -0.4, 0.2);
    let d_query = query.blend_backward(q, &list, d_point, 0.5);
    let weighted = |x: &[f32]| {
        let p = DVec3::new(f64::from(x[0]), f64::from(x[1]), 0.0);
        let (mut sum, mut mean) = (0.0, DVec3::ZERO);
        for &i in &list {
            let v = grid.vertices[i as usize].as_dvec3();
            sum += 1.0 / p.distance(v);
            mean += v / p.distance(v);
        }
        (mean / sum).dot(d_point.as_dvec3())
    };
    let plane = [q.x, q.y];
    let analytic = [d_query.x, d_query.y];
    testkit::gradient::assert_gradient("plane", &plane, &analytic, 1e-3, Tolerance::default(), weighted);
    let blended = query.blend(q, &list);
    assert!(blended.point.distance(q) < 0.34, "{blended:?}");
    assert_eq!((blended.normal, blended.signed_distance), (Vec3::Z, 0.0));
}

#[test]
fn normals_that_cancel_fall_back_to_the_nearest_vertex() {
    // Two faces back to back, vertices apart: the query in the middle sees opposite normals.
    let v = [Vec3::ZERO, Vec3::X, Vec3::Y];
    let vertices: Vec<Vec3> = v.iter().map(|p| *p - Vec3::Z).chain(v.iter().map(|p| *p + Vec3::Z)).collect();
    let faces = [[0, 2, 1], [3, 4, 5]];
    let settings = SurfaceQueryConfig { k: 2, ..Default::default() };
    let query = SurfaceQuery::new(&vertices, &faces, &settings).unwrap();
    let blended = query.blend(Vec3::ZERO, &[0, 3]);
    assert_eq!(blended.normal, -Vec3::Z);
    assert!(query.blend_backward(Vec3::ZERO, &[0, 3], Vec3::ONE, 1.0).is_finite());
}
