//! The rasteriser against the ray caster, and against what must hold of any picture.

use glam::{Affine3A, DVec3, Mat3, Quat, Vec2, Vec3};
use proptest::prelude::*;
use testkit::body::Random;
use testkit::{TriMesh, mesh, strategy};
use visibility::{Fragment, Pixel, RasterOptions, Rasterizer, RayMesh, Samples, View};

use crate::views::{look, turned};

const OPTIONS: RasterOptions = RasterOptions { samples: Samples::One, cull_back: false, near: 1e-4 };

fn camera(rotation: Quat, eye: Vec3, focal: f32, size: u32) -> View {
    turned(Mat3::from_quat(rotation), eye, focal, size)
}

fn draw(mesh: &TriMesh, view: &View) -> Vec<Option<Fragment>> {
    Rasterizer::default().faces(&mesh.vertices, &mesh.faces, view, &OPTIONS).unwrap()
}

/// The direction through a pixel's centre, not normalised: its third camera coordinate is 1.
fn direction(view: &View, pixel: usize) -> Vec3 {
    let (x, y) = (pixel % view.width as usize, pixel / view.width as usize);
    let local = (Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - view.centre) / view.focal;
    view.world_to_camera.inverse().transform_vector3(local.extend(1.0))
}

/// How far, in pixels, the centre of a pixel is from the nearest line along a side of a face.
fn from_edge(mesh: &TriMesh, view: &View, face: u32, pixel: usize) -> f64 {
    let (x, y) = (pixel % view.width as usize, pixel / view.width as usize);
    let centre = DVec3::new(x as f64 + 0.5, y as f64 + 0.5, 1.0);
    let clip = mesh.faces[face as usize]
        .map(|v| view.world_to_camera.transform_point3(mesh.vertices[v as usize]))
        .map(|p| (view.focal * p.truncate() + view.centre * p.z).extend(p.z).as_dvec3());
    (0..3)
        .map(|i| {
            let line = clip[i].cross(clip[(i + 1) % 3]);
            line.dot(centre).abs() / line.truncate().length()
        })
        .fold(f64::INFINITY, f64::min)
}

/// Least and greatest depth of a face's plane within the rounding of its corners about the centre
/// of a pixel.
fn depths(mesh: &TriMesh, view: &View, face: u32, pixel: usize) -> [f64; 2] {
    let eye = view.centre_of_projection().unwrap().as_dvec3();
    let [a, b, c] = mesh.faces[face as usize].map(|v| mesh.vertices[v as usize].as_dvec3() - eye);
    let normal = (b - a).cross(c - a);
    let around = [Vec3::ZERO, Vec3::X, -Vec3::X, Vec3::Y, -Vec3::Y].map(|step| {
        let moved = View { centre: view.centre + (step * 0.01).truncate(), ..*view };
        normal.dot(a) / normal.dot(direction(&moved, pixel).as_dvec3())
    });
    [around.into_iter().fold(f64::INFINITY, f64::min), around.into_iter().fold(f64::NEG_INFINITY, f64::max)]
}

/// Compares every pixel with the ray through its centre; returns the number that hit.
fn check_against_rays(mesh: &TriMesh, view: &View) -> Result<usize, TestCaseError> {
    let rays = RayMesh::new(&mesh.vertices, &mesh.faces).unwrap();
    let eye = view.centre_of_projection().unwrap();
    let drawn = draw(mesh, view);
    // Corners are rounded to 1/256 of a pixel, twice 1/512 at worst, and rays to a part in 10⁶ of
    // the picture.
    let close = |face: u32, pixel| from_edge(mesh, view, face, pixel) < 0.01;
    for (pixel, fragment) in drawn.iter().enumerate() {
        let hit = rays.first_hit(eye, direction(view, pixel));
        match (fragment, hit) {
            (None, None) => {}
            (Some(fragment), Some(hit)) if fragment.face == hit.face => {
                prop_assert!((fragment.depth - hit.t).abs() < 1e-3 * hit.t + 1e-5, "{:?} {:?}", fragment, hit);
                let sum: f32 = fragment.barycentric.iter().sum();
                prop_assert!((sum - 1.0).abs() < 1e-5 && fragment.barycentric.iter().all(|b| *b >= 0.0));
                let corners = mesh.faces[hit.face as usize].map(|v| mesh.vertices[v as usize]);
                let at = |weights: [f32; 3]| (0..3).map(|i| corners[i] * weights[i]).sum::<Vec3>();
                let apart = at(fragment.barycentric).distance(at(hit.barycentric));
                // The weights of a sample just outside are cut off at 0.
                let tolerance = if close(hit.face, pixel) { 0.05 } else { 2e-3 };
                // Corners of a unit's size are rounded, too.
                prop_assert!(apart < tolerance * hit.t + 2e-6, "{:?} {:?}: {}", fragment, hit, apart);
            }
            (Some(fragment), Some(hit)) => {
                let (a, b) = (depths(mesh, view, fragment.face, pixel), depths(mesh, view, hit.face, pixel));
                let tie = a[0] <= b[1] * (1.0 + 1e-5);
                let edge = close(fragment.face, pixel) || close(hit.face, pixel);
                // Rays also meet what is nearer than the near plane.
                prop_assert!(tie || edge || hit.t < 2e-4, "pixel {}: {:?} {:?}", pixel, fragment, hit);
            }
            (Some(fragment), None) => prop_assert!(close(fragment.face, pixel), "pixel {}: {:?}", pixel, fragment),
            (None, Some(hit)) => {
                prop_assert!(close(hit.face, pixel) || hit.t < 2e-4, "pixel {}: {:?}", pixel, hit);
            }
        }
    }
    Ok(drawn.iter().flatten().count())
}

/// How many triangles claim each pixel, drawn one by one.
fn claims(mesh: &TriMesh, view: &View) -> Vec<u32> {
    let mut rasterizer = Rasterizer::default();
    let mut claims = vec![0; (view.width * view.height) as usize];
    for &face in &mesh.faces {
        let drawn = rasterizer.faces(&mesh.vertices, &[face], view, &OPTIONS).unwrap();
        claims.iter_mut().zip(drawn).for_each(|(claims, fragment)| *claims += u32::from(fragment.is_some()));
    }
    claims
}

/// One unit is a pixel at depth 1, the origin the corner of the picture.
fn flat_view(size: u32) -> View {
    View { focal: Vec2::ONE, centre: Vec2::ZERO, world_to_camera: Affine3A::IDENTITY, width: size, height: size }
}

/// A grid of 2·n² triangles over [0, n·cell]² at depth 1, its inner vertices moved by `jitter`.
fn sheet(n: u32, cell: f32, mut jitter: impl FnMut() -> Vec3) -> TriMesh {
    let inner = |i: u32| i > 0 && i < n;
    let mut vertices = Vec::new();
    for y in 0..=n {
        for x in 0..=n {
            let moved = if inner(x) && inner(y) { jitter() } else { Vec3::ZERO };
            vertices.push(Vec3::new(x as f32, y as f32, 0.0) * cell + moved.with_z(1.0));
        }
    }
    let corner = |x, y| y * (n + 1) + x;
    let cells = (0..n * n).map(|i| (i % n, i / n));
    let faces = cells.flat_map(|(x, y)| {
        let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x, y + 1), corner(x + 1, y + 1)];
        // Both ways of cutting a cell, and both ways round.
        if (x + y) % 2 == 0 { [[a, b, d], [a, c, d]] } else { [[a, b, c], [d, b, c]] }
    });
    TriMesh { faces: faces.collect(), vertices }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn a_pixel_sees_the_face_that_a_ray_through_its_centre_meets_first(
        mesh in strategy::bumpy_sphere(), away in strategy::unit_vec3(), r in 1.6f32..6.0, focal in 20.0f32..300.0,
    ) {
        let hits = check_against_rays(&mesh, &look(away * r, Vec3::ZERO, focal, 70))?;
        prop_assert!(hits > 0);
    }

    #[test]
    fn a_camera_among_loose_triangles_sees_what_its_rays_meet(
        points in strategy::cloud(90..91, 2.0), rotation in strategy::rotation(), focal in 10.0f32..100.0,
    ) {
        let faces = (0..30).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        check_against_rays(&TriMesh { vertices: points, faces }, &camera(rotation, Vec3::ZERO, focal, 60))?;
    }

    #[test]
    fn a_camera_inside_a_closed_mesh_sees_no_crack(
        mesh in strategy::bumpy_sphere(), rotation in strategy::rotation(), eye in strategy::vec3(0.3),
        focal in 3.0f32..200.0,
    ) {
        let drawn = draw(&mesh, &camera(rotation, eye, focal, 90));
        prop_assert!(drawn.iter().all(Option::is_some));
        check_against_rays(&mesh, &camera(rotation, eye, focal, 90))?;
    }

    #[test]
    fn triangles_that_tile_a_plane_share_out_its_pixels(seed: u64, cell in 2.0f32..9.0, quarters: bool) {
        let mut random = Random(seed);
        let jitter = || {
            let moved = random.vec3(0.15 * cell);
            // Corners and edges through pixel centres are where the rule decides.
            if quarters { (moved * 4.0).round() / 4.0 } else { moved }
        };
        let cell = if quarters { (cell * 2.0).round() / 2.0 } else { cell };
        let sheet = sheet(6, cell, jitter);
        let size = 60;
        for (pixel, claims) in claims(&sheet, &flat_view(size)).into_iter().enumerate() {
            let (x, y) = ((pixel as u32 % size) as f32 + 0.5, (pixel as u32 / size) as f32 + 0.5);
            let outline = (x.max(y) - 6.0 * cell).abs() < 0.01;
            prop_assert!(outline || claims == u32::from(x.max(y) < 6.0 * cell), "{} {}: {}", x, y, claims);
        }
    }

    #[test]
    fn the_inside_of_a_closed_mesh_is_hidden_from_outside(
        mesh in strategy::bumpy_sphere(), away in strategy::unit_vec3(), r in 1.6f32..6.0,
    ) {
        let view = look(away * r, Vec3::ZERO, 60.0, 80);
        let both = draw(&mesh, &view);
        let options = RasterOptions { cull_back: true, ..OPTIONS };
        let front = Rasterizer::default().faces(&mesh.vertices, &mesh.faces, &view, &options).unwrap();
        for (both, front) in both.iter().zip(&front) {
            // At the outline a sliver of the back may show where the front's is rounded away.
            prop_assert!(both == front || both.unwrap().depth > r - 1.5, "{:?} {:?}", both, front);
        }
        let differ = both.iter().zip(&front).filter(|(a, b)| a != b).count();
        prop_assert!(differ * 200 <= both.len(), "{}", differ);
    }

    #[test]
    fn the_picture_does_not_depend_on_the_number_of_threads(
        mesh in strategy::bumpy_sphere(), away in strategy::unit_vec3(),
    ) {
        let view = look(away * 2.0, Vec3::ZERO, 60.0, 90);
        let [one, many] = [1, 3].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| draw(&mesh, &view))
        });
        prop_assert_eq!(one, many);
    }
}

/// Everything that a picture says of every sample.
fn all_samples(mesh: &TriMesh, view: &View, samples: Samples) -> Vec<Vec<Option<Fragment>>> {
    let mut out = vec![Vec::new(); (view.width * view.height) as usize];
    let options = RasterOptions { samples, ..OPTIONS };
    let copy = |pixel: Pixel<'_>| pixel.samples.to_vec();
    Rasterizer::default().draw(&mesh.vertices, &mesh.faces, view, &options, &mut out, copy).unwrap();
    out
}

#[test]
fn four_samples_are_the_pixels_of_a_picture_twice_as_large() {
    let ball = mesh::icosphere(2);
    let view = look(Vec3::new(1.0, 2.0, 0.5), Vec3::ZERO, 40.0, 37);
    let large = draw(&ball, &look(Vec3::new(1.0, 2.0, 0.5), Vec3::ZERO, 80.0, 74));
    for (i, samples) in all_samples(&ball, &view, Samples::Four).iter().enumerate() {
        let (x, y) = (i % 37 * 2, i / 37 * 2);
        let expected = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].map(|(x, y)| large[y * 74 + x]);
        assert!(samples.len() == 4 || (samples.is_empty() && expected == [None; 4]));
        for (sample, expected) in samples.iter().zip(expected) {
            assert_eq!(*sample, expected);
        }
    }
}

#[test]
fn a_plane_is_drawn_to_the_horizon_and_a_wall_fills_the_picture_however_large_they_are() {
    // Level, 1 above the ground: row v looks at depth focal / (v + ½ − cy).
    let view = camera(Quat::IDENTITY, Vec3::ZERO, 50.0, 100);
    for extent in [1e3f32, 1e6, 1e12] {
        let at = |x: f32, z: f32| Vec3::new(x * extent, 1.0, z * extent);
        let ground = TriMesh { vertices: vec![at(-1.0, -1.0), at(1.0, -1.0), at(0.0, 1.0)], faces: vec![[0, 1, 2]] };
        let wall = ground.clone().map(|p| Vec3::new(p.x, p.z, 7.0));
        assert!(draw(&wall, &view).iter().all(|f| f.is_some_and(|f| (f.depth - 7.0).abs() < 1e-4)), "{extent}");
        for (i, fragment) in draw(&ground, &view).iter().enumerate() {
            let (x, row) = (i % 100, i / 100);
            if row >= 51 {
                let depth = 50.0 / (row as f32 + 0.5 - 50.0);
                let fragment = fragment.unwrap_or_else(|| panic!("{extent}: nothing at {x} {row}"));
                assert!((fragment.depth / depth - 1.0).abs() < 1e-2, "{extent} {row}: {fragment:?} {depth}");
            } else if row < 49 {
                assert_eq!(*fragment, None, "{extent}: {x} {row}");
            }
        }
    }
}

#[test]
fn triangles_without_area_behind_the_camera_or_not_finite_are_not_drawn() {
    let view = camera(Quat::IDENTITY, Vec3::ZERO, 50.0, 64);
    let (x, y, z) = (Vec3::X, Vec3::Y, Vec3::Z * 2.0);
    for corners in [
        [z, z, z],
        [z, z + x, z],
        [z - x, z, z + x],
        [-z - x, -z + x, -z + y],
        [Vec3::ZERO, Vec3::ZERO, Vec3::ZERO],
        // In a plane with the eye.
        [-z, z - x, z + x],
        [z, z + x, Vec3::NAN],
        [z, z + x, z + Vec3::Y * f32::INFINITY],
        [Vec3::NAN; 3],
        // Nearer than the near plane.
        [Vec3::new(-1.0, -1.0, 5e-5), Vec3::new(1.0, -1.0, 5e-5), Vec3::new(0.0, 1.0, 5e-5)],
    ] {
        let mesh = TriMesh { vertices: corners.to_vec(), faces: vec![[0, 1, 2]] };
        assert!(draw(&mesh, &view).iter().all(Option::is_none), "{corners:?}");
    }
}

#[test]
fn any_points_and_any_camera_give_fragments_of_existing_faces() {
    let bad_intrinsics =
        [(0.0, 0.0), (f32::NAN, f32::NAN), (f32::MAX, 0.0), (f32::MAX, f32::MAX), (-20.0, 0.0), (30.0, f32::INFINITY)];
    for (name, points) in strategy::degenerate_clouds() {
        let n = points.len() as u32;
        let faces: Vec<[u32; 3]> = (0..n.saturating_sub(2)).map(|i| [i, i + 1, i + 2]).collect();
        for rotation in [Quat::IDENTITY, Quat::from_rotation_y(2.0), Quat::from_rotation_x(-1.0)] {
            let usual = camera(rotation, Vec3::new(0.2, 0.1, -0.3), 30.0, 40);
            let others = bad_intrinsics.map(|(focal, centre)| View {
                focal: Vec2::splat(focal),
                centre: Vec2::splat(centre),
                ..usual
            });
            for view in others.iter().chain([&usual]) {
                let options = RasterOptions { near: f32::NAN, ..OPTIONS };
                for options in [OPTIONS, options] {
                    let drawn = Rasterizer::default().faces(&points, &faces, view, &options).unwrap();
                    for f in drawn.iter().flatten() {
                        let sum: f32 = f.barycentric.iter().sum();
                        let sane = (f.face as usize) < faces.len() && f.depth.is_finite() && f.depth > 0.0;
                        assert!(sane && (sum - 1.0).abs() < 1e-4, "{name}: {f:?}");
                    }
                }
            }
        }
    }
}

#[test]
fn indices_out_of_range_and_large_images_are_errors() {
    let mut rasterizer = Rasterizer::default();
    let view = flat_view(4);
    let error = rasterizer.faces(&[Vec3::Z; 3], &[[0, 1, 2], [0, 3, 1]], &view, &OPTIONS).unwrap_err();
    assert_eq!(error.to_string(), "face 1 has vertex index 3, but there are only 3 vertices");
    let wide = View { width: 100_000, height: 1, ..view };
    let error = rasterizer.faces(&[], &[], &wide, &OPTIONS).unwrap_err();
    assert_eq!(error.to_string(), "an image of 100000 × 1 pixels, at most 16384 × 16384 are supported");
    for view in [View { width: 0, ..view }, View { height: 0, ..view }] {
        assert_eq!(rasterizer.faces(&[Vec3::Z; 3], &[[0, 1, 2]], &view, &OPTIONS), Ok(vec![]));
    }
    assert_eq!(rasterizer.faces(&[], &[], &view, &OPTIONS), Ok(vec![None; 16]));
}

#[test]
#[should_panic(expected = "3 values for 4 × 4 pixels")]
fn an_output_of_another_size_panics() {
    let _ = Rasterizer::default().draw(&[], &[], &flat_view(4), &OPTIONS, &mut [0; 3], |_| 0);
}
