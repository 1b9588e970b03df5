//! Mask pixels that the fit does not explain: limbs elsewhere, or masks that show more than the person.

use glam::{Quat, Vec2, Vec3};
use smpl::{BodyModel, BoneNames, Posed};

use super::frame::{Fault, Limb, View};
use crate::scene::labels::squared_distance;

/// Distance of close clothes from the silhouette, and largest distance of clothes and hair, metres.
const CLOSE: f32 = 0.05;
const REACH: f32 = 0.1;
/// Least share of the mask beyond it that is a fault.
const BEYOND: f32 = 0.01;
/// Least share of that which a rotated limb has to explain.
const EXPLAINED: f32 = 0.9;
/// Least share of a limb outside the mask for it to be elsewhere.
const OUTSIDE: f32 = 0.5;
/// Directions that limbs are rotated to, and most vertices and pixels that are compared.
const DIRECTIONS: usize = 48;
const SAMPLES: usize = 96;

/// A limb from one of its joints on.
pub(super) struct Part {
    limb: Limb,
    joint: usize,
    vertices: Vec<usize>,
}

/// The parts of a body's limbs; none where the skeleton is not SMPL's.
pub(super) fn parts(body: &BodyModel) -> Vec<Part> {
    let names = BoneNames::Smpl.of_body(body.parents.len());
    let heaviest: Vec<usize> = (0..body.num_vertices()).map(|v| body.weights.heaviest(v).unwrap_or(0)).collect();
    let part = |limb: Limb, name: &str| {
        let joint = names.iter().position(|other| other == name)?;
        let mut moves = vec![false; names.len()];
        for j in joint..names.len() {
            moves[j] = j == joint || body.parents[j].is_some_and(|parent| moves[parent]);
        }
        let all: Vec<usize> = (0..heaviest.len()).filter(|&v| moves[heaviest[v]]).collect();
        let vertices: Vec<usize> = all.iter().copied().step_by(all.len().div_ceil(SAMPLES).max(1)).collect();
        (!vertices.is_empty()).then_some(Part { limb, joint, vertices })
    };
    Limb::ALL.into_iter().flat_map(|limb| limb.joints().map(|name| part(limb, name))).flatten().collect()
}

/// Share of the mask beyond close clothes of the body's `outline`, and the fault of a frame whose mask reaches farther
/// than clothes do. `metre`: pixels of a metre at the body's depth. A limb is elsewhere if that part of the mask lies
/// where the limb would be, rotated about a joint of its own.
pub(super) fn beyond(view: &View, outline: &[bool], posed: &Posed, parts: &[Part], metre: f32) -> (f32, Option<Fault>) {
    let width = view.camera.width as usize;
    let far = squared_distance(outline, width);
    let beyond = |reach: f32| -> Vec<usize> { (0..far.len()).filter(|&i| view.mask[i] && far[i] > reach).collect() };
    let mask = view.mask.iter().filter(|mask| **mask).count().max(1) as f32;
    let reach = (REACH * metre).powi(2);
    let (close, beyond) = (beyond((CLOSE * metre).powi(2)), beyond(reach));
    let fault = (beyond.len() as f32 > BEYOND * mask).then(|| fault(view, &beyond, posed, parts, reach));
    (close.len() as f32 / mask, fault)
}

fn fault(view: &View, beyond: &[usize], posed: &Posed, parts: &[Part], reach: f32) -> Fault {
    let width = view.camera.width as usize;
    let pixels: Vec<Vec2> = beyond
        .iter()
        .step_by(beyond.len().div_ceil(SAMPLES))
        .map(|i| Vec2::new((i % width) as f32 + 0.5, (i / width) as f32 + 0.5))
        .collect();
    let fit = |part: &Part, turn: Quat| {
        let joint = posed.joints[part.joint];
        let moved = part.vertices.iter().map(|&v| joint + turn * (posed.vertices[v] - joint));
        let at: Vec<Vec2> = moved.filter_map(|vertex| Some(view.camera.project(vertex)?.truncate())).collect();
        let explained = pixels.iter().filter(|pixel| at.iter().any(|at| at.distance_squared(**pixel) < reach)).count();
        let outside = at.iter().filter(|at| !view.shows(**at)).count();
        (explained as f32 / pixels.len() as f32, outside as f32 / at.len().max(1) as f32)
    };
    let mut best: Option<(f32, Limb)> = None;
    for part in parts {
        let joint = posed.joints[part.joint];
        let mean = part.vertices.iter().map(|&v| posed.vertices[v] - joint).sum::<Vec3>().normalize_or(Vec3::Y);
        let (_, outside) = fit(part, Quat::IDENTITY);
        if outside < OUTSIDE {
            continue;
        }
        for direction in (0..DIRECTIONS).map(direction) {
            let (explained, then) = fit(part, Quat::from_rotation_arc(mean, direction));
            let gain = explained + outside - then;
            if explained >= EXPLAINED && best.is_none_or(|(most, _)| gain > most) {
                best = Some((gain, part.limb));
            }
        }
    }
    best.map_or(Fault::Background, |(_, limb)| Fault::Limb(limb))
}

/// Directions of equal density over the sphere (a Fibonacci lattice).
fn direction(i: usize) -> Vec3 {
    let z = 1.0 - (2 * i + 1) as f32 / DIRECTIONS as f32;
    let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
    let radius = (1.0 - z * z).sqrt();
    Vec3::new(radius * cos, radius * sin, z)
}
