//! Points of a body that measurements correspond to.

use glam::Vec3;
use smpl::BodyModel;

/// A point of a body: a weighted sum of its joints and vertices, weights summing to 1.
///
/// ```
/// use point_fit::Anchor;
/// let middle = Anchor { joints: vec![(1, 0.5), (2, 0.5)], ..Anchor::default() }; // of the hips
/// let marker = Anchor { vertices: vec![(4000, 1.0)], ..Anchor::default() };
/// assert!(middle != marker && Anchor::joint(1).joints == [(1, 1.0)]);
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Anchor {
    /// Joints and weights.
    pub joints: Vec<(usize, f32)>,
    /// Vertices and weights.
    pub vertices: Vec<(usize, f32)>,
}

impl Anchor {
    /// A joint.
    #[must_use]
    pub fn joint(joint: usize) -> Self {
        Self { joints: vec![(joint, 1.0)], vertices: Vec::new() }
    }

    /// The template's vertex farthest in `direction` of those that `joint` and its descendants move
    /// most, the first of equals; vertex 0 of a body where they move none.
    fn farthest(body: &BodyModel, joint: usize, direction: Vec3) -> Self {
        let mut below = vec![false; body.num_joints()];
        for (j, parent) in body.parents.iter().enumerate() {
            below[j] = j == joint || parent.is_some_and(|p| below[p]);
        }
        let moved = |v: &usize| body.weights.row(*v).filter(|(j, _)| below[*j]).map(|(_, w)| w).sum::<f32>() > 0.5;
        let along = |v: &usize| body.v_template[*v].dot(direction);
        let found = (0..body.num_vertices()).filter(moved).min_by(|a, b| along(b).total_cmp(&along(a)));
        Self { joints: Vec::new(), vertices: vec![(found.unwrap_or(0), 1.0)] }
    }
}

/// Name, joint, and for a vertex the direction in which it is the farthest.
const LANDMARKS: [(&str, usize, [f32; 3]); 20] = [
    ("nose", 15, [0.0, 0.0, 1.0]),
    ("head", 15, [0.0, 1.0, 0.0]),
    ("lear", 15, [1.0, 0.0, 0.0]),
    ("rear", 15, [-1.0, 0.0, 0.0]),
    ("lheel", 7, [0.0, -0.3, -1.0]),
    ("rheel", 8, [0.0, -0.3, -1.0]),
    ("ltoe", 10, [-0.3, 0.0, 1.0]),
    ("rtoe", 11, [0.3, 0.0, 1.0]),
    ("lsmall", 10, [0.8, 0.0, 0.6]),
    ("rsmall", 11, [-0.8, 0.0, 0.6]),
    ("lthumb", 20, [0.5, 0.0, 1.0]),
    ("rthumb", 21, [-0.5, 0.0, 1.0]),
    ("lfinger", 20, [1.0, 0.0, 0.0]),
    ("rfinger", 21, [-1.0, 0.0, 0.0]),
    ("lfore", 27, [1.0, 0.0, 0.0]),
    ("rfore", 42, [-1.0, 0.0, 0.0]),
    ("lring", 36, [1.0, 0.0, 0.0]),
    ("rring", 51, [-1.0, 0.0, 0.0]),
    ("lpinky", 33, [1.0, 0.0, 0.0]),
    ("rpinky", 48, [-1.0, 0.0, 0.0]),
];

/// Name, joint, and where at rest from the joint, in metres, the vertex is the nearest.
const NEAR: [(&str, usize, [f32; 3]); 4] = [
    ("lelbow-back", 18, [0.0, 0.0, -0.05]),
    ("relbow-back", 19, [0.0, 0.0, -0.05]),
    ("lelbow-front", 18, [0.0, 0.0, 0.05]),
    ("relbow-front", 19, [0.0, 0.0, 0.05]),
];

/// Distance of SAM 3D Body's hips in thigh lengths (0.32 to 0.37 in four people).
const HIPS: f32 = 0.35;

/// Names of joint sets, and their points in order: landmarks, numbers of SMPL's joints, means of
/// two joints (`16+17`), points an eighth of the way from one joint to another (`20>22`), and `-`
/// for points without a place on the body; joints from 24 are SMPL-X's fingers.
const SETS: [(&str, &str); 5] = [
    ("coco17", "nose - - lear rear 16 17 18 19 20 21 1 2 4 5 7 8"),
    ("openpose25", "nose 16+17 17 19 21 16 18 20 1+2 2 5 8 1 4 7 - - rear lear ltoe lsmall lheel rtoe rsmall rheel"),
    ("smpl24", "0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23"),
    ("h36m17", "1+2 2 5 8 1 4 7 6 12 - head 16 18 20 17 19 21"),
    (
        "mhr70",
        "nose - - lear rear 16 17 18 19 lhip rhip 4 5 7 8 ltoe lsmall lheel rtoe rsmall rheel \
         rthumb 54 53 52 rfore 42 41 40 rfinger 45 44 23>21 rring 51 50 49 rpinky 48 47 46 21>23 \
         lthumb 39 38 37 lfore 27 26 25 lfinger 30 29 22>20 lring 36 35 34 lpinky 33 32 31 20>22 \
         lelbow-back relbow-back lelbow-front relbow-front - - 12",
    ),
];

/// Names of the sets of [`joint_set`].
#[must_use]
pub fn joint_sets() -> [&'static str; SETS.len()] {
    SETS.map(|(name, _)| name)
}

/// The points of a joint set in its order, on a body with SMPL's first 24 joints; `None` for points
/// that the body does not have. `None` for an unknown name or a body with fewer joints.
///
/// - `coco17`: COCO's key points (also ViTPose, RTMPose);
/// - `openpose25`: OpenPose's BODY_25;
/// - `smpl24`: SMPL's joints;
/// - `h36m17`: Human3.6M's, the hips' middle first;
/// - `mhr70`: SAM 3D Body's, with feet and hands; fingers joint by joint on bodies with SMPL-X's.
///
/// ```
/// let body = smpl::BodyModel::embedded();
/// let set = point_fit::joint_set(&body, "coco17").unwrap();
/// assert_eq!(set.len(), 17);
/// assert_eq!(set[5], Some(point_fit::Anchor::joint(16))); // left shoulder
/// ```
#[must_use]
pub fn joint_set(body: &BodyModel, name: &str) -> Option<Vec<Option<Anchor>>> {
    let (_, points) = SETS.iter().find(|(set, _)| *set == name).filter(|_| body.num_joints() >= 24)?;
    let joints = body.shaped(&[]).joints;
    let anchor = |point: &str| {
        if let Some((_, joint, direction)) = LANDMARKS.iter().find(|(landmark, ..)| *landmark == point) {
            let farthest = || Anchor::farthest(body, *joint, Vec3::from_array(*direction));
            return (*joint < body.num_joints()).then(farthest);
        }
        if let Some((_, joint, offset)) = NEAR.iter().find(|(landmark, ..)| *landmark == point) {
            let place = joints[*joint] + Vec3::from_array(*offset);
            let off = |v: &usize| body.v_template[*v].distance_squared(place);
            let nearest = (0..body.num_vertices()).min_by(|a, b| off(a).total_cmp(&off(b)));
            return Some(Anchor { vertices: vec![(nearest.unwrap_or(0), 1.0)], ..Anchor::default() });
        }
        if let "lhip" | "rhip" = point {
            let apart = HIPS * joints[1].distance(joints[4]) / joints[1].distance(joints[2]).max(f32::EPSILON);
            let [own, other] = if point == "lhip" { [1, 2] } else { [2, 1] };
            // In 256ths the weights sum to 1 exactly.
            let weight = (128.0 * (1.0 + apart)).round() / 256.0;
            let joints = vec![(own, weight), (other, 1.0 - weight)];
            return Some(Anchor { joints, ..Anchor::default() });
        }
        // The hands of SMPL-X end in fingers, whose middle ones begin where SMPL's hands do.
        let joint = |name: &str| match (name.parse().ok()?, body.num_joints()) {
            (22, 55) => Some(28),
            (23, 55) => Some(43),
            (joint, count) => (joint < count).then_some(joint),
        };
        let joints = match point.split_once('>') {
            Some((from, to)) => vec![(joint(from)?, 0.875), (joint(to)?, 0.125)],
            None => {
                let all: Vec<usize> = point.split('+').map(joint).collect::<Option<_>>()?;
                let weight = 1.0 / all.len() as f32;
                all.into_iter().map(|joint| (joint, weight)).collect()
            }
        };
        Some(Anchor { joints, vertices: Vec::new() })
    };
    Some(points.split_whitespace().map(anchor).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_have_the_counts_of_their_names_and_landmarks_lie_where_they_should() {
        let body = BodyModel::embedded();
        let rest = body.shaped(&[]);
        let at = |anchor: &Anchor| {
            let joints = anchor.joints.iter().map(|(j, w)| *w * rest.joints[*j]);
            joints.chain(anchor.vertices.iter().map(|(v, w)| *w * rest.vertices[*v])).sum::<Vec3>()
        };
        for name in joint_sets() {
            let set = joint_set(&body, name).unwrap();
            let count: usize = name.trim_start_matches(char::is_alphabetic).trim_start_matches("36m").parse().unwrap();
            assert_eq!(set.len(), count, "{name}");
        }
        let set: Vec<_> = joint_set(&body, "mhr70").unwrap().iter().map(|a| a.as_ref().map(at)).collect();
        let [nose, ear, ankle, toe, heel, elbow] = [0, 3, 13, 15, 17, 7].map(|i| set[i].unwrap());
        assert!(nose.x.abs() < 0.01 && nose.z > ear.z + 0.06 && (nose.y - ear.y).abs() < 0.06);
        assert!(toe.z > ankle.z + 0.1 && heel.z < ankle.z && heel.y < ankle.y && heel.x > 0.0);
        assert!(elbow.x > 0.3);
        // Olecranon and cubital fossa lie behind and before the elbow.
        let [back, front, hips] = [[63, 7], [65, 7], [9, 10]].map(|[a, b]| set[a].unwrap() - set[b].unwrap());
        assert!(back.z < -0.02 && front.z > 0.02 && [back, front].iter().all(|v| v.length() < 0.06));
        let thigh = rest.joints[1].distance(rest.joints[4]);
        assert!((hips.x - HIPS * thigh).abs() < 0.02 && set[41].unwrap().x < -0.5);
    }
}
