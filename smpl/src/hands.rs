//! Fists of a body whose hands are flat at rest and have no finger joints.

use glam::Vec3;

use crate::model::BodyModel;

/// SMPL's number of joints, and its wrists and hands, left and right.
const JOINTS: usize = 24;
const WRISTS: [usize; 2] = [20, 21];
const HANDS: [usize; 2] = [22, 23];
/// Radius about which the fingers of a fist roll, relative to the distance from wrist to hand.
const RADIUS: f32 = 0.2;
/// Distance of the palm's front edge, where the thumb begins, from the middle of the hand.
const EDGE: f32 = 0.45;
/// Share of their distance from the hand's middle by which the fingers of a fist close up, and
/// where beyond the knuckles they do in full.
const CLOSED: f32 = 0.3;
const SPREAD: f32 = 0.3;
/// Distance beyond the knuckles from which drooping fingers are kept outside the axis of the roll.
const KNUCKLES: f32 = 0.1;

impl BodyModel {
    /// Joints of the left and right wrist; none of a body without SMPL's joints.
    #[must_use]
    pub fn wrists(&self) -> Option<[usize; 2]> {
        (self.num_joints() == JOINTS).then_some(WRISTS)
    }

    /// Vertices of the left and of the right hand with their distances beyond the knuckles along
    /// the fingers, or beyond the palm's edge along the thumb, relative to that from wrist to hand;
    /// negative on the palm. None of a body without SMPL's joints.
    #[must_use]
    pub fn hands(&self) -> [Vec<(usize, f32)>; 2] {
        let along = |(v, along, thumb): (usize, f32, f32)| (v, if thumb > 0.0 { thumb } else { along });
        self.fingers().map(|hand| hand.into_iter().map(along).collect())
    }

    /// Vertices of each hand, distances beyond the knuckles, and of the thumb beyond the palm's
    /// edge.
    fn fingers(&self) -> [Vec<(usize, f32, f32)>; 2] {
        if self.num_joints() != JOINTS {
            return Default::default();
        }
        let joints = self.shaped(&[]).joints;
        [0, 1].map(|side| {
            let (knuckles, palm) = (joints[HANDS[side]], joints[HANDS[side]] - joints[WRISTS[side]]);
            let aside = Vec3::Z.reject_from(palm).normalize_or(Vec3::Z);
            let place = |v: usize| {
                let (way, length) = (self.v_template[v] - knuckles, palm.length());
                let along = way.dot(palm) / (length * length);
                (v, along, if along > 0.0 { 0.0 } else { (way.dot(aside) / length - EDGE).max(0.0) })
            };
            let of_hand = |(joint, weight): (usize, f32)| {
                if joint == WRISTS[side] || joint == HANDS[side] { weight } else { 0.0 }
            };
            let is_hand = |v: &usize| self.weights.row(*v).map(of_hand).sum::<f32>() > 0.5;
            (0..self.num_vertices()).filter(is_hand).map(place).filter(|(_, along, _)| *along > -1.0).collect()
        })
    }

    /// The body with the fingers and thumb of its left and right hand rolled up, by 0 (flat, as
    /// they are) to 1 (a fist). The palms of the rest pose look down, as SMPL's do.
    ///
    /// ```
    /// let body = smpl::BodyModel::embedded();
    /// let fist = body.with_fists([1.0, 0.0]);
    /// let reach = |body: &smpl::BodyModel| body.v_template.iter().map(|v| v.x).fold(0.0, f32::max);
    /// assert!(reach(&fist) < reach(&body) - 0.04);
    /// ```
    #[must_use]
    pub fn with_fists(&self, curls: [f32; 2]) -> Self {
        let mut body = self.clone();
        let joints = self.shaped(&[]).joints;
        let is_fist = |(side, hand): &(usize, Vec<_>)| curls[*side] > 0.0 && !hand.is_empty();
        for (side, vertices) in self.fingers().into_iter().enumerate().filter(is_fist) {
            let palm = joints[HANDS[side]] - joints[WRISTS[side]];
            let (fingers, length) = (palm.normalize_or(Vec3::X), palm.length());
            let aside = Vec3::Z.reject_from_normalized(fingers).normalize_or(Vec3::Z);
            let up = Vec3::Y.reject_from_normalized(fingers).normalize_or(Vec3::Y);
            let radius = RADIUS * length / curls[side];
            // The thumb rolls about the fingers' direction, the fingers about the thumb's.
            for (v, along, thumb) in vertices.into_iter().filter(|(_, along, thumb)| *along > 0.0 || *thumb > 0.0) {
                let (relative, onward) = if thumb > 0.0 { (thumb, aside) } else { (along, fingers) };
                let (along, way) = (relative * length, body.v_template[v] - joints[HANDS[side]]);
                let (angle, height) = (along / radius, way.dot(up));
                // Drooping fingers stay outside the axis, or they would be inside out.
                let outside = radius * ((height.min(0.0) / radius).exp() - 1.0) - height.min(0.0);
                let from_axis = radius + height + (relative / KNUCKLES).min(1.0) * outside;
                let (x, y) = (from_axis * angle.sin() - along, from_axis * angle.cos() - radius - height);
                let closer = if thumb > 0.0 { 0.0 } else { CLOSED * curls[side] * (relative / SPREAD).min(1.0) };
                body.v_template[v] += x * onward + y * up - closer * way.dot(aside) * aside;
            }
        }
        body
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Fingers roll without stretching: edges near the roll's middle line keep their lengths.
        #[test]
        fn fists_move_fingers_alone_and_do_not_tear_them(left in 0.0f32..1.0, right in 0.0f32..1.0) {
            let body = BodyModel::embedded();
            let fist = body.with_fists([left, right]);
            let mut fingers = vec![None; body.num_vertices()];
            for (hand, curl) in body.hands().into_iter().zip([left, right]) {
                hand.into_iter().filter(|(_, along)| *along > 0.0).for_each(|(v, _)| fingers[v] = Some(curl));
            }
            for (v, (a, b)) in body.v_template.iter().zip(&fist.v_template).enumerate() {
                prop_assert!(fingers[v].is_some_and(|curl| curl > 0.0) || a == b);
            }
            for &[a, b, _] in body.faces.iter().filter(|face| face.iter().any(|v| fingers[*v as usize].is_some())) {
                let length = |body: &BodyModel| body.v_template[a as usize].distance(body.v_template[b as usize]);
                prop_assert!(length(&fist) < 2.5 * length(&body) + 1e-4, "{a} {b}");
            }
        }
    }

    #[test]
    fn a_body_without_smpls_joints_has_no_hands() {
        let body = BodyModel::embedded();
        assert!(body.hands().iter().all(|hand| hand.len() > 100));
        let head =
            BodyModel { parents: vec![None], j_regressor: crate::SparseRows::from_rows([[(0, 1.0)]]), ..body.clone() };
        assert!(head.hands().iter().all(Vec::is_empty));
        assert_eq!(head.with_fists([1.0; 2]).v_template, body.v_template);
    }
}
