//! Corrections of the prior's poses, learnt with the field.
//!
//! A body model fitted to a video is off by a degree or two, and an image error says which way. A
//! correction turns each joint about itself, in the joint's own axes, and shifts the whole; it
//! moves the posed bones and leaves the pose blend shapes as they are. Corrections are linear in
//! time between knots: fitting errors hardly change from one frame to the next, each step teaches
//! its neighbours too, and a moment that is hidden follows those before and after it.

use glam::{Affine3A, Mat3A, Quat, Vec3, Vec3A};
use smpl::{BodyModel, Posed, Shaped};

/// How the flat parameters (K knots × (J + 1) × 3: shift, then each joint's axis-angle turn) belong
/// to frames.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Corrections {
    frames: usize,
    /// Frames from one knot to the next; 0 where nothing is corrected.
    spacing: usize,
    joints: usize,
}

impl Corrections {
    pub fn new(frames: usize, spacing: usize, joints: usize) -> Self {
        Self { frames, spacing, joints }
    }

    /// Length of the parameters.
    pub fn len(&self) -> usize {
        let knots = if self.spacing == 0 { 0 } else { (self.frames - 1).div_ceil(self.spacing) + 1 };
        knots * self.per_knot()
    }

    pub fn per_knot(&self) -> usize {
        3 * (self.joints + 1)
    }

    /// First parameter and weight of the knots around a frame.
    pub fn knots(&self, frame: usize) -> impl Iterator<Item = (usize, f32)> {
        let (knot, beyond) = (frame / self.spacing, frame % self.spacing);
        let share = beyond as f32 / self.spacing as f32;
        let first = knot * self.per_knot();
        [(first, 1.0 - share), (first + self.per_knot(), share)].into_iter().filter(|(_, w)| *w > 0.0)
    }

    /// Shift, then each joint's turn, of a training frame.
    pub fn at(&self, parameters: &[f32], frame: usize) -> Vec<Vec3> {
        let mut out = vec![Vec3::ZERO; self.joints + 1];
        for (first, weight) in self.knots(frame) {
            let values = parameters[first..][..self.per_knot()].chunks_exact(3);
            out.iter_mut().zip(values).for_each(|(out, v)| *out += weight * Vec3::from_slice(v));
        }
        out
    }
}

/// World-space change of each bone: C_j = C_parent · (turn by `correction[1 + j]`, in the joint's
/// axes, about the joint), after the shift `correction[0]` in the root's axes.
pub(crate) fn changes(model: &BodyModel, posed: &Posed, correction: &[Vec3]) -> Vec<Affine3A> {
    let mut out: Vec<Affine3A> = Vec::with_capacity(posed.bones.len());
    for (j, parent) in model.parents.iter().enumerate() {
        let axes = posed.bones[j].matrix3;
        let turn = Mat3A::from_quat(Quat::from_scaled_axis((axes * Vec3A::from(correction[1 + j])).into()));
        let joint = Vec3A::from(posed.joints[j]);
        let about_joint = Affine3A { matrix3: turn, translation: joint - turn * joint };
        let before = parent.map_or_else(
            || Affine3A::from_translation((axes * Vec3A::from(correction[0])).into()),
            |parent| out[parent],
        );
        out.push(before * about_joint);
    }
    out
}

/// `posed` (of `shape`) with its bones corrected: shift in its unit, turns in radians.
pub(crate) fn corrected(model: &BodyModel, shape: &Shaped, posed: &Posed, correction: &[Vec3]) -> Posed {
    let mut out = Posed::default();
    correct(model, shape, posed, correction, &mut out);
    out
}

/// [`corrected`], in the place of `out`.
pub(crate) fn correct(model: &BodyModel, shape: &Shaped, posed: &Posed, correction: &[Vec3], out: &mut Posed) {
    let changes = changes(model, posed, correction);
    let Posed { vertices, joints, bones, pose_offsets } = out;
    bones.clear();
    bones.extend(changes.iter().zip(&posed.bones).map(|(change, bone)| *change * *bone));
    joints.clear();
    joints.extend(changes.iter().zip(&posed.joints).map(|(change, &joint)| change.transform_point3(joint)));
    pose_offsets.clone_from(&posed.pose_offsets);
    let rest = shape.vertices.iter().zip(&*pose_offsets);
    vertices.clear();
    vertices.extend(rest.enumerate().map(|(v, (rest, offset))| {
        let rest = Vec3A::from(*rest + *offset);
        Vec3::from(model.weights.row(v).map(|(j, w)| w * bones[j].transform_point3a(rest)).sum::<Vec3A>())
    }));
}
