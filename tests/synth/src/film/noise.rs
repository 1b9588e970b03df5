//! Interpolation curves and repeatable noise.

use glam::Vec3;

/// Hermite step from 0 at `from` to 1 at `to`, which may be the smaller one.
pub(crate) fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A number in [0, 1) for a lattice point.
fn lattice(x: i32, y: i32, z: i32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x8DA6_B343)
        ^ (y as u32).wrapping_mul(0xD816_3841)
        ^ (z as u32).wrapping_mul(0xCB1A_B31F);
    h = (h ^ h >> 15).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ h >> 12).wrapping_mul(0x297A_2D39);
    ((h ^ h >> 15) >> 8) as f32 / 16_777_216.0
}

/// Value noise in [0, 1) that varies over a distance of one.
pub(crate) fn smooth_noise(p: Vec3) -> f32 {
    let cell = p.floor();
    let [x, y, z] = cell.to_array().map(|c| c as i32);
    let f = p - cell;
    let t = f * f * (Vec3::splat(3.0) - 2.0 * f);
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let along_x = |dy: i32, dz: i32| mix(lattice(x, y + dy, z + dz), lattice(x + 1, y + dy, z + dz), t.x);
    mix(mix(along_x(0, 0), along_x(1, 0), t.y), mix(along_x(0, 1), along_x(1, 1), t.y), t.z)
}
