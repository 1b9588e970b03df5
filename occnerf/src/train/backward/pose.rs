//! From the gradients of samples to those of the posed bones, for the surface motion.

use glam::{Affine3A, Mat3A, Vec3, Vec3A};
use smpl::{BodyModel, Posed, SurfaceMotion};

use crate::model::arena::Arena;
use crate::model::field::SampleBatch;
use crate::model::trained::Model;
use crate::train::backward::correction::Wrench;
use crate::train::backward::motion::d_coordinates;

/// Adds the gradients of the encoding's coordinates, of d and of f to those of the bones that the
/// samples hang on. The closest surface point is taken to slide along the tangent plane, as it does
/// to first order on a flat surface, and what colours start from to be the same all around it.
pub(crate) fn pose_backward(
    model: &Model,
    batch: &mut SampleBatch,
    jacobians: &Arena,
    posed: &Posed,
    wrenches: &mut [Wrench],
) {
    d_coordinates(model, batch, jacobians);
    let (samples, body, motion) = (&batch.samples, &model.body, &model.config.motion);
    let on_surface = !batch.at.surface.is_empty();
    let field = SurfaceMotion { margin: motion.margin, falloff: motion.falloff };
    for s in 0..samples.world.len() {
        let (d_canonical, d_coordinate) = model.field.encoder.d_metres(&batch.d_at, s, &body.canonical_box);
        let ((face, barycentric), x, d) = (samples.faces[s], samples.world[s], samples.distance[s]);
        let Some(anchor) = Anchor::new(&body.model, posed, face, barycentric, x) else { continue };
        let corners = body.model.faces[face as usize].iter().zip(barycentric);
        let foot: Vec3 = corners.map(|(&v, b)| b * posed.vertices[v as usize]).sum();
        let normal = Vec3A::from((x - foot).normalize_or_zero() * d.signum());
        let mut d_distance = batch.d_distance[s] + batch.d_likelihood[s] * field.likelihood_slope(d);
        let mut d_point = anchor.to_world(d_canonical);
        if on_surface {
            d_point -= normal.dot(d_point) * normal;
            if model.field.encoder.distance_is_inside(d) {
                d_distance += d_coordinate;
            }
        }
        anchor.push(d_point + d_distance * normal, wrenches);
    }
}

/// How a point hangs on the bones: with the face that it is mapped by.
pub(crate) struct Anchor<'a> {
    model: &'a BodyModel,
    bones: &'a [Affine3A],
    corners: [u32; 3],
    barycentric: [f32; 3],
    /// x̂ before the pose offset is taken off.
    rest: Vec3A,
    /// (∂x̂/∂x)ᵀ.
    transposed: Mat3A,
}

impl<'a> Anchor<'a> {
    /// Of the point `x` whose nearest surface point lies on `face` at `barycentric`; `None` where a fold is so sharp that the
    /// map takes one bone for all.
    pub fn new(model: &'a BodyModel, posed: &'a Posed, face: u32, barycentric: [f32; 3], x: Vec3) -> Option<Self> {
        let (corners, bones) = (model.faces[face as usize], &posed.bones[..]);
        let mut to_world = Affine3A { matrix3: Mat3A::ZERO, translation: Vec3A::ZERO };
        for (joint, w) in weights(model, corners, barycentric) {
            to_world.matrix3 += bones[joint].matrix3 * w;
            to_world.translation += bones[joint].translation * w;
        }
        if to_world.matrix3.determinant() < SurfaceMotion::MIN_DETERMINANT {
            return None;
        }
        let inverse = to_world.inverse();
        let (rest, transposed) = (inverse.transform_point3a(x.into()), inverse.matrix3.transpose());
        Some(Self { model, bones, corners, barycentric, rest, transposed })
    }

    /// A gradient with respect to x̂, as one with respect to x.
    pub fn to_world(&self, d_canonical: Vec3) -> Vec3A {
        self.transposed * Vec3A::from(d_canonical)
    }

    /// Shares the gradient of the point among its bones. One that is not finite is left out.
    pub fn push(&self, d_point: Vec3A, wrenches: &mut [Wrench]) {
        if !d_point.is_finite() {
            return;
        }
        for (joint, w) in weights(self.model, self.corners, self.barycentric) {
            // Where this bone alone would carry the point's rest position.
            let arm = self.bones[joint].transform_point3a(self.rest);
            let force = w * d_point;
            wrenches[joint].add(&Wrench { force, moment: arm.cross(force) });
        }
    }
}

fn weights(model: &BodyModel, corners: [u32; 3], barycentric: [f32; 3]) -> impl Iterator<Item = (usize, f32)> + '_ {
    let each = corners.into_iter().zip(barycentric);
    each.flat_map(|(v, b)| model.weights.row(v as usize).map(move |(joint, w)| (joint, b * w)))
}
