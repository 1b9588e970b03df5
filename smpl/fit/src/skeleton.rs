//! A body reduced to what points depend on: bones, their limits, and points fixed to them.

use glam::{DMat3, DQuat, DVec3};
use smpl::{BodyModel, Shaped};

use crate::Anchor;

/// Least and greatest components of a rotation vector, in radians.
pub(crate) type Range = [DVec3; 2];

/// Parents of SMPL's body joints, which SMPL-H and SMPL-X share.
const SMPL: [usize; 21] = [0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19];

/// Limits of SMPL's joints on the left and along the spine, generous; those of the right are
/// mirrored. Knees and elbows bend one way.
const LIMITS: [(usize, Range); 12] = [
    (1, [DVec3::new(-2.5, -1.2, -1.0), DVec3::new(1.2, 1.2, 1.4)]),
    (3, [DVec3::splat(-0.7), DVec3::splat(0.7)]),
    (4, [DVec3::new(-0.2, -0.7, -0.7), DVec3::new(2.8, 0.7, 0.7)]),
    (6, [DVec3::splat(-0.7), DVec3::splat(0.7)]),
    (7, [DVec3::splat(-1.0), DVec3::splat(1.0)]),
    (9, [DVec3::splat(-0.7), DVec3::splat(0.7)]),
    (10, [DVec3::splat(-0.8), DVec3::splat(0.8)]),
    (12, [DVec3::splat(-1.0), DVec3::splat(1.0)]),
    (13, [DVec3::splat(-0.8), DVec3::splat(0.8)]),
    (15, [DVec3::splat(-1.0), DVec3::splat(1.0)]),
    (18, [DVec3::new(-1.7, -2.8, -1.2), DVec3::new(1.7, 0.3, 1.2)]),
    (20, [DVec3::splat(-1.4), DVec3::splat(1.4)]),
];

/// Limit of joints without their own.
const FREE: f64 = 2.4;

/// Kinematic tree with points on its bones; offsets and arms are linear in the betas.
///
/// A point is Σ share · t_bone + R_bone · arm over its parts, (R, t) the joint frames: skinning
/// without pose blend shapes.
pub(crate) struct Skeleton {
    pub parents: Vec<Option<usize>>,
    pub ranges: Vec<Range>,
    /// The mean shape, and its derivative with respect to each beta.
    pub mean: Shape,
    pub directions: Vec<Shape>,
    /// Column of the first of three unknowns of each joint's rotation; `None` where it moves no
    /// point.
    pub columns: Vec<Option<usize>>,
    /// Unknowns of a frame: place of the root, then rotations.
    pub unknowns: usize,
    /// The point that lies opposite of each at rest, itself where there is none.
    pub opposite: Vec<usize>,
}

/// Lengths of one shape.
#[derive(Clone)]
pub(crate) struct Shape {
    /// Joint minus its parent at rest, (J); the root's own place for joint 0.
    pub offsets: Vec<DVec3>,
    /// Parts of each point, the same bones in every shape.
    pub points: Vec<Vec<Part>>,
}

/// Part of a point that one bone carries.
#[derive(Clone, Copy)]
pub(crate) struct Part {
    pub bone: usize,
    pub share: f64,
    pub arm: DVec3,
}

/// Pose and place in one frame.
#[derive(Clone)]
pub(crate) struct State {
    /// Of the root joint.
    pub place: DVec3,
    /// Rotation of each joint relative to its parent.
    pub turns: Vec<DQuat>,
}

/// Joint frames in the world.
pub(crate) struct Frames {
    pub turns: Vec<DMat3>,
    pub origins: Vec<DVec3>,
}

/// Greatest distance of mirrored points, as a part of the skeleton's extent.
const OPPOSITE: f64 = 0.03;

impl Skeleton {
    pub fn new(body: &BodyModel, anchors: &[Anchor], betas: usize) -> Self {
        let rest = body.shaped(&[]);
        let mean = Shape::new(body, anchors, &rest);
        let direction = |b: usize| {
            let mut unit = vec![0.0; b + 1];
            unit[b] = 1.0;
            Shape::new(body, anchors, &body.shaped(&unit)).plus(-1.0, &mean)
        };
        let mut carries = vec![false; body.num_joints()];
        // Vertices' shares of less than a thousandth leave a joint at rest.
        for part in mean.points.iter().flatten().filter(|part| part.arm.length() > 1e-3 * OPPOSITE) {
            carries[part.bone] = true;
        }
        for (j, parent) in body.parents.iter().enumerate().rev() {
            if let Some(parent) = parent {
                carries[*parent] |= carries[j];
            }
        }
        let mut unknowns = 3;
        let column = |&carries: &bool| {
            carries.then(|| {
                unknowns += 3;
                unknowns - 3
            })
        };
        let columns = carries.iter().map(column).collect();
        let mut skeleton = Self {
            parents: body.parents.clone(),
            ranges: ranges(&body.parents),
            directions: (0..betas).map(direction).collect(),
            mean,
            columns,
            unknowns,
            opposite: Vec::new(),
        };
        let points = skeleton.points(&skeleton.mean, &skeleton.frames(&skeleton.mean, &skeleton.rest()));
        let extent = points.iter().map(|p| p.distance(points[0])).fold(0.0, f64::max);
        let opposite = |(i, point): (usize, &DVec3)| {
            let mirrored = *point * DVec3::new(-1.0, 1.0, 1.0);
            let nearest = (0..points.len())
                .min_by(|&a, &b| points[a].distance(mirrored).total_cmp(&points[b].distance(mirrored)));
            nearest.filter(|&n| points[n].distance(mirrored) < OPPOSITE * extent).unwrap_or(i)
        };
        skeleton.opposite = points.iter().enumerate().map(opposite).collect();
        skeleton
    }

    pub fn rest(&self) -> State {
        State { place: self.mean.offsets[0], turns: vec![DQuat::IDENTITY; self.parents.len()] }
    }

    pub fn shape(&self, betas: &[f64]) -> Shape {
        betas.iter().zip(&self.directions).fold(self.mean.clone(), |shape, (beta, by)| shape.plus(*beta, by))
    }

    pub fn frames(&self, shape: &Shape, state: &State) -> Frames {
        let mut frames = Frames { turns: Vec::new(), origins: Vec::new() };
        for (j, parent) in self.parents.iter().enumerate() {
            let local = DMat3::from_quat(state.turns[j]);
            let (turn, origin) = match parent {
                Some(p) => (frames.turns[*p] * local, frames.origins[*p] + frames.turns[*p] * shape.offsets[j]),
                None => (local, state.place),
            };
            frames.turns.push(turn);
            frames.origins.push(origin);
        }
        frames
    }

    pub fn points(&self, shape: &Shape, frames: &Frames) -> Vec<DVec3> {
        shape.points.iter().map(|parts| parts.iter().map(|part| frames.carried(part)).sum()).collect()
    }

    /// A joint and its ancestors, towards the root.
    pub fn chain(&self, joint: usize) -> impl Iterator<Item = usize> + '_ {
        std::iter::successors(Some(joint), |&j| self.parents[j])
    }
}

impl Frames {
    /// The part's summand of its point.
    pub fn carried(&self, part: &Part) -> DVec3 {
        part.share * self.origins[part.bone] + self.turns[part.bone] * part.arm
    }
}

impl Shape {
    fn new(body: &BodyModel, anchors: &[Anchor], rest: &Shaped) -> Self {
        let joints: Vec<DVec3> = rest.joints.iter().map(|j| j.as_dvec3()).collect();
        let offset = |(j, parent): (usize, &Option<usize>)| joints[j] - parent.map_or(DVec3::ZERO, |p| joints[p]);
        let offsets: Vec<DVec3> = body.parents.iter().enumerate().map(offset).collect();
        let point = |anchor: &Anchor| {
            let mut parts: Vec<Part> = Vec::new();
            let mut add = |bone: usize, share: f64, arm: DVec3| match parts.iter_mut().find(|p| p.bone == bone) {
                Some(part) => (part.share, part.arm) = (part.share + share, part.arm + share * arm),
                None => parts.push(Part { bone, share, arm: share * arm }),
            };
            for &(j, share) in &anchor.joints {
                let (bone, arm) = body.parents[j].map_or((j, DVec3::ZERO), |parent| (parent, offsets[j]));
                add(bone, share.into(), arm);
            }
            for &(v, share) in &anchor.vertices {
                for (bone, weight) in body.weights.row(v).filter(|(_, weight)| *weight > 0.0) {
                    add(bone, f64::from(share * weight), rest.vertices[v].as_dvec3() - joints[bone]);
                }
            }
            parts
        };
        Self { points: anchors.iter().map(point).collect(), offsets }
    }

    /// This and `factor` times another.
    fn plus(mut self, factor: f64, other: &Self) -> Self {
        self.offsets.iter_mut().zip(&other.offsets).for_each(|(a, b)| *a += factor * *b);
        for (a, b) in self.points.iter_mut().flatten().zip(other.points.iter().flatten()) {
            a.arm += factor * b.arm;
        }
        self
    }
}

/// The limits of every joint; none of the root.
fn ranges(parents: &[Option<usize>]) -> Vec<Range> {
    let free = [DVec3::splat(-FREE), DVec3::splat(FREE)];
    let mut ranges = vec![free; parents.len()];
    if parents.len() > SMPL.len() && parents[1..].iter().zip(SMPL).all(|(parent, smpl)| *parent == Some(smpl)) {
        for (joint, [low, high]) in LIMITS {
            ranges[joint] = [low, high];
            // Twins follow each other; joints of the spine have none.
            if ![3, 6, 9, 12, 15].contains(&joint) {
                let flip = DVec3::new(1.0, -1.0, -1.0);
                ranges[joint + 1] = [(low * flip).min(high * flip), (low * flip).max(high * flip)];
            }
        }
    }
    ranges[0] = [DVec3::NEG_INFINITY, DVec3::INFINITY];
    ranges
}

/// The rotation vector of at most half a turn.
pub(crate) fn log(turn: DQuat) -> DVec3 {
    (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis()
}

/// ∂ log(exp(v) exp(δ)) / ∂δ at δ = 0, the inverse right Jacobian of SO(3).
pub(crate) fn log_derivative(v: DVec3) -> DMat3 {
    let theta = v.length();
    let skew = DMat3::from_cols(v.cross(DVec3::X), v.cross(DVec3::Y), v.cross(DVec3::Z));
    let square = if theta < 1e-3 { 1.0 / 12.0 } else { (1.0 - 0.5 * theta / (0.5 * theta).tan()) / (theta * theta) };
    // [v]ₓ maps x to v × x: its columns are v × e_i.
    DMat3::IDENTITY + 0.5 * skew + square * (skew * skew)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_derivative_of_the_logarithm_agrees_with_differences() {
        for v in [DVec3::ZERO, DVec3::new(1e-4, 0.0, 2e-4), DVec3::new(0.4, -1.1, 0.3), DVec3::new(-2.0, 1.5, 1.0)] {
            let derivative = log_derivative(v);
            for axis in DVec3::AXES {
                let at = |h: f64| log(DQuat::from_scaled_axis(v) * DQuat::from_scaled_axis(h * axis));
                let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
                assert!((derivative * axis).distance(numeric) < 1e-8, "{v} {axis}: {numeric}");
            }
        }
    }

    #[test]
    fn limits_of_twins_are_mirrored_and_others_have_one_limit() {
        let body = smpl::BodyModel::embedded();
        let ranges = ranges(&body.parents);
        assert_eq!(ranges[19][1], DVec3::new(1.7, 2.8, 1.2));
        assert_eq!((ranges[5][0].x, ranges[5][1].x), (-0.2, 2.8));
        assert_eq!(super::ranges(&[None, Some(0)])[1][1], DVec3::splat(FREE));
    }
}
