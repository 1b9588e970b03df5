//! Backward of the pose corrections.

use glam::{Vec3, Vec3A};
use smpl::{BodyModel, Posed};

use crate::model::correction::{Corrections, changes};

/// What the samples near a bone ask of it: Σ g, and Σ x × g, of the gradients g at the points x.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Wrench {
    pub force: Vec3A,
    pub moment: Vec3A,
}

impl Wrench {
    pub fn add(&mut self, other: &Self) {
        self.force += other.force;
        self.moment += other.moment;
    }
}

impl Corrections {
    /// Backward of [`Corrections::at`]: adds to `d_parameters`.
    pub fn at_backward(&self, frame: usize, d_correction: &[Vec3], d_parameters: &mut [f32]) {
        for (first, weight) in self.knots(frame) {
            let values = d_parameters[first..][..self.per_knot()].chunks_exact_mut(3);
            values.zip(d_correction).for_each(|(to, d)| (weight * *d + Vec3::from_slice(to)).write_to_slice(to));
        }
    }
}

/// Backward of [`corrected`] for points that keep still while the body moves: `wrenches` (J)
/// gather, over all points, the gradients with respect to the points' place *relative to the body*,
/// in world axes, shared out by skinning weight. `after` is the result of [`corrected`].
pub(crate) fn correct_backward(
    model: &BodyModel,
    posed: &Posed,
    correction: &[Vec3],
    after: &Posed,
    wrenches: &[Wrench],
) -> Vec<Vec3> {
    let mut subtree = wrenches.to_vec();
    let mut out = vec![Vec3::ZERO; correction.len()];
    let changes = changes(model, posed, correction);
    for j in (0..subtree.len()).rev() {
        let Wrench { force, moment } = subtree[j];
        // A turn of the joint by ω carries the body along by ω × (x − J), and a still point the
        // other way.
        let d_turn = Vec3A::from(after.joints[j]).cross(force) - moment;
        let axes = posed.bones[j].matrix3;
        let before = model.parents[j].map_or(axes, |parent| changes[parent].matrix3 * axes);
        out[1 + j] = left_jacobian_transposed(correction[1 + j], (before.transpose() * d_turn).into());
        match model.parents[j] {
            Some(parent) => {
                let child = subtree[j];
                subtree[parent].add(&child);
            }
            None => out[0] += Vec3::from(-(axes.transpose() * force)),
        }
    }
    out
}

/// J_l(δ)ᵀ v, with exp(δ + dδ) = exp(J_l(δ) dδ) · exp(δ) to first order.
fn left_jacobian_transposed(delta: Vec3, v: Vec3) -> Vec3 {
    let square = delta.length_squared();
    let (a, b) = if square < 1e-4 {
        (0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0)
    } else {
        let angle = square.sqrt();
        ((1.0 - angle.cos()) / square, (angle - angle.sin()) / (square * angle))
    };
    let across = delta.cross(v);
    v - a * across + b * delta.cross(across)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::correction::corrected;
    use crate::random::Stream;
    use glam::Quat;
    use smpl::{Shaped, SurfaceMotion};

    fn random(stream: &mut Stream, size: f32) -> Vec3 {
        size * Vec3::new(stream.normal(), stream.normal(), stream.normal())
    }

    fn posed(model: &BodyModel, shape: &Shaped, stream: &mut Stream) -> Posed {
        let pose: Vec<Vec3> = (0..model.num_joints()).map(|_| random(stream, 0.2)).collect();
        let placement = smpl::Placement::Origin { rotation: random(stream, 1.0), translation: random(stream, 1.0) };
        model.pose(shape, &pose, placement)
    }

    #[test]
    fn no_correction_changes_nothing_and_a_shift_moves_everything() {
        let model = BodyModel::embedded();
        let shape = model.shaped(&[0.5]);
        let posed = posed(&model, &shape, &mut Stream::new(&[3]));
        let mut correction = vec![Vec3::ZERO; model.num_joints() + 1];
        let same = corrected(&model, &shape, &posed, &correction);
        let far =
            |a: &[Vec3], b: &[Vec3], by: Vec3| a.iter().zip(b).map(|(a, b)| a.distance(*b + by)).fold(0.0, f32::max);
        assert!(far(&same.vertices, &posed.vertices, Vec3::ZERO) < 2e-6);
        correction[0] = Vec3::new(0.1, 0.0, 0.0);
        let moved = corrected(&model, &shape, &posed, &correction);
        let by = Vec3::from(0.1 * posed.bones[0].matrix3.x_axis);
        assert!(far(&moved.vertices, &posed.vertices, by) < 2e-6 && far(&moved.joints, &posed.joints, by) < 2e-6);
    }

    #[test]
    fn a_correction_equals_a_pose_with_the_turns_appended() {
        let model =
            BodyModel { posedirs: smpl::SparseRows::from_rows(vec![Vec::new(); 4787]), ..BodyModel::embedded() };
        let shape = model.shaped(&[]);
        let mut stream = Stream::new(&[4]);
        let pose: Vec<Vec3> = (0..model.num_joints()).map(|_| random(&mut stream, 0.2)).collect();
        let correction: Vec<Vec3> =
            (0..=model.num_joints()).map(|j| if j == 0 { Vec3::ZERO } else { random(&mut stream, 0.05) }).collect();
        let turned: Vec<Vec3> = pose
            .iter()
            .zip(&correction[1..])
            .map(|(&pose, &turn)| (Quat::from_scaled_axis(pose) * Quat::from_scaled_axis(turn)).to_scaled_axis())
            .collect();
        let expected = model.pose(&shape, &turned, smpl::Placement::default());
        let found = corrected(&model, &shape, &model.pose(&shape, &pose, smpl::Placement::default()), &correction);
        let worst = expected.vertices.iter().zip(&found.vertices).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(worst < 5e-6, "{worst}");
    }

    /// L = Σ a · x̂(x) over still points x with fixed weights, whose derivative is exact.
    #[test]
    fn gradient_of_still_points_agrees_with_finite_differences() {
        let model = BodyModel::embedded();
        let shape = model.shaped(&[0.3]);
        let mut stream = Stream::new(&[5]);
        let posed = posed(&model, &shape, &mut stream);
        let motion = SurfaceMotion { margin: 0.2, falloff: 0.1 };
        let correction: Vec<Vec3> = (0..=model.num_joints()).map(|_| random(&mut stream, 0.1)).collect();
        let after = corrected(&model, &shape, &posed, &correction);
        let points: Vec<(u32, [f32; 3], Vec3, Vec3)> = (0..200)
            .map(|_| {
                let face = stream.below(model.faces.len()) as u32;
                let bary = [0.25, 0.5, 0.25];
                let on = model.faces[face as usize].iter().zip(bary).map(|(&v, b)| b * after.vertices[v as usize]);
                let x = on.sum::<Vec3>() + random(&mut stream, 0.01);
                (face, bary, x, random(&mut stream, 1.0))
            })
            .collect();
        let value = |correction: &[Vec3]| -> f64 {
            let posed = corrected(&model, &shape, &posed, correction);
            let each = points.iter().map(|(face, bary, x, a)| {
                let sample = motion.map(&model, &posed, *x, *face, *bary, 0.0).unwrap();
                f64::from(sample.canonical.dot(*a))
            });
            each.sum()
        };
        let mut wrenches = vec![Wrench::default(); model.num_joints()];
        for (face, bary, x, a) in &points {
            let at = crate::train::backward::pose::Anchor::new(&model, &after, *face, *bary, *x).unwrap();
            at.push(at.to_world(*a), &mut wrenches);
        }
        let gradient = correct_backward(&model, &posed, &correction, &after, &wrenches);
        let mut failures = Vec::new();
        for j in 0..correction.len() {
            for axis in 0..3 {
                let at = |h: f32| {
                    let mut moved = correction.clone();
                    moved[j][axis] += h;
                    value(&moved)
                };
                let h = 1.0 / 256.0;
                let numeric = (at(h) - at(-h)) / (2.0 * f64::from(h));
                let analytic = f64::from(gradient[j][axis]);
                if (numeric - analytic).abs() > 0.02 + 0.005 * numeric.abs() {
                    failures.push((j, axis, numeric, analytic));
                }
            }
        }
        assert!(failures.is_empty(), "{failures:?}");
    }

    #[test]
    fn corrections_are_linear_between_knots_and_so_is_their_gradient() {
        let of = Corrections::new(10, 4, 1);
        assert_eq!(of.len(), 4 * 6);
        let parameters: Vec<f32> = (0..24).map(|i| (i * i) as f32).collect();
        assert_eq!(of.at(&parameters, 4)[1], Vec3::new(81.0, 100.0, 121.0));
        let (a, b, half) = (of.at(&parameters, 4), of.at(&parameters, 8), of.at(&parameters, 6));
        assert_eq!(half[0], (a[0] + b[0]) / 2.0);
        let d = [Vec3::new(1.0, 2.0, 3.0), Vec3::new(-1.0, 0.5, 0.25)];
        for frame in 0..10 {
            let mut back = vec![0.0; 24];
            of.at_backward(frame, &d, &mut back);
            let forward: f32 = of.at(&parameters, frame).iter().zip(d).map(|(v, d)| v.dot(d)).sum();
            let backward: f32 = parameters.iter().zip(&back).map(|(p, g)| p * g).sum();
            assert_eq!(forward, backward, "{frame}");
        }
        assert_eq!(Corrections::new(10, 0, 24).len(), 0);
        assert_eq!(Corrections::new(1, 4, 24).len(), 75);
    }
}
