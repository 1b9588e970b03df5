//! Cameras, boxes, bins and lenses.

use approx::abs_diff_eq;
use glam::{Affine3A, Mat3, Quat, Vec2, Vec3};
use proptest::prelude::*;
use testkit::strategy::{degenerate_clouds, rotation, unit_vec3, vec3};
use volrender::{Aabb, Bins, Camera, Distortion, Ray, patch};

fn intrinsics(fx: f32, fy: f32, cx: f32, cy: f32) -> Mat3 {
    Mat3::from_cols_array(&[fx, 0.0, 0.0, 0.0, fy, 0.0, cx, cy, 1.0])
}

fn camera() -> impl Strategy<Value = Camera> {
    let k = (50.0f32..500.0, 50.0f32..500.0, 20.0f32..80.0, 20.0f32..80.0);
    (k, rotation(), vec3(3.0)).prop_map(|((fx, fy, cx, cy), rotation, translation)| {
        let extrinsics = Affine3A::from_rotation_translation(rotation, translation);
        Camera::new(intrinsics(fx, fy, cx, cy), extrinsics, 100, 90).expect("a camera")
    })
}

fn inflated(bounds: Aabb, margin: f32) -> Aabb {
    Aabb { min: bounds.min - margin, max: bounds.max + margin }
}

fn contains(bounds: Aabb, p: Vec3) -> bool {
    bounds.min.cmple(p).all() && p.cmple(bounds.max).all()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn points_on_a_ray_project_to_its_pixel(camera in camera(), u in 0.0f32..100.0, v in 0.0f32..90.0, t in 0.5f32..10.0) {
        let ray = camera.ray(u, v);
        prop_assert!(abs_diff_eq!(ray.direction.length(), 1.0, epsilon = 1e-6));
        prop_assert!(ray.origin.distance(camera.centre_of_projection()) < 1e-6);
        let projected = camera.project(ray.at(t)).unwrap();
        // 1e-6 m at a depth of 0.5 m with a focal length of 500, rounded in projection.
        prop_assert!(projected.truncate().distance(Vec2::new(u, v)) < 2e-2, "{projected}");
        prop_assert!(projected.z <= t * (1.0 + 1e-5));
        prop_assert!(camera.project(ray.at(-t)).is_none(), "behind the camera");
    }

    #[test]
    fn a_patch_is_the_square_inside_the_image_that_is_closest_to_centred(
        (width, height) in (1u32..40, 1u32..40), x in 0u32..50, y in 0u32..50, size in 0u32..45,
    ) {
        let pixels: Vec<u32> = patch((x, y), size, (width, height)).collect();
        let side = size.min(width).min(height);
        prop_assert_eq!(pixels.len(), (side * side) as usize);
        if side > 0 {
            let (left, top) = (pixels[0] % width, pixels[0] / width);
            let square = (0..side * side).map(|i| (top + i / side) * width + left + i % side);
            prop_assert!(left + side <= width && square.eq(pixels));
            let nearest = |at: u32, limit: u32| (0..=limit - side).min_by_key(|first| (first + side / 2).abs_diff(at)).unwrap();
            prop_assert_eq!((left, top), (nearest(x, width), nearest(y, height)));
        }
    }

    #[test]
    fn resizing_keeps_ray_directions(camera in camera(), u in 0.0f32..100.0, v in 0.0f32..90.0, w in 1u32..400, h in 1u32..400) {
        let resized = camera.resized(w, h);
        prop_assert_eq!((resized.width, resized.height), (w, h));
        let there = resized.ray(u * w as f32 / 100.0, v * h as f32 / 90.0).direction;
        prop_assert!(there.distance(camera.ray(u, v).direction) < 1e-4);
    }

    #[test]
    fn intrinsics_round_trip(camera in camera()) {
        let again = Camera::new(camera.intrinsics(), camera.world_to_camera, 100, 90).unwrap();
        prop_assert_eq!(again, camera);
    }

    #[test]
    fn a_ray_is_in_the_box_exactly_between_near_and_far(
        centre in vec3(2.0), half in vec3(1.0), inside in vec3(1.0), back in 0.0f32..5.0,
        direction in unit_vec3(), through: bool,
    ) {
        let half = half.abs() + 0.05;
        let bounds = Aabb { min: centre - half, max: centre + half };
        // Through a point of the box, or anywhere.
        let target = if through { centre + 0.99 * half * inside } else { 4.0 * inside };
        let ray = Ray { origin: target - direction * back, direction };
        let (roomy, tight) = (inflated(bounds, 1e-4), inflated(bounds, -1e-4));
        let Some((near, far)) = bounds.intersect(&ray) else {
            let passes = (0..4000).any(|i| contains(inflated(bounds, -1e-3), ray.at(i as f32 * 0.004)));
            prop_assert!(!through && !passes);
            return Ok(());
        };
        prop_assert!(0.0 <= near && near < far);
        prop_assert!(!through || near <= back + 1e-4 && back <= far + 1e-4);
        for i in 0..=10 {
            prop_assert!(contains(roomy, ray.at(near + (far - near) * i as f32 / 10.0)));
        }
        prop_assert!(!contains(tight, ray.at(far)));
        prop_assert!(near == 0.0 || !contains(tight, ray.at(near)));
    }

    #[test]
    fn bins_tile_the_range_and_a_sample_stays_in_its_bin(
        near in 0.0f32..10.0, length in 0.0f32..5.0, n in 0usize..300, place in 0.0f32..1.0,
    ) {
        let bins = Bins::new(near, near + length, n);
        if n == 0 {
            prop_assert_eq!((bins.width(), bins.at(0, place)), (0.0, near));
            return Ok(());
        }
        let edges: Vec<f32> = (0..=n).map(|i| bins.at(i, 0.0)).collect();
        prop_assert!(edges[0] == near && edges.is_sorted());
        prop_assert!(abs_diff_eq!(edges[n], near + length, epsilon = 1e-5));
        for i in 0..n {
            let t = bins.at(i, place);
            prop_assert!(edges[i] <= t && t <= edges[i + 1]);
            // An ulp of an edge is up to 1e-6.
            prop_assert!(abs_diff_eq!(edges[i + 1] - edges[i], bins.width(), epsilon = 3e-6));
            prop_assert!(abs_diff_eq!(0.5 * (edges[i] + edges[i + 1]), bins.at(i, 0.5), epsilon = 3e-6));
        }
    }

    #[test]
    fn undistorting_inverts_distorting(x in -0.6f32..0.6, y in -0.6f32..0.6, k in prop::array::uniform5(-1.0f32..1.0)) {
        let lens = Distortion::from_opencv([0.2 * k[0], 0.1 * k[1], 0.01 * k[2], 0.01 * k[3], 0.05 * k[4]]);
        let p = Vec2::new(x, y);
        let back = lens.undistort(lens.distort(p)).unwrap();
        prop_assert!(back.distance(p) < 1e-5, "{p} {back}");
    }
}

#[test]
fn the_centre_of_the_first_pixel_is_at_one_half() {
    let camera = Camera::new(intrinsics(100.0, 100.0, 32.0, 24.0), Affine3A::IDENTITY, 64, 48).unwrap();
    assert_eq!(camera.ray(32.0, 24.0).direction, Vec3::Z);
    let first = camera.ray(0.5, 0.5).direction;
    let expected = Vec3::new(-0.315, -0.235, 1.0).normalize_or_zero();
    assert!(first.distance(expected) < 1e-6);
    assert_eq!(camera.project(Vec3::new(0.1, -0.2, 2.0)), Some(Vec3::new(37.0, 14.0, 2.0)));
}

#[test]
fn degenerate_intrinsics_and_extrinsics_are_errors() {
    let good = intrinsics(100.0, 100.0, 32.0, 24.0);
    let new = |k, e| Camera::new(k, e, 64, 48);
    let mut skewed = good;
    skewed.y_axis.x = 3.0;
    let mut scaled = good;
    scaled.z_axis.z = 2.0;
    let bad = [skewed, scaled, good.transpose(), Mat3::ZERO, -good, intrinsics(f32::NAN, 1.0, 0.0, 0.0)];
    for k in bad {
        let error = new(k, Affine3A::IDENTITY).unwrap_err().to_string();
        assert!(error.starts_with("intrinsics "), "{k}: {error}");
    }
    let flat = Affine3A::from_scale(Vec3::new(1.0, 1.0, 0.0));
    let nan = Affine3A::from_translation(Vec3::NAN);
    for e in [flat, nan, Affine3A::from_scale(Vec3::INFINITY)] {
        let error = new(good, e).unwrap_err().to_string();
        assert!(error.starts_with("extrinsics "), "{e}: {error}");
    }
    let none = Camera::new(good, Affine3A::IDENTITY, 0, 48);
    assert_eq!(none.unwrap_err().to_string(), "an image of 0×48 pixels is smaller than 1×1");
}

#[test]
fn points_behind_the_camera_or_not_finite_have_no_projection() {
    let camera = Camera::new(intrinsics(100.0, 100.0, 32.0, 24.0), Affine3A::IDENTITY, 64, 48).unwrap();
    let unseen = [
        Vec3::ZERO,
        -Vec3::Z,
        Vec3::X,
        Vec3::NAN,
        Vec3::INFINITY,
        Vec3::new(1e30, 0.0, 1e-30),
        Vec3::new(f32::NAN, 0.0, 1.0),
    ];
    for x in unseen {
        assert_eq!(camera.project(x), None, "{x}");
    }
}

#[test]
fn rays_along_faces_intersect_and_degenerate_boxes_do_not() {
    let unit = Aabb { min: Vec3::ZERO, max: Vec3::ONE };
    let ray = |origin: [f32; 3], direction: Vec3| Ray { origin: origin.into(), direction };
    // In a face, and parallel to one just outside.
    assert_eq!(unit.intersect(&ray([-1.0, 0.0, 0.5], Vec3::X)), Some((1.0, 2.0)));
    assert_eq!(unit.intersect(&ray([-1.0, 1.0, 1.0], Vec3::X)), Some((1.0, 2.0)));
    assert_eq!(unit.intersect(&ray([-1.0, -1e-6, 0.5], Vec3::X)), None);
    assert_eq!(unit.intersect(&ray([-1.0, 0.5, 0.5], Vec3::new(1.0, -0.0, 0.0))), Some((1.0, 2.0)));
    // From inside, from a face outwards, and past the box.
    assert_eq!(unit.intersect(&ray([0.5; 3], -Vec3::Y)), Some((0.0, 0.5)));
    assert_eq!(unit.intersect(&ray([1.0, 0.5, 0.5], Vec3::X)), None);
    assert_eq!(unit.intersect(&ray([2.0, 0.5, 0.5], Vec3::X)), None);
    // Empty, flat and NaN boxes; zero, NaN and infinite rays.
    let through = ray([0.5, 0.5, -1.0], Vec3::Z);
    let flat = Aabb { min: Vec3::ZERO, max: Vec3::new(1.0, 1.0, 0.0) };
    for bounds in [Aabb::EMPTY, flat, Aabb { min: Vec3::NAN, ..unit }, Aabb { max: Vec3::NAN, ..unit }] {
        assert_eq!(bounds.intersect(&through), None, "{bounds:?}");
    }
    for bad in [
        ray([0.5; 3], Vec3::ZERO),
        ray([0.5; 3], Vec3::NAN),
        ray([f32::NAN; 3], Vec3::X),
        ray([0.5; 3], Vec3::INFINITY),
    ] {
        assert_eq!(unit.intersect(&bad), None, "{bad:?}");
    }
    let everywhere = Aabb { min: Vec3::NEG_INFINITY, max: Vec3::INFINITY };
    assert_eq!(everywhere.intersect(&through), None, "an infinite range cannot be sampled");
}

#[test]
fn boxes_of_degenerate_clouds_contain_their_finite_points() {
    for (name, points) in degenerate_clouds() {
        let bounds = Aabb::from_points(&points);
        let finite: Vec<_> = points.iter().filter(|p| p.is_finite()).collect();
        assert_eq!(bounds.is_empty(), finite.is_empty(), "{name}");
        assert!(finite.iter().all(|p| contains(bounds, **p)), "{name}");
    }
}

#[test]
fn distort_equals_opencvs_formula() {
    // x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²), by hand at (0.5, 0.25), r² =
    // 0.3125.
    let lens = Distortion::from_opencv([0.1, -0.2, 0.01, 0.02, 0.3]);
    let s = 1.0 + 0.1 * 0.3125 - 0.2 * 0.097_656_25 + 0.3 * 0.030_517_578;
    let expected = Vec2::new(
        0.5 * s + 2.0 * 0.01 * 0.125 + 0.02 * (0.3125 + 0.5),
        0.25 * s + 0.01 * (0.3125 + 0.125) + 2.0 * 0.02 * 0.125,
    );
    let p = Vec2::new(0.5, 0.25);
    assert!(lens.distort(p).distance(expected) < 1e-6);
    assert!(Distortion::default().is_identity());
    assert_eq!(Distortion::default().undistort(p), Some(p));

    let camera =
        Camera::new(intrinsics(100.0, 200.0, 32.0, 24.0), Affine3A::from_quat(Quat::from_rotation_y(1.0)), 64, 48);
    let pixel = camera.unwrap().distort_pixel(&lens, Vec2::new(82.0, 74.0));
    assert!(pixel.distance(expected * Vec2::new(100.0, 200.0) + Vec2::new(32.0, 24.0)) < 1e-3);
}

#[test]
fn undistort_converges_inside_the_fold_radius_and_rejects_what_is_not_finite() {
    // r (1 − r²/3) has its largest value 2/3 at r = 1.
    let lens = Distortion { k1: -1.0 / 3.0, ..Distortion::default() };
    let near = lens.undistort(Vec2::new(0.6, 0.0)).unwrap();
    assert!(lens.distort(near).distance(Vec2::new(0.6, 0.0)) < 1e-6 && near.x < 1.0);
    assert_eq!(lens.undistort(Vec2::NAN), None);
    assert_eq!(lens.undistort(Vec2::new(f32::INFINITY, 0.0)), None);
}
