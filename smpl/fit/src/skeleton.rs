//! A body reduced to what points depend on: bones, and points fixed to them.

use glam::{DMat3, DQuat, DVec3};
use smpl::{BodyModel, Shaped};

use crate::Anchor;
use crate::limits::{Range, ranges};

/// Kinematic tree with points on its bones; offsets and arms are linear in the betas.
///
/// A point is Σ share · t_bone + R_bone · arm over its parts, (R, t) the joint frames: skinning without
/// pose blend shapes.
pub(crate) struct Skeleton {
    pub parents: Vec<Option<usize>>,
    pub ranges: Vec<Range>,
    /// The mean shape, and its derivative with respect to each beta.
    pub mean: Shape,
    pub directions: Vec<Shape>,
    /// Column of the first of three unknowns of each joint's rotation; `None` where it moves no point.
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
