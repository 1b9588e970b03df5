//! Visible vertices against brute force.

use glam::{Affine3A, Mat3, Vec2, Vec3};
use proptest::prelude::*;
use testkit::{TriMesh, mesh, oracle, strategy};
use visibility::{RayMesh, View, visible_vertices};

/// A camera at `eye` that looks at `target`.
pub fn look(eye: Vec3, target: Vec3, focal: f32, size: u32) -> View {
    let forward = (target - eye).normalize_or(Vec3::Z);
    let down = (forward.any_orthonormal_vector()).normalize_or(Vec3::Y);
    turned(Mat3::from_cols(down.cross(forward), down, forward).transpose(), eye, focal, size)
}

/// A camera at `eye` of this rotation.
pub fn turned(rotation: Mat3, eye: Vec3, focal: f32, size: u32) -> View {
    let centre = size as f32 / 2.0;
    View {
        focal: Vec2::splat(focal),
        centre: Vec2::splat(centre),
        world_to_camera: Affine3A::from_mat3_translation(rotation, rotation * -eye),
        width: size,
        height: size,
    }
}

fn visible(mesh: &TriMesh, view: &View) -> Vec<bool> {
    let rays = RayMesh::new(&mesh.vertices, &mesh.faces).unwrap();
    visible_vertices(&rays, &mesh.vertices, view, None)
}

/// Whether anything but the vertex's own faces is in front of it; `None` within rounding of an
/// edge.
fn plain(mesh: &TriMesh, view: &View, vertex: usize) -> Option<bool> {
    let v = mesh.vertices[vertex];
    let eye = view.centre_of_projection().unwrap();
    let others: Vec<[u32; 3]> = (mesh.faces.iter().copied()).filter(|f| !f.contains(&(vertex as u32))).collect();
    let blocked =
        |o: Vec3, share: f64| oracle::first_hit(&mesh.vertices, &others, o, v - o).is_some_and(|(_, t)| t < share);
    let answer = blocked(eye, 1.0 - 1e-5);
    let clear = [Vec3::X, Vec3::Y, Vec3::Z]
        .iter()
        .all(|axis| [-3e-6, 3e-6].iter().all(|s| blocked(eye + *axis * *s, 1.0 - 1e-5 + f64::from(*s)) == answer));
    clear.then_some(!answer)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn visible_vertices_equal_brute_force(
        mesh in strategy::bumpy_sphere(), direction in strategy::unit_vec3(), r in 1.625f32..5.0,
    ) {
        // Wide enough to see everything in front.
        let view = look(direction * r, Vec3::ZERO, 20.0, 400);
        let found = visible(&mesh, &view);
        for (i, &found) in found.iter().enumerate() {
            if view.pixel(mesh.vertices[i]).is_none() {
                prop_assert!(!found);
            } else if let Some(expected) = plain(&mesh, &view, i) {
                prop_assert_eq!(found, expected, "vertex {}", i);
            }
        }
    }
}

#[test]
fn outside_the_image_behind_the_camera_and_behind_occluders_nothing_is_visible() {
    let points =
        [Vec3::ZERO, Vec3::new(0.6, 0.0, 0.0), Vec3::new(0.0, -0.6, 0.0), Vec3::new(0.0, 0.0, -9.0), Vec3::NAN];
    let rays = RayMesh::new(&[], &[]).unwrap();
    // One unit is 20 pixels, the image 20 wide.
    let mut view = look(-Vec3::Z, Vec3::ZERO, 20.0, 20);
    assert_eq!(visible_vertices(&rays, &points, &view, None), [true, false, false, false, false]);
    assert_eq!(view.pixel(Vec3::ZERO), Some(10 * 20 + 10));
    let mut usable = vec![true; 400];
    usable[210] = false;
    assert_eq!(visible_vertices(&rays, &points[..1], &view, Some(&usable)), [false]);
    view.world_to_camera = Affine3A::from_scale(Vec3::ZERO);
    assert_eq!(view.centre_of_projection(), None);
    assert_eq!(visible_vertices(&rays, &points, &view, None), [false; 5]);
    // Borders are half open.
    let view = View { focal: Vec2::ONE, centre: Vec2::ZERO, world_to_camera: Affine3A::IDENTITY, width: 2, height: 3 };
    let at = |u: f32, v: f32| visible_vertices(&rays, &[Vec3::new(u, v, 1.0)], &view, None)[0];
    assert!(at(0.0, 0.0) && at(1.99, 2.99));
    assert!(!at(2.0, 0.0) && !at(0.0, 3.0) && !at(-0.01, 0.0) && !at(0.0, -0.01));
}

#[test]
fn the_answer_does_not_depend_on_the_unit_of_length() {
    let ball = mesh::icosphere(2).map(|p| p * Vec3::new(1.0, 0.4, 0.7));
    let eye = Vec3::new(2.0, 1.0, -1.5);
    let metres = visible(&ball, &look(eye, Vec3::ZERO, 200.0, 400));
    for unit in [1e-9, 100.0, 1e9] {
        let scaled = ball.clone().map(|p| p * unit);
        assert_eq!(visible(&scaled, &look(eye * unit, Vec3::ZERO, 200.0, 400)), metres, "{unit}");
    }
}

#[test]
#[should_panic(expected = "3 usable flags for 4 × 4 pixels")]
fn a_mask_of_another_size_panics() {
    let rays = RayMesh::new(&[], &[]).unwrap();
    let view = look(-Vec3::Z, Vec3::ZERO, 20.0, 4);
    let _ = visible_vertices(&rays, &[Vec3::ZERO], &view, Some(&[true; 3]));
}
