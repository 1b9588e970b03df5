//! Skin, face and hair.

use glam::{Vec2, Vec3};

use super::landmarks::Landmarks;
use crate::film::noise::{smooth_noise, smoothstep};

const SKIN: Vec3 = Vec3::new(0.86, 0.63, 0.50);
const LIPS: Vec3 = Vec3::new(0.66, 0.24, 0.24);
const HAIR: Vec3 = Vec3::new(0.24, 0.14, 0.08);

pub(super) fn hair(landmarks: &Landmarks, q: Vec3) -> Vec3 {
    let p = (q - landmarks.head) / landmarks.face;
    let strand = smooth_noise(Vec3::new(p.x * 130.0, p.y * 25.0, p.z * 60.0));
    let parting = smoothstep(0.006, 0.0, (p.x - 0.022).abs()) * smoothstep(0.0, 0.05, p.z);
    HAIR * (0.65 + 0.8 * strand) * (1.0 - 0.5 * parting)
}

/// Inside an axis-parallel ellipse.
fn ellipse(p: Vec2, centre: Vec2, half: Vec2) -> bool {
    ((p - centre) / half).length_squared() < 1.0
}

pub(super) fn skin(landmarks: &Landmarks, q: Vec3) -> Vec3 {
    let p = (q - landmarks.head) / landmarks.face;
    let tone = SKIN * (0.95 + 0.10 * smooth_noise(q * 30.0));
    if p.y > -0.02 && p.z > 0.045 && p.x.abs() < 0.075 {
        return front(Vec2::new(p.x, p.y), tone);
    }
    if q.x.abs() > landmarks.wrist_x {
        return hand(landmarks, q, tone);
    }
    tone
}

/// The face, `p` seen from the front with the head joint at the origin; figure metres.
fn front(p: Vec2, tone: Vec3) -> Vec3 {
    // The left half mirrors the right, except for the glance.
    let half = Vec2::new(p.x.abs(), p.y);
    let eye = Vec2::new(0.034, 0.098);
    if ellipse(half, eye, Vec2::new(0.019, 0.0105)) {
        let iris = Vec2::new(eye.x * p.x.signum() + 0.003, eye.y);
        return match p.distance(iris) {
            r if r < 0.004 => Vec3::splat(0.03),
            r if r < 0.0095 => Vec3::new(0.16, 0.30, 0.22),
            _ => Vec3::splat(0.95),
        };
    }
    if ellipse(half, eye, Vec2::new(0.023, 0.0145)) {
        return tone * 0.62;
    }
    let brow = 0.127 - 0.35 * (half.x - 0.036).powi(2) / 0.024 - 0.05 * (half.x - 0.036);
    if (0.012..0.062).contains(&half.x) && (p.y - brow).abs() < 0.006 {
        return HAIR * 0.8;
    }
    let smile = 0.034 + 1.2 * p.x * p.x / 0.10;
    if p.x.abs() < 0.030 && (p.y - smile).abs() < 0.0085 - 0.15 * p.x.abs() {
        return LIPS * if (p.y - smile).abs() < 0.0018 { 0.55 } else { 1.0 };
    }
    if ellipse(half, Vec2::new(0.008, 0.054), Vec2::new(0.006, 0.004)) {
        return tone * 0.5;
    }
    let ridge = smoothstep(0.016, 0.009, half.x) * smoothstep(0.11, 0.09, p.y) * smoothstep(0.048, 0.056, p.y);
    let cheek = smoothstep(0.030, 0.0, half.distance(Vec2::new(0.046, 0.062)));
    (tone * (1.0 + 0.08 * ridge)).lerp(Vec3::new(0.88, 0.48, 0.42), 0.45 * cheek)
}

/// Lines between the fingers, and a watch on the left wrist.
fn hand(landmarks: &Landmarks, q: Vec3, tone: Vec3) -> Vec3 {
    let along = q.x.abs() - landmarks.wrist_x;
    if q.x > 0.0 && along < 0.028 {
        return Vec3::splat(0.10);
    }
    let finger = (q.z / 0.021 + 0.25).rem_euclid(1.0);
    if along > 0.095 && finger < 0.16 { tone * 0.72 } else { tone }
}
