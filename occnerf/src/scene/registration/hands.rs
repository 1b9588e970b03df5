//! Hands that are fists where the prior's are flat.

use glam::Vec3;
use rayon::prelude::*;
use smpl::BodyModel;

use crate::scene::registration::crop::Crop;

/// Curls that are compared.
const CURLS: [f32; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
/// Share of the finger's vertices that a full curl has to bring into the masks.
const WORTH: f32 = 0.1;
/// Share of the palm's vertices in the mask from which a frame shows a hand, and least such frames.
const SHOWN: f32 = 0.9;
const LEAST_FRAMES: usize = 5;

/// How far the masks say that the fingers of each hand are rolled up, the same in all frames: flat fingers
/// lie outside the masks of a fist. `posed` gives the vertices of a body in the frame of each of `crops`.
pub(super) fn curls(
    model: &BodyModel,
    crops: &[Option<Crop>],
    posed: impl Fn(&BodyModel, usize) -> Vec<Vec3> + Sync,
) -> [f32; 2] {
    let hands = model.hands();
    if hands.iter().any(Vec::is_empty) {
        return [0.0; 2];
    }
    let bodies = CURLS.map(|curl| model.with_fists([curl; 2]));
    // Share of the fingers outside the mask, of each hand and curl.
    let outside = |f: usize| -> Option<[[Option<f32>; CURLS.len()]; 2]> {
        let crop = crops[f].as_ref()?;
        let posed = bodies.each_ref().map(|body| posed(body, f));
        let share = |vertices: &[Vec3], hand: &[(usize, f32)], is_finger: bool| {
            let part = || hand.iter().filter(|(_, along)| (*along > 0.0) == is_finger);
            let covered = |&&(v, _): &&(usize, f32)| {
                let at = crop.camera.project(vertices[v]).and_then(|at| crop.coverage_at(at.truncate()));
                at.is_some_and(|coverage| coverage >= 0.5)
            };
            part().filter(covered).count() as f32 / part().count().max(1) as f32
        };
        Some(hands.each_ref().map(|hand| {
            posed
                .each_ref()
                .map(|vertices| (share(vertices, hand, false) >= SHOWN).then(|| 1.0 - share(vertices, hand, true)))
        }))
    };
    let frames: Vec<_> = (0..crops.len()).into_par_iter().filter_map(outside).collect();
    [0, 1].map(|side| {
        let cost = |k: usize| -> f32 {
            let shown: Vec<f32> = frames.iter().filter_map(|frame| frame[side][k]).collect();
            if shown.len() < LEAST_FRAMES {
                return f32::INFINITY;
            }
            shown.iter().sum::<f32>() / shown.len() as f32 + WORTH * CURLS[k]
        };
        let costs: Vec<f32> = (0..CURLS.len()).map(cost).collect();
        let best = (0..CURLS.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
        CURLS[best]
    })
}
