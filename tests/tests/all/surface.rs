//! Rasterising, ray casts and cameras are written apart from each other; here they must say the
//! same of a body.

use crate::common;

use approx::assert_abs_diff_eq;

use common::{scene, silhouette};
use glam::Vec3;
use occnerf::{PriorColors, PriorRenderer, Renderer};
use testkit::oracle;
use visibility::RayMesh;

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
