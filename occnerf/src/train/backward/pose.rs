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
    /// Anchors the point `x` whose nearest surface point lies on `face` at `barycentric`; `None`
    /// where a fold is so sharp that the map takes one bone for all.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Method, Preset};
    use crate::model::correction::corrected;
    use crate::model::parameters::Part;
    use crate::model::trace::{CELL, PosedSurface};
    use crate::random::Stream;
    use crate::scene::prepared::Scene;
    use crate::train::backward::correction::correct_backward;
    use crate::train::trainer::Trainer;
    use smpl::MotionFrame;

    /// Radians and metres to each side.
    const H: f32 = 1.0 / 1024.0;

    /// Value = Σ c · features(x) + e · d(x) + p · f(x) of points x that keep still while the pose
    /// is corrected; and of d and f alone, which do not depend on how v̂ slides.
    #[test]
    fn gradient_of_the_pose_agrees_with_finite_differences() {
        let body = BodyModel::embedded();
        let demo = crate::capture::DemoConfig { size: 32, frames: 2, eval_cameras: 1, ..Default::default() };
        let capture = crate::capture::demo(&demo, &body).unwrap();
        for method in [Method::Occnerf, Method::HashPoint] {
            let mut config = Config::preset(Preset::Fast, method);
            (config.encoding.levels, config.encoding.n_min, config.encoding.n_max) = (2, 3, 5);
            config.motion.correction_spacing = 4;
            let scene = Scene::new(&capture, &body, &config).unwrap();
            let mut trainer = Trainer::new(&scene, config.clone()).unwrap();
            trainer.model.parameters.get_mut(Part::Table).iter_mut().for_each(|v| *v *= 1e4);
            let (frame, model) = (&*scene.train[1].view, &trainer.model);
            let mut stream = Stream::new(&[11, method as u64]);
            let mut random = |size: f32| size * Vec3::new(stream.normal(), stream.normal(), stream.normal());
            let correction: Vec<Vec3> = (0..=body.num_joints()).map(|_| random(0.03)).collect();
            let after = corrected(&body, &frame.shape, &frame.posed, &correction);
            let mut points = Vec::new();
            for (f, corners) in body.faces.iter().enumerate().step_by(7) {
                let [a, b, c] = corners.map(|v| after.vertices[v as usize]);
                let normal = (b - a).cross(c - a).normalize_or_zero();
                // Never on the surface, where the distance has a fold.
                points.push((a + b + c) / 3.0 + ((f % 8) as f32 / 7.0 * 0.024 - 0.012) * normal);
            }
            // Which points live, and on which face, is decided once: the value jumps where that
            // changes.
            let mut surface = PosedSurface::new(&scene.body, CELL).unwrap();
            let mut trace = |points: &[Vec3], posed: &Posed, batch: &mut SampleBatch| -> Vec<usize> {
                surface.refit(&scene.body, posed, &model.extent, &config, &model.base);
                let motion = MotionFrame::new(&body, posed);
                let tracer = model.tracer(&surface, &model.extent, &motion);
                batch.samples.clear();
                let live = (0..points.len()).filter(|&i| tracer.push_point(&mut batch.samples, points[i]));
                let live = live.collect();
                model.field.encoder.coordinates(&batch.samples, &scene.body.canonical_box, &mut batch.at);
                live
            };
            // Nor where the nearest surface jumps, from an arm to the hip, as soon as a joint turns.
            let mut still = vec![true; points.len()];
            for (j, axis) in (0..correction.len()).flat_map(|j| (0..3).map(move |axis| (j, axis))) {
                let [a, b] = [H, -H].map(|h| {
                    let (mut moved, mut batch) = (correction.clone(), SampleBatch::default());
                    moved[j][axis] += h;
                    let live = trace(&points, &corrected(&body, &frame.shape, &frame.posed, &moved), &mut batch);
                    let mut at = vec![None; points.len()];
                    live.iter().zip(&batch.samples.canonical).for_each(|(&i, &x)| at[i] = Some(x));
                    at
                });
                let stays =
                    |(a, b): (&Option<Vec3>, &Option<Vec3>)| a.zip(*b).is_some_and(|(a, b)| a.distance(b) < 0.005);
                still.iter_mut().zip(a.iter().zip(&b)).for_each(|(still, pair)| *still &= stays(pair));
            }
            let points: Vec<Vec3> = points.into_iter().zip(still).filter_map(|(p, still)| still.then_some(p)).collect();
            let mut group = SampleBatch::default();
            let live = trace(&points, &after, &mut group);
            assert!(live.len() > 500, "{}", live.len());
            let width = model.field.encoder.num_features();
            let (table, mut features) = (model.parameters.get(Part::Table), vec![0.0; live.len() * width]);
            let mut jacobians = Arena::default();
            group.jacobian = jacobians.take(live.len() * model.field.encoder.jacobian_width());
            let jacobian = jacobians.piece_mut(&group.jacobian);
            model.field.encoder.encode_jacobian(table, group.at.all(), &mut features, jacobian);
            for distance_alone in [true, false] {
                let size = if distance_alone { 0.0 } else { 1.0 };
                let d_rows: Vec<f32> = (0..live.len() * width).map(|_| size * random(1.0).x).collect();
                group.features = vec![0.0; d_rows.len()];
                let layout = model.field.encoder.layout(live.len());
                layout.from_rows(&d_rows, width, 0..live.len(), &mut group.features);
                group.d_distance = live.iter().map(|_| random(3.0).x).collect();
                group.d_likelihood = live.iter().map(|_| random(0.3).x).collect();
                let mut wrenches = vec![Wrench::default(); after.bones.len()];
                pose_backward(model, &mut group, &jacobians, &after, &mut wrenches);
                let gradient = correct_backward(&body, &frame.posed, &correction, &after, &wrenches);

                let mut value = |correction: &[Vec3]| -> f64 {
                    let mut moved = SampleBatch::default();
                    let posed = corrected(&body, &frame.shape, &frame.posed, correction);
                    let found = trace(&points, &posed, &mut moved);
                    let mut features = vec![0.0; found.len() * width];
                    model.field.encoder.encode(model.parameters.get(Part::Table), moved.at.all(), &mut features);
                    let mut rows = vec![0.0; features.len()];
                    let layout = model.field.encoder.layout(found.len());
                    layout.to_rows(&features, 0..found.len(), &mut rows, width);
                    let at = |i: usize| live.binary_search(&i).ok();
                    let terms = found.iter().enumerate().filter_map(|(s, &i)| {
                        let l = at(i)?;
                        let (cotangent, row) = (&d_rows[l * width..][..width], &rows[s * width..][..width]);
                        let dot: f64 = cotangent.iter().zip(row).map(|(c, v)| f64::from(c * v)).sum();
                        let d = f64::from(group.d_distance[l] * moved.samples.distance[s]);
                        Some(dot + d + f64::from(group.d_likelihood[l] * moved.samples.likelihood[s]))
                    });
                    terms.sum()
                };
                let (mut numeric_all, mut analytic_all) = (Vec::new(), Vec::new());
                for j in 0..correction.len() {
                    for axis in 0..3 {
                        let mut at = |h: f32| {
                            let mut moved = correction.clone();
                            moved[j][axis] += h;
                            value(&moved)
                        };
                        numeric_all.push((at(H) - at(-H)) / (2.0 * f64::from(H)));
                        analytic_all.push(f64::from(gradient[j][axis]));
                    }
                }
                let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
                let (nn, aa, na) = (
                    dot(&numeric_all, &numeric_all),
                    dot(&analytic_all, &analytic_all),
                    dot(&numeric_all, &analytic_all),
                );
                let (cosine, ratio) = (na / (nn * aa).sqrt(), (aa / nn).sqrt());
                let apart: f64 = numeric_all.iter().zip(&analytic_all).map(|(n, a)| (n - a).powi(2)).sum();
                let apart = (apart / nn).sqrt();
                println!("{method:?}: cosine {cosine}, ratio {ratio}, {apart} apart");
                if distance_alone {
                    assert!(apart < 0.08, "{method:?}: {apart} apart");
                    continue;
                }
                // The surface is not flat: what slides along a tangent plane there is a tenth or two
                // off here.
                assert!(cosine > 0.9 && (0.85..1.2).contains(&ratio), "{method:?}: cosine {cosine}, ratio {ratio}");
            }
        }
    }
}
