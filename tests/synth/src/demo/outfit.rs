//! What hangs free of the body: a skirt and long hair, which no displacement of the body's surface
//! along its normals can show.

use std::f32::consts::{PI, TAU};

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::landmarks::{Landmarks, joint};
use crate::film::noise::smoothstep;

/// What the person of the demo wears over its clothes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outfit {
    /// Nothing more.
    #[default]
    Plain,
    /// A tube from the waist to the knees that follows pelvis and thighs.
    Skirt,
    /// Loose strands from the back of the head to the shoulder blades.
    LongHair,
}

/// Vertices and joint weights of a sheet at rest, figure metres.
#[derive(Default)]
pub(super) struct Sheet {
    pub places: Vec<Vec3>,
    pub weights: Vec<Vec<(u32, f32)>>,
    pub faces: Vec<[u32; 3]>,
}

/// Quadrilaterals of a skirt around and down; strands of the hair, and their quadrilaterals.
const SKIRT: [usize; 2] = [64, 20];
const STRANDS: usize = 110;
const SEGMENTS: usize = 10;
/// Width of a strand, metres.
const STRAND: f32 = 0.007;

impl Sheet {
    /// The sheets of an outfit, (V) and (F), none of a plain one.
    pub fn new(outfit: Outfit, landmarks: &Landmarks) -> Self {
        let mut sheet = Self::default();
        match outfit {
            Outfit::Plain => {}
            Outfit::Skirt => {
                let place = |u: f32, v: f32| skirt(landmarks, u, v);
                sheet.add(SKIRT, &place);
            }
            Outfit::LongHair => {
                for strand in 0..STRANDS {
                    let place = |u: f32, v: f32| hair(landmarks, strand, u, v);
                    sheet.add([1, SEGMENTS], &place);
                }
            }
        }
        sheet
    }

    /// Adds `across` × `down` quadrilaterals over the unit square.
    fn add(&mut self, [across, down]: [usize; 2], place: &dyn Fn(f32, f32) -> (Vec3, Vec<(u32, f32)>)) {
        let first = self.places.len() as u32;
        let row = across as u32 + 1;
        for j in 0..=down {
            for i in 0..=across {
                let (at, weights) = place(i as f32 / across as f32, j as f32 / down as f32);
                self.places.push(at);
                self.weights.push(weights);
            }
        }
        for j in 0..down as u32 {
            for i in 0..across as u32 {
                let a = first + j * row + i;
                self.faces.extend([[a, a + row, a + 1], [a + 1, a + row, a + row + 1]]);
            }
        }
    }
}

/// A point of the skirt, `u` around and `v` down, and its weights.
fn skirt(landmarks: &Landmarks, u: f32, v: f32) -> (Vec3, Vec<(u32, f32)>) {
    let angle = TAU * u;
    let (top, bottom) = (0.06, landmarks.knee.y - 0.02);
    let flare = v.powf(0.6);
    let fold = 1.0 + 0.06 * v * (9.0 * angle).sin();
    let (wide, deep) = (0.165 + 0.165 * flare, 0.13 + 0.21 * flare);
    let at = Vec3::new(wide * fold * angle.sin(), top + v * (bottom - top), deep * fold * angle.cos());
    let thighs = 0.9 * v.sqrt() * v;
    let left = smoothstep(-0.12, 0.12, at.x);
    let weights = vec![
        (joint::PELVIS as u32, 1.0 - thighs),
        (joint::LEFT_HIP as u32, thighs * left),
        (joint::RIGHT_HIP as u32, thighs * (1.0 - left)),
    ];
    (at, weights)
}

/// A point of a strand, `u` across and `v` down, and its weights.
fn hair(landmarks: &Landmarks, strand: usize, u: f32, v: f32) -> (Vec3, Vec<(u32, f32)>) {
    // The golden ratio spreads lengths and distances evenly over neighbouring strands.
    let vary = (strand as f32 * 0.618_034).fract();
    let angle = 0.65 * PI * (2.0 * (strand as f32 + 0.5) / STRANDS as f32 - 1.0) + PI;
    let out = Vec3::new(angle.sin(), 0.0, angle.cos());
    let along = Vec3::new(out.z, 0.0, -out.x);
    let (top, length) = (0.13 * landmarks.face, 0.34 + 0.12 * vary);
    let radius = landmarks.face * 0.085 + (0.02 + 0.03 * vary) * (3.0 * v).min(1.0) + 0.05 * v * v;
    let wave = 0.006 * (14.0 * v + TAU * vary).sin();
    let at = landmarks.head
        + radius * out
        + ((u - 0.5) * STRAND + wave) * along
        + Vec3::new(0.0, top - v * length, -0.01 - 0.03 * v);
    let down = smoothstep(0.35, 0.9, v);
    (at, vec![(joint::HEAD as u32, 1.0 - down), (joint::SPINE[2] as u32, down)])
}

/// The unlit colour of a sheet at a point of its rest pose, figure metres.
pub(super) fn color(outfit: Outfit, q: Vec3) -> Vec3 {
    let angle = q.x.atan2(q.z);
    match outfit {
        Outfit::LongHair => Vec3::new(0.30, 0.17, 0.08) * (0.75 + 0.35 * (160.0 * angle).sin().abs()),
        Outfit::Plain | Outfit::Skirt => {
            let bands = smoothstep(-0.3, 0.3, (48.0 * q.y).sin());
            let pleats = 0.85 + 0.15 * (9.0 * angle).sin();
            pleats * Vec3::new(0.72, 0.16, 0.24).lerp(Vec3::new(0.93, 0.82, 0.55), bands)
        }
    }
}
