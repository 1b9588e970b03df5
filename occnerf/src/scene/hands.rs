//! Hand pixels beside the registered hand.
//!
//! Hands are small and fast, and their poses inaccurate: a hand that is registered a few pixels off
//! would paint the hip behind it.

use glam::{Vec2, Vec3};
use smpl::BodyModel;

use crate::model::view::PosedView;
use crate::scene::seen::ColorObservation;

/// Largest distance from the colour of the hands, mean of the channels.
const REACH: f32 = 0.12;
/// Least observations of a colour.
const ENOUGH: usize = 200;
/// Distance from a hand's vertices, relative to the length of its projection, of pixels that may
/// show it.
const NEAR: f32 = 0.35;
/// SMPL's joints that move hands, and forearms and hands.
const HANDS: std::ops::Range<usize> = 20..24;
const ARMS: std::ops::Range<usize> = 18..24;

/// Whether a vertex with these weights follows `joints` mostly.
fn follows(joints: &std::ops::Range<usize>, weights: impl Iterator<Item = (usize, f32)>) -> bool {
    weights.filter(|(joint, _)| joints.contains(joint)).map(|(_, weight)| weight).sum::<f32>() > 0.5
}

/// Whether the vertex with these weights of joints belongs to a forearm or hand.
pub(crate) fn is_arm(weights: impl Iterator<Item = (usize, f32)>) -> bool {
    follows(&ARMS, weights)
}

/// Colour of the hands.
pub(crate) struct HandColor(Vec3);

impl HandColor {
    /// Median of what `frames` show of the hands; `None` where they show too little, and of a model
    /// without SMPL's joints.
    pub fn measure(model: &BodyModel, frames: &[Vec<(ColorObservation, usize)>]) -> Option<Self> {
        model.wrists()?;
        let is_hand: Vec<bool> = (0..model.num_vertices()).map(|v| follows(&HANDS, model.weights.row(v))).collect();
        let seen = frames.iter().flatten().filter(|((v, ..), _)| is_hand[*v as usize]);
        let colors: Vec<Vec3> = seen.map(|((_, color, _), _)| *color).collect();
        let median = |channel: usize| {
            let mut values: Vec<f32> = colors.iter().map(|color| color[channel]).collect();
            let middle = values.len() / 2;
            *values.select_nth_unstable_by(middle, f32::total_cmp).1
        };
        (colors.len() >= ENOUGH).then(|| Self(Vec3::new(median(0), median(1), median(2))))
    }

    /// Where a frame may show the hands of `model`.
    pub fn in_frame(&self, model: &BodyModel, view: &PosedView) -> HandPixels<'_> {
        HandPixels { color: self, near: near_hands(model, view) }
    }

    fn is_like(&self, color: Vec3) -> bool {
        (color - self.0).abs().element_sum() / 3.0 < REACH
    }
}

/// Where a frame may show hands.
pub(crate) struct HandPixels<'a> {
    color: &'a HandColor,
    /// Pixels near a hand, (H × W).
    near: Vec<bool>,
}

impl HandPixels<'_> {
    /// Whether a pixel of this colour may be a hand's.
    pub fn may_show(&self, pixel: usize, color: Vec3) -> bool {
        self.near.get(pixel) == Some(&true) && self.color.is_like(color)
    }
}

/// Pixels (H × W) near a hand.
fn near_hands(model: &BodyModel, view: &PosedView) -> Vec<bool> {
    let (width, height) = (view.camera.width as i32, view.camera.height as i32);
    let mut near = vec![false; (width * height) as usize];
    for hand in model.hands() {
        let project = |v: usize| view.camera.project(view.posed.vertices[v]).map(Vec3::truncate);
        let places: Vec<Vec2> = hand.iter().filter_map(|(v, _)| project(*v)).collect();
        let low = places.iter().copied().fold(Vec2::INFINITY, Vec2::min);
        let high = places.iter().copied().fold(Vec2::NEG_INFINITY, Vec2::max);
        let reach = NEAR * (high - low).max_element();
        for at in places {
            // Casts saturate.
            let [from, to] = [at - reach, at + reach].map(Vec2::as_ivec2);
            let (left, right) = (from.x.clamp(0, width) as usize, to.x.saturating_add(1).clamp(0, width) as usize);
            for y in from.y.clamp(0, height)..to.y.saturating_add(1).clamp(0, height) {
                let row = (y * width) as usize;
                near[row + left..row + right.max(left)].fill(true);
            }
        }
    }
    near
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Affine3A, Quat};
    use smpl::Placement;
    use volrender::Camera;

    fn view(model: &BodyModel) -> PosedView {
        let posed = model.pose(&model.shaped(&[]), &[Vec3::ZERO; 24], Placement::default());
        let turn = Quat::from_rotation_x(std::f32::consts::PI);
        let world_to_camera = Affine3A::from_rotation_translation(turn, Vec3::new(0.0, 0.0, 3.0));
        let camera =
            Camera { focal: Vec2::splat(150.0), centre: Vec2::splat(64.0), world_to_camera, width: 128, height: 128 };
        PosedView::new(&camera, posed)
    }

    #[test]
    fn pixels_near_hands_are_those_within_a_third_of_their_length() {
        let model = BodyModel::embedded();
        let view = view(&model);
        let near = near_hands(&model, &view);
        let mut expected = vec![false; near.len()];
        for hand in model.hands() {
            let places: Vec<Vec2> =
                hand.iter().map(|(v, _)| view.camera.project(view.posed.vertices[*v]).unwrap().truncate()).collect();
            let length = |axis: usize| {
                let each = || places.iter().map(|at| at[axis]);
                each().fold(f32::MIN, f32::max) - each().fold(f32::MAX, f32::min)
            };
            let reach = NEAR * length(0).max(length(1));
            for (i, expected) in expected.iter_mut().enumerate() {
                let pixel = Vec2::new((i % 128) as f32, (i / 128) as f32);
                *expected |= places
                    .iter()
                    .any(|at| ((at - reach).trunc().cmple(pixel) & pixel.cmple((at + reach).trunc())).all());
            }
        }
        assert_eq!(near, expected);
        let count = near.iter().filter(|near| **near).count();
        assert!((200..2000).contains(&count), "{count}");
    }

    #[test]
    fn the_colour_of_hands_is_their_median_and_none_where_little_is_seen() {
        let model = BodyModel::embedded();
        let [hand, _] = model.hands();
        let skin = Vec3::new(0.7, 0.5, 0.4);
        let frame: Vec<(ColorObservation, usize)> = hand
            .iter()
            .enumerate()
            .map(|(i, (v, _))| ((*v as u32, if i % 3 == 0 { Vec3::ONE } else { skin }, Vec3::Y), 4))
            .collect();
        let found = HandColor::measure(&model, &[frame.clone(), frame.clone()]).unwrap();
        assert!(found.is_like(skin) && found.is_like(skin + 0.05) && !found.is_like(Vec3::ONE));
        assert!(HandColor::measure(&model, &[frame[..50].to_vec()]).is_none());
        let other = BodyModel { parents: vec![None], ..model.clone() };
        assert!(HandColor::measure(&other, &[frame.clone(), frame]).is_none());
    }

    #[test]
    fn forearms_and_hands_are_arms_and_nothing_else() {
        let model = BodyModel::embedded();
        let elbow = model.shaped(&[]).joints[18].x;
        for (v, place) in model.v_template.iter().enumerate() {
            let beyond = place.x.abs() - elbow;
            assert!(beyond.abs() < 0.05 || is_arm(model.weights.row(v)) == (beyond > 0.0), "{place}");
        }
    }
}
