//! Colours of the person as a function of the place on the body.

use glam::{Vec2, Vec3};

use super::clothes::Garment;
use super::face;
use super::landmarks::Landmarks;
use crate::film::noise::{smooth_noise, smoothstep};
use volrender::RandomStream;

const TEAL: Vec3 = Vec3::new(0.07, 0.40, 0.47);
const CREAM: Vec3 = Vec3::new(0.94, 0.90, 0.78);
const CORAL: Vec3 = Vec3::new(0.88, 0.30, 0.22);
const YELLOW: Vec3 = Vec3::new(0.97, 0.79, 0.18);
const NAVY: Vec3 = Vec3::new(0.07, 0.09, 0.22);
const DENIM: Vec3 = Vec3::new(0.22, 0.32, 0.55);
const LEATHER: Vec3 = Vec3::new(0.25, 0.13, 0.07);
const BRASS: Vec3 = Vec3::new(0.90, 0.78, 0.42);
const WHITE: Vec3 = Vec3::new(0.93, 0.93, 0.91);

/// What a person wears.
#[derive(Clone, Copy, Debug)]
pub(super) struct Dress {
    /// Height of a stripe with its neighbours, metres, and the rise of stripes outward.
    period: f32,
    slant: f32,
    /// The channels that red, green and blue are taken from.
    dye: [usize; 3],
}

impl Dress {
    /// The usual one with seed 0.
    pub fn new(seed: u64) -> Self {
        if seed == 0 {
            return Self { period: 0.064, slant: 0.0, dye: [0, 1, 2] };
        }
        const DYES: [[usize; 3]; 5] = [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
        let mut stream = RandomStream::new(&[seed, 0x6472_6573]);
        let (period, slant) = (0.04 + 0.06 * stream.uniform(), 2.0 * stream.uniform() - 1.0);
        Self { period, slant, dye: DYES[(5.0 * stream.uniform()) as usize % 5] }
    }

    fn dyed(&self, color: Vec3) -> Vec3 {
        Vec3::from_array(self.dye.map(|channel| color[channel]))
    }
}

/// The unlit colour at `rest`, a point of the body (not of the clothes above it) in the rest pose.
pub(super) fn albedo(landmarks: &Landmarks, dress: &Dress, rest: Vec3) -> Vec3 {
    let q = landmarks.figure(rest);
    let (garment, below_hem) = landmarks.garment(q);
    let color = match garment {
        Garment::Hair => face::hair(landmarks, q),
        Garment::Shirt => dress.dyed(shirt(landmarks, dress, q)),
        Garment::Belt => dress.dyed(belt(q)),
        Garment::Trousers => dress.dyed(trousers(landmarks, q)),
        Garment::Shoe => dress.dyed(shoe(landmarks, q)),
        Garment::Sock => WHITE * 0.9,
        Garment::Skin => face::skin(landmarks, q),
    };
    let shade = 1.0 - 0.35 * smoothstep(0.022, 0.0, below_hem);
    color * shade
}

/// Cloth is never of quite one colour.
fn mottled(color: Vec3, q: Vec3, scale: f32, amount: f32) -> Vec3 {
    color * (1.0 + amount * (2.0 * smooth_noise(q * scale) - 1.0))
}

fn shirt(landmarks: &Landmarks, dress: &Dress, q: Vec3) -> Vec3 {
    let ax = q.x.abs();
    let chest = landmarks.chest;
    let seam = landmarks.shoulder_x + 0.012 - 0.18 * (q.y - landmarks.neck.y + 0.04);
    let on_sleeve = ax > seam && q.y > chest.y + 0.05;
    if landmarks.shirt_inside(q) < 0.014 {
        return CORAL * 0.85;
    }
    let front = q.z > chest.z;
    if !on_sleeve {
        if front && let Some(color) = logo(Vec2::new(q.x, q.y - chest.y - 0.085)) {
            return color;
        }
        if !front && let Some(color) = back_print(Vec2::new(-q.x, q.y - chest.y - 0.045)) {
            return color;
        }
    }
    let along = if on_sleeve { ax - seam } else { q.y - chest.y + dress.slant * ax };
    let stripe = (along / dress.period).rem_euclid(1.0);
    let color = match stripe {
        s if s < 0.42 => TEAL,
        s if s < 0.56 => CORAL,
        _ => CREAM,
    };
    let stitched = (ax - seam).abs() < 0.004 && q.y > chest.y + 0.05;
    mottled(if stitched { NAVY } else { color }, q, 35.0, 0.06)
}

/// A star on a disc, `None` outside it.
fn logo(p: Vec2) -> Option<Vec3> {
    let r = p.length();
    if r > 0.068 {
        return None;
    }
    if r > 0.058 {
        return Some(NAVY);
    }
    // Five points: fold the angle into one tenth of a turn and compare with the edge's line.
    let sector = std::f32::consts::TAU / 5.0;
    let angle = (p.x.atan2(p.y)).rem_euclid(sector);
    let angle = angle.min(sector - angle);
    let (tip, notch) = (0.050, 0.021);
    let at = Vec2::new(r * angle.cos(), r * angle.sin());
    let (a, b) = (Vec2::new(tip, 0.0), Vec2::new(notch * (sector / 2.0).cos(), notch * (sector / 2.0).sin()));
    let inside = (b - a).perp_dot(at - a) > 0.0;
    Some(if inside { CORAL } else { YELLOW })
}

/// The number 38 on a panel, `p` as read from behind; `None` outside the panel.
fn back_print(p: Vec2) -> Option<Vec3> {
    let (half, border) = (Vec2::new(0.098, 0.085), 0.008);
    let edge = half - p.abs();
    if edge.min_element() < 0.0 {
        return None;
    }
    if edge.min_element() < border {
        return Some(CREAM);
    }
    // Seven segments a digit: top, upper left, upper right, middle, lower left, lower right,
    // bottom.
    let digit = |p: Vec2, segments: [bool; 7]| {
        let (w, h, thick) = (0.025, 0.056, 0.009);
        let horizontal = |y: f32| (p.y - y).abs() < thick && p.x.abs() < w + thick;
        let vertical = |x: f32, y: f32| (p.x - x).abs() < thick && (p.y - y).abs() < h / 2.0 + thick;
        let lit = [
            horizontal(h),
            vertical(-w, h / 2.0),
            vertical(w, h / 2.0),
            horizontal(0.0),
            vertical(-w, -h / 2.0),
            vertical(w, -h / 2.0),
            horizontal(-h),
        ];
        lit.iter().zip(segments).any(|(lit, on)| *lit && on)
    };
    let three = digit(p + Vec2::X * 0.045, [true, false, true, true, false, true, true]);
    let eight = digit(p - Vec2::X * 0.045, [true; 7]);
    Some(if three || eight { YELLOW } else { NAVY })
}

fn belt(q: Vec3) -> Vec3 {
    let buckle = q.z > 0.0 && q.x.abs() < 0.026;
    if buckle {
        return if q.x.abs() < 0.013 { LEATHER * 0.6 } else { BRASS };
    }
    LEATHER
}

fn trousers(landmarks: &Landmarks, q: Vec3) -> Vec3 {
    let ax = q.x.abs();
    let down = ((landmarks.hip.y - q.y) / (landmarks.hip.y - landmarks.ankle.y)).clamp(0.0, 1.0);
    let axis = landmarks.hip.lerp(landmarks.ankle, down);
    if landmarks.turn_up(q) < 0.036 {
        return mottled(DENIM * 1.75, q, 45.0, 0.10);
    }
    let outer = ax > axis.x + 0.02;
    if outer && (q.z - axis.z).abs() < 0.013 {
        return if (q.z - axis.z).abs() < 0.005 { CORAL } else { YELLOW };
    }
    // Slanted front pockets and square back pockets.
    let hip = Vec2::new(ax, q.y - landmarks.hip.y);
    let slant = hip.y - 0.03 + 0.9 * (ax - 0.125);
    if q.z > axis.z && hip.y > -0.06 && ax > 0.07 && slant.abs() < 0.006 {
        return YELLOW * 0.8;
    }
    let pocket = ((ax - 0.085).abs() - 0.048).max((hip.y + 0.01).abs() - 0.055);
    if q.z < axis.z && pocket.abs() < 0.005 {
        return YELLOW * 0.8;
    }
    if q.z < axis.z && pocket < 0.0 {
        return mottled(DENIM * 0.72, q, 45.0, 0.10);
    }
    let knee = smoothstep(0.16, 0.0, (q.y - landmarks.knee.y).abs());
    let worn = if q.z > axis.z { 0.35 * knee } else { 0.0 };
    let fly = q.z > 0.0 && ax < 0.004 && hip.y > -0.02;
    let color = DENIM.lerp(Vec3::new(0.55, 0.65, 0.80), worn) * if fly { 0.6 } else { 1.0 };
    mottled(color, q, 45.0, 0.12)
}

fn shoe(landmarks: &Landmarks, q: Vec3) -> Vec3 {
    let forward = q.z - landmarks.ankle.z;
    if q.y < landmarks.sole_top() {
        return WHITE;
    }
    if forward > 0.155 {
        return WHITE * 0.95;
    }
    let middle = (q.x.abs() - landmarks.ankle.x - 0.05 * forward).abs() < 0.024;
    if forward > 0.045 && middle {
        let lace = (forward / 0.026).rem_euclid(1.0) < 0.45;
        return if lace { WHITE } else { NAVY };
    }
    // A swoosh along both sides.
    let swoosh = (q.y - landmarks.sole_top() - 0.022 - 0.12 * (forward - 0.02)).abs() < 0.007;
    if swoosh && forward > -0.04 { YELLOW } else { CORAL * 0.9 }
}
