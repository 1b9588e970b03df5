//! Curl of the fingers, which the prior's flat hands lack.

use glam::Vec3;
use rayon::prelude::*;
use smpl::BodyModel;

use crate::scene::registration::observations::Crop;

/// Curls that are compared.
const CURLS: [f32; 3] = [0.0, 0.5, 1.0];
/// Curl of hands that no frames show, and the error of the fingers that a full curl has to gain.
const RELAXED: f32 = 0.5;
const WORTH: f32 = 0.1;
/// A frame shows a hand with this share of the palm's vertices in the mask, and of the flat
/// fingers' beside the rest of the body by more than this many pixels; least such frames.
const SHOWN: f32 = 0.75;
const FREE: f32 = 0.7;
const BESIDE: i32 = 2;
const LEAST_FRAMES: usize = 5;

/// Curl of the fingers of each hand, the same in all frames: flat fingers lie outside the masks of
/// a fist, a fist leaves masks of flat fingers uncovered. A hand that too few frames show is as the
/// other. `posed` gives the vertices of a body in the frame of each of `crops`.
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
    let errors = |f: usize| -> Option<[Option<[f32; CURLS.len()]>; 2]> {
        let crop = crops[f].as_ref()?;
        let posed = bodies.each_ref().map(|body| posed(body, f));
        Some(hands.each_ref().map(|hand| errors(crop, &posed, hand)))
    };
    let frames: Vec<_> = (0..crops.len()).into_par_iter().filter_map(errors).collect();
    let curls = [0, 1].map(|side| {
        let shown: Vec<[f32; CURLS.len()]> = frames.iter().filter_map(|frame| frame[side]).collect();
        let cost = |k: usize| shown.iter().map(|frame| frame[k]).sum::<f32>() / shown.len() as f32 + WORTH * CURLS[k];
        let costs: Vec<f32> = (0..CURLS.len()).map(cost).collect();
        let best = (0..CURLS.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(0);
        (shown.len() >= LEAST_FRAMES).then_some(CURLS[best])
    });
    [0, 1].map(|side: usize| curls[side].or(curls[1 - side]).unwrap_or(RELAXED))
}

/// Error of each curl of a hand in a frame that shows it: the share of its fingers outside the
/// mask, and of the flat ones inside the mask that it leaves uncovered. `posed` has the vertices of
/// each curl's body.
fn errors(crop: &Crop, posed: &[Vec<Vec3>; CURLS.len()], hand: &[(usize, f32)]) -> Option<[f32; CURLS.len()]> {
    let pixel = |vertices: &[Vec3], v: usize| crop.camera.project(vertices[v]).and_then(|at| crop.pixel(at.truncate()));
    let is_masked = |vertices: &[Vec3], v: usize| {
        let at = crop.camera.project(vertices[v]);
        at.and_then(|at| crop.coverage_at(at.truncate())).is_some_and(|coverage| coverage >= 0.5)
    };
    let share = |is_finger: bool, is_in: &dyn Fn(usize) -> bool| {
        let part = || hand.iter().filter(|(_, along)| (*along > 0.0) == is_finger);
        part().filter(|(v, _)| is_in(*v)).count() as f32 / part().count().max(1) as f32
    };
    let [flat, ..] = posed;
    let mut is_rest = vec![true; flat.len()];
    hand.iter().for_each(|&(v, _)| is_rest[v] = false);
    let rest = splat(crop, BESIDE, (0..flat.len()).filter(|&v| is_rest[v]).filter_map(|v| pixel(flat, v)));
    let free = share(true, &|v| pixel(flat, v).is_some_and(|at| !rest[at]));
    if free < FREE || share(false, &|v| is_masked(flat, v)) < SHOWN {
        return None;
    }
    Some(posed.each_ref().map(|vertices| {
        let covered = splat(crop, 1, hand.iter().filter_map(|&(v, _)| pixel(vertices, v)));
        let uncovered = |v| is_masked(flat, v) && pixel(flat, v).is_some_and(|at| !rest[at] && !covered[at]);
        share(true, &|v| !is_masked(vertices, v)) + share(true, &uncovered)
    }))
}

/// Pixels of a crop `within` pixels of some, (H × W).
fn splat(crop: &Crop, within: i32, pixels: impl Iterator<Item = usize>) -> Vec<bool> {
    let (width, height) = (crop.camera.width as usize, crop.camera.height as usize);
    let mut taken = vec![false; width * height];
    for at in pixels {
        for (dx, dy) in (-within..=within).flat_map(|dy| (-within..=within).map(move |dx| (dx, dy))) {
            let (x, y) = ((at % width) as i32 + dx, (at / width) as i32 + dy);
            if (0..width as i32).contains(&x) && (0..height as i32).contains(&y) {
                taken[y as usize * width + x as usize] = true;
            }
        }
    }
    taken
}
