//! Surface queries, ray casts and cameras are written apart from each other; here they must say the
//! same of a body.

use crate::common;

use approx::assert_abs_diff_eq;
use std::collections::BTreeSet;

use common::{body, placement, scene, silhouette, walking};
use glam::Vec3;
use occnerf::{PriorColors, PriorRenderer, Renderer};
use proptest::prelude::*;
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
use testkit::{oracle, strategy};
use visibility::RayMesh;

/// Share of neighbours that two queries have in common, |A ∩ B| / |A ∪ B|.
fn overlap(query: &SurfaceQuery, scales: usize, a: Vec3, b: Vec3) -> f32 {
    let [a, b] = [a, b].map(|x| {
        let mut list = vec![0; query.neighbours_per_query()];
        query.neighbours(x, &mut list);
        list[..5 * scales].iter().copied().collect::<BTreeSet<u32>>()
    });
    a.intersection(&b).count() as f32 / a.union(&b).count() as f32
}

/// Surface-based rendering's reason to exist: what one point learns, points near it share, and
/// farther with more scales.
#[test]
fn neighbours_overlap_less_with_distance_and_more_at_four_scales_than_at_one() {
    let shaped = body().shaped(&[]);
    let query = SurfaceQuery::new(
        &shaped.vertices,
        &body().faces,
        &SurfaceQueryConfig { cell: 0.02, margin: 0.12, ..Default::default() },
    )
    .unwrap();
    let distances = [0.01, 0.03, 0.06, 0.12, 0.25];
    let mut means = [[0.0f32; 5]; 2];
    for (at, &distance) in distances.iter().enumerate() {
        let mut count = 0;
        for (i, &v) in shaped.vertices.iter().enumerate().step_by(7) {
            // Another vertex at about this distance; the first found in an order that favours no
            // side.
            let order = (1..shaped.vertices.len()).map(|j| (i + j * 911) % shaped.vertices.len());
            let near = |j: &usize| (shaped.vertices[*j].distance(v) / distance - 1.0).abs() < 0.35;
            let Some(j) = order.into_iter().find(near) else { continue };
            count += 1;
            for (scales, means) in [1, 4].into_iter().zip(&mut means) {
                means[at] += overlap(&query, scales, v, shaped.vertices[j]);
            }
        }
        assert!(count > 100, "{count} pairs at {distance}");
        means.iter_mut().for_each(|m| m[at] /= count as f32);
    }
    println!("one scale {:?}, four {:?}", means[0], means[1]);
    for scale in means {
        assert!(scale.windows(2).all(|w| w[1] < w[0] || w[1] == 0.0), "{scale:?}");
    }
    for (one, four) in means[0].iter().zip(&means[1]).skip(1) {
        assert!(four > one, "{means:?}");
    }
    // At 6 cm a single scale shares next to nothing any more.
    assert!(means[1][2] > 3.0 * means[0][2], "{means:?}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn the_same_point_shares_everything_and_far_sides_share_nothing_at_the_finest_scale(
        mesh in strategy::bumpy_sphere(), q in strategy::unit_vec3(),
    ) {
        let query = SurfaceQuery::new(&mesh.vertices, &mesh.faces, &SurfaceQueryConfig::default()).unwrap();
        prop_assert_eq!(overlap(&query, 4, q, q), 1.0);
        prop_assert_eq!(overlap(&query, 1, q, -q), 0.0);
        prop_assert!(overlap(&query, 4, q, q * 1.01) > 0.5);
    }

    #[test]
    fn where_a_ray_first_hits_the_distance_is_zero_and_nothing_is_nearer_than_the_distance(
        mesh in strategy::bumpy_sphere(), o in strategy::vec3(2.5), d in strategy::unit_vec3(), length in 0.1f32..5.0,
    ) {
        let rays = RayMesh::new(&mesh.vertices, &mesh.faces).unwrap();
        let distances = MeshDistance::new(&mesh.vertices, &mesh.faces).unwrap();
        let from = distances.closest(o).signed_distance;
        let hit = rays.first_hit(o, d * length);
        prop_assert!(hit.is_some() || from > 0.0, "no way out from inside, at {from}");
        if let Some(hit) = hit {
            let p = o + hit.t * length * d;
            let closest = distances.closest(p);
            prop_assert!(closest.signed_distance.abs() < 1e-5, "{}", closest.signed_distance);
            prop_assert!(hit.t * length >= from.abs() - 1e-5);
            // Both name the same point of the same surface.
            let corners = mesh.faces[hit.face as usize].map(|v| mesh.vertices[v as usize]);
            let named: Vec3 = corners.iter().zip(hit.barycentric).map(|(&v, b)| v * b).sum();
            prop_assert!(named.distance(closest.point) < 2e-5);
        }
    }
}

#[test]
fn distance_structure_and_ray_structure_agree_on_a_walking_body_after_a_refit() {
    let shaped = body().shaped(&[]);
    let posed = body().pose(&shaped, &walking(), placement());
    let rays = RayMesh::new(&posed.vertices, &body().faces).unwrap();
    let mut distances = MeshDistance::new(&shaped.vertices, &body().faces).unwrap();
    distances.refit(&posed.vertices);
    let centre = posed.vertices.iter().sum::<Vec3>() / posed.vertices.len() as f32;
    let mut hits = 0;
    for i in 0..4000 {
        let (turn, height) = (i as f32 * 2.399_963, i as f32 / 2000.0 - 1.0);
        let origin = centre + Vec3::new(turn.cos() * 2.0, height, turn.sin() * 2.0);
        let target = centre + Vec3::new((turn * 3.7).sin() * 0.4, height, (turn * 5.3).sin() * 0.2);
        let Some(hit) = rays.first_hit(origin, target - origin) else { continue };
        hits += 1;
        let closest = distances.closest(origin + hit.t * (target - origin));
        assert!(closest.signed_distance.abs() < 2e-6, "{}", closest.signed_distance);
        // Just before the hit the ray is outside. Grazing rays may be closer to another fold.
        let before = distances.closest(origin + (hit.t - 1e-3) * (target - origin));
        assert!(before.signed_distance > 0.0, "{}", before.signed_distance);
    }
    assert!(hits > 1000, "{hits}");
}

/// The picture of the prior against rays cast one by one over all triangles in `f64`.
#[test]
fn the_prior_renderers_silhouette_is_that_of_the_ray_casts() {
    let scene = scene();
    let white = vec![Vec3::ONE; scene.body.canonical.vertices.len()];
    let colors = PriorColors::of_vertices(white, &scene.body.model.faces);
    for frame in [&scene.eval[0], &scene.train[5]] {
        let (vertices, faces) = (&frame.view.posed.vertices, &scene.body.model.faces);
        let rendering = PriorRenderer::new(&scene.body, &colors).render(&frame.view, Vec3::ZERO).unwrap();
        let (mut inside, mut wrong, centres) = (0, 0, silhouette(scene, frame));
        let width = frame.view.camera.width as usize;
        for i in 0..rendering.opacity.len() {
            let (column, row) = ((i % width) as f32, (i / width) as f32);
            let cast = |(u, v): (f32, f32)| {
                let ray = frame.view.camera.ray(column + u, row + v);
                u8::from(oracle::first_hit(vertices, faces, ray.origin, ray.direction).is_some())
            };
            let hits: u8 = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)].map(cast).iter().sum();
            inside += usize::from(hits == 4);
            assert_eq!(centres[i], cast((0.5, 0.5)) == 1, "centre of pixel {i}");
            wrong += usize::from(rendering.opacity[i] != f32::from(hits) / 4.0);
            // White on black shows the opacity.
            assert_abs_diff_eq!(rendering.image.pixels[3 * i], rendering.opacity[i], epsilon = 1e-6);
        }
        assert!(inside > 50, "{inside}");
        assert_eq!(wrong, 0, "pixels in {}", frame.name);
    }
}

#[test]
fn cameras_and_views_put_vertices_into_the_same_pixels_and_rays_lead_back_to_them() {
    let scene = scene();
    let frame = &scene.train[0];
    let camera = &frame.view.camera;
    let view = occnerf::pinhole(camera);
    let mesh = RayMesh::new(&frame.view.posed.vertices, &scene.body.model.faces).unwrap();
    let visible = visibility::visible_vertices(&mesh, &frame.view.posed.vertices, &view, None);
    let mut seen = 0;
    for (i, (&v, visible)) in frame.view.posed.vertices.iter().zip(visible).enumerate() {
        let projected = camera.project(v).unwrap();
        let pixel = view.pixel(v).unwrap();
        let edge = (projected.fract() - 0.5).abs();
        if edge.x.max(edge.y) < 0.499 {
            assert_eq!(pixel, projected.y as usize * camera.width as usize + projected.x as usize);
        }
        let ray = camera.ray(projected.x, projected.y);
        let distance = ray.origin.distance(v);
        assert!(ray.at(distance).distance(v) < 1e-5);
        // Toward a vertex of the silhouette the ray may pass by.
        if let Some(hit) = mesh.first_hit(ray.origin, ray.direction) {
            seen += usize::from(visible);
            // Its own faces may be so oblique that a ray a hair beside it meets them far in front.
            if visible && !scene.body.model.faces[hit.face as usize].contains(&(i as u32)) {
                assert!(hit.t > distance - 1e-4, "visible at {distance}, but {} is in front", hit.t);
            }
        }
    }
    assert!(seen > 500, "{seen}");
}
