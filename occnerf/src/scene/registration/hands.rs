//! Hands that are fists where the prior's are flat.

use glam::Vec3;
use rayon::prelude::*;
use smpl::BodyModel;

use crate::scene::registration::crop::Crop;

/// Curls that are compared.
const CURLS: [f32; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
/// Share of the finger's vertices that a full curl has to bring into the masks.
const WORTH: f32 = 0.15;
/// A frame shows a hand with this share of the palm's vertices in the mask, and of the flat fingers' beside the
/// rest of the body by more than this many pixels; least such frames.
const SHOWN: f32 = 0.75;
const FREE: f32 = 0.7;
const BESIDE: i32 = 2;
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
            let is_free = free(crop, &posed[0], hand) >= FREE;
            let shown = |vertices: &Vec<Vec3>| is_free && share(vertices, hand, false) >= SHOWN;
            posed.each_ref().map(|vertices| shown(vertices).then(|| 1.0 - share(vertices, hand, true)))
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

/// Share of a hand's fingers whose projections lie beside those of the rest of the body.
fn free(crop: &Crop, vertices: &[Vec3], hand: &[(usize, f32)]) -> f32 {
    let mut rest: Vec<bool> = vec![true; vertices.len()];
    hand.iter().for_each(|&(v, _)| rest[v] = false);
    let (width, height) = (crop.camera.width as usize, crop.camera.height as usize);
    let pixel = |v: usize| crop.camera.project(vertices[v]).and_then(|at| crop.pixel(at.truncate()));
    let mut taken = vec![false; width * height];
    for at in (0..vertices.len()).filter(|&v| rest[v]).filter_map(pixel) {
        for (dx, dy) in (-BESIDE..=BESIDE).flat_map(|dy| (-BESIDE..=BESIDE).map(move |dx| (dx, dy))) {
            let (x, y) = ((at % width) as i32 + dx, (at / width) as i32 + dy);
            if (0..width as i32).contains(&x) && (0..height as i32).contains(&y) {
                taken[y as usize * width + x as usize] = true;
            }
        }
    }
    let fingers = || hand.iter().filter(|(_, along)| *along > 0.0);
    let beside = fingers().filter(|(v, _)| pixel(*v).is_some_and(|at| !taken[at])).count();
    beside as f32 / fingers().count().max(1) as f32
}
