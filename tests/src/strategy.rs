//! Proptest strategies, one per type, with bounded ranges; and the degenerate inputs every crate is
//! swept over.

use glam::{Quat, Vec3};
use proptest::prelude::*;

use crate::mesh::{TriMesh, icosphere};

/// Coordinates uniform in ±`range`.
pub fn vec3(range: f32) -> impl Strategy<Value = Vec3> {
    prop::array::uniform3(-range..=range).prop_map(Vec3::from)
}

/// Uniform on the unit sphere.
pub fn unit_vec3() -> impl Strategy<Value = Vec3> {
    // Archimedes: the height of a uniform point of the sphere is uniform.
    (-1.0f32..=1.0, 0.0..std::f32::consts::TAU).prop_map(|(z, angle)| {
        let r = (1.0 - z * z).max(0.0).sqrt();
        Vec3::new(r * angle.cos(), r * angle.sin(), z).normalize_or(Vec3::Z)
    })
}

/// Any rotation: axis uniform on the sphere, angle uniform in ±π.
pub fn rotation() -> impl Strategy<Value = Quat> {
    (unit_vec3(), -std::f32::consts::PI..=std::f32::consts::PI)
        .prop_map(|(axis, angle)| Quat::from_axis_angle(axis, angle))
}

/// Closed star-shaped mesh of 162 vertices about the origin, radii between 0.55 and 1.45: a sphere
/// with three smooth waves on it.
pub fn bumpy_sphere() -> impl Strategy<Value = TriMesh> {
    let wave = (vec3(4.0), 0.0..std::f32::consts::TAU, 0.0f32..0.15);
    prop::collection::vec(wave, 3).prop_map(|waves| {
        icosphere(2).map(|p| {
            let bump: f32 = waves.iter().map(|(k, phase, height)| height * (k.dot(p) + phase).sin()).sum();
            p * (1.0 + bump)
        })
    })
}

/// Between `n.start` and `n.end − 1` points in the cube ±`range`.
pub fn cloud(n: std::ops::Range<usize>, range: f32) -> impl Strategy<Value = Vec<Vec3>> {
    prop::collection::vec(vec3(range), n)
}

/// Named point sets on which searches, trees and normalisations go wrong: too few points,
/// coincident, collinear and coplanar ones, extreme magnitudes, and values that are not finite.
#[must_use]
pub fn degenerate_clouds() -> Vec<(&'static str, Vec<Vec3>)> {
    let line = |scale: f32| (0..40).map(move |i| Vec3::X * (i as f32 * scale));
    let plane = || (0..64).map(|i| Vec3::new((i % 8) as f32, 0.0, (i / 8) as f32));
    let spread = || {
        // A Halton-like set: no two points and no coordinates alike.
        (1..50).map(|i| {
            let t = i as f32;
            Vec3::new((t * 0.618_034).fract(), (t * 0.754_878).fract(), (t * 0.569_840_3).fract())
        })
    };
    let with = |bad: Vec3| {
        let mut points: Vec<Vec3> = spread().collect();
        points[7] = bad;
        points
    };
    vec![
        ("empty", vec![]),
        ("one point", vec![Vec3::new(0.1, -0.2, 0.3)]),
        ("two points", vec![Vec3::ZERO, Vec3::Y]),
        ("one point many times", vec![Vec3::splat(0.5); 100]),
        ("every point twice", spread().flat_map(|p| [p, p]).collect()),
        ("line", line(0.1).collect()),
        ("plane", plane().collect()),
        ("huge", spread().map(|p| p * 1e12).collect()),
        ("tiny", spread().map(|p| p * 1e-12).collect()),
        ("denormal", line(1e-42).collect()),
        ("far from the origin", spread().map(|p| p + 1e5).collect()),
        ("negative zero", vec![Vec3::ZERO, -Vec3::ZERO, Vec3::ONE]),
        ("one NaN", with(Vec3::new(0.0, f32::NAN, 0.0))),
        ("all NaN", vec![Vec3::NAN; 20]),
        ("one infinity", with(Vec3::new(f32::INFINITY, 0.0, 0.0))),
    ]
}
