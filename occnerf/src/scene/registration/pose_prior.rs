//! Gaussian pose prior estimated from the video (the covariance of relative joint rotations over
//! all frames, which also constrains occluded joints), and the error model of the given poses:
//! variances and time constants of a stationary autoregressive process, re-estimated from the
//! corrections.

use glam::{Quat, Vec3A};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use smpl::{BodyModel, Posed};

use crate::scene::registration::corrections::Correction;
use crate::scene::registration::system::{NormalEquations, inverse};

/// Standard deviation added to each axis, radians: the sample covariance alone would suppress poses
/// that few frames show.
const FLOOR: f64 = 0.087;

/// Rotations of the joints relative to their parents, about their means over the video.
struct Rotations<'a> {
    model: &'a BodyModel,
    /// Mean rotation of each joint, (J).
    means: Vec<Quat>,
}

impl<'a> Rotations<'a> {
    fn new(model: &'a BodyModel, poses: &[&Posed]) -> Self {
        let mean = |joint: usize| {
            let mut sum = Quat::from_xyzw(0.0, 0.0, 0.0, 0.0);
            for pose in poses {
                let rotation = relative_rotation(model, pose, joint);
                // Quaternions q and −q are the same rotation.
                sum = if sum.dot(rotation) < 0.0 { sum - rotation } else { sum + rotation };
            }
            if sum.length() > 0.0 { sum.normalize() } else { Quat::IDENTITY }
        };
        Self { means: (0..model.num_joints()).map(mean).collect(), model }
    }

    /// Deviation of each joint from its mean: axis times twice the sine of half the angle, (3 J).
    fn deviations(&self, pose: &Posed) -> DVector<f64> {
        let each = (0..self.means.len()).flat_map(|joint| (2.0 * self.deviation(pose, joint).xyz()).to_array());
        DVector::from_iterator(3 * self.means.len(), each.map(f64::from))
    }

    /// Jacobian of [`Rotations::deviations`] by rotations of the bones in world axes, (3 J,
    /// `per_frame`).
    fn jacobian(&self, pose: &Posed, per_frame: usize) -> DMatrix<f64> {
        let mut jacobian = DMatrix::zeros(3 * self.means.len(), per_frame);
        for (joint, parent) in self.model.parents.iter().enumerate() {
            let Some(parent) = *parent else { continue };
            let deviation = self.deviation(pose, joint);
            let to_parent = pose.bones[parent].matrix3.transpose();
            for (i, axis) in Vec3A::AXES.into_iter().enumerate() {
                let about = to_parent * axis;
                let column = deviation.w * about + about.cross(Vec3A::from(deviation.xyz()));
                for (k, entry) in column.to_array().into_iter().enumerate() {
                    jacobian[(3 * joint + k, 3 + 3 * joint + i)] = f64::from(entry);
                    jacobian[(3 * joint + k, 3 + 3 * parent + i)] = -f64::from(entry);
                }
            }
        }
        jacobian
    }

    /// Rotation from a joint's mean, as the quaternion of the smaller angle.
    fn deviation(&self, pose: &Posed, joint: usize) -> Quat {
        let deviation = relative_rotation(self.model, pose, joint) * self.means[joint].inverse();
        if deviation.w < 0.0 { -deviation } else { deviation }
    }
}

/// Rotation of a joint relative to its parent; the identity for a root.
fn relative_rotation(model: &BodyModel, pose: &Posed, joint: usize) -> Quat {
    let bone = |joint: usize| pose.bones[joint].matrix3;
    model.parents[joint]
        .map_or(Quat::IDENTITY, |parent| Quat::from_mat3a(&(bone(parent).transpose() * bone(joint))).normalize())
}

/// Adds the pose prior to the normal equations of each frame, `poses` and `normals` being a frame
/// each. Frames without observations get none; frames whose pose is not finite also leave the mean
/// and the covariance alone.
pub(super) fn add(model: &BodyModel, poses: &[&Posed], normals: &mut [NormalEquations]) {
    let is_finite = |pose: &Posed| pose.bones.iter().all(|bone| bone.is_finite());
    let (poses, normals): (Vec<&Posed>, Vec<&mut NormalEquations>) =
        poses.iter().copied().zip(normals).filter(|(pose, _)| is_finite(pose)).unzip();
    let rotations = Rotations::new(model, &poses);
    let mut deviations: Vec<DVector<f64>> = poses.par_iter().map(|pose| rotations.deviations(pose)).collect();
    let (size, count) = (3 * model.num_joints(), poses.len().max(1) as f64);
    let mean = deviations.iter().fold(DVector::zeros(size), |sum, deviation| sum + deviation) / count;
    let mut covariance = DMatrix::from_diagonal_element(size, size, FLOOR * FLOOR);
    for deviation in &mut deviations {
        *deviation -= &mean;
        covariance.ger(count.recip(), deviation, deviation, 1.0);
    }
    let Some(precision) = inverse(covariance) else { return };
    let frames = normals.into_par_iter().zip(poses).zip(deviations);
    frames.filter(|((normal, _), _)| normal.matrix.amax() > 0.0).for_each(|((normal, pose), deviation)| {
        let per_frame = normal.per_frame;
        let jacobian = rotations.jacobian(pose, per_frame);
        let weighted = jacobian.tr_mul(&precision);
        let mut vector = normal.vector.rows_mut(0, per_frame);
        vector += &weighted * deviation;
        let mut matrix = normal.matrix.view_mut((0, 0), (per_frame, per_frame));
        matrix += weighted * jacobian;
    });
}

/// Time constants, frames: the autocorrelation at lag k time constants is (1 + k) e^-k for bone
/// rotations, which are smooth, and e^-k for the translation. That of rotations is the longest.
const ROTATION_FRAMES: f64 = 5.0;
const TRANSLATION_FRAMES: f64 = 1.0;
/// Turn of a joint within the time constant of rotations, radians.
const TURN: f64 = 0.25;

/// Standard deviations of the errors of a given pose, per axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PoseErrorModel {
    /// Translation across the line of sight and along it, metres of a body 1.7 high.
    pub lateral: f64,
    pub depth: f64,
    /// World orientation of a bone, radians.
    pub rotation: f64,
    /// Time constant of rotations, frames.
    pub frames: f64,
}

impl PoseErrorModel {
    /// Values for outline residuals alone; tight rotations keep a depth error out of the pose.
    pub const OUTLINES: Self = Self { lateral: 0.03, depth: 0.05, rotation: 0.02, frames: ROTATION_FRAMES };
    /// Initial rotation error once colour residuals are used.
    pub const ROTATION: f64 = 0.05;
    /// Bounds of the estimates.
    const LEAST: Self = Self { lateral: 0.002, depth: 0.002, rotation: 0.01, frames: 1.0 };
    const MOST: Self = Self { lateral: 0.2, depth: 0.2, rotation: 0.15, frames: ROTATION_FRAMES };

    /// Initial model of a video whose poses turn by `rate` radians a frame and joint (root mean
    /// square): errors change as fast as poses do.
    pub fn of_motion(rate: f64) -> Self {
        // Infinite for a person who stands still.
        Self { frames: (TURN / rate).clamp(Self::LEAST.frames, Self::MOST.frames), ..Self::OUTLINES }
    }

    /// Variances of the unknowns of a frame and their autoregressive coefficients at a frame
    /// spacing of `gap` ([`Prior::ar_coefficients`]), (P) each. `unit` is the length of a metre of
    /// a body 1.7 high.
    ///
    /// [`Prior::ar_coefficients`]: crate::scene::registration::system::Prior::ar_coefficients
    pub fn prior(&self, unit: f32, per_frame: usize, gap: usize) -> (Vec<f64>, Vec<[f64; 2]>) {
        let Self { lateral, depth, rotation, .. } = *self;
        let unit = f64::from(unit);
        // Roots of the characteristic polynomial: two equal ones, or one.
        let root = |frames: f64| (-(gap as f64) / frames).exp();
        let smooth = |root: f64| [2.0 * root, -root * root];
        let each = |i: usize| match i {
            0 | 1 => ((unit * lateral).powi(2), [root(TRANSLATION_FRAMES), 0.0]),
            2 => ((unit * depth).powi(2), [root(TRANSLATION_FRAMES), 0.0]),
            _ => (rotation * rotation, smooth(root(self.frames))),
        };
        (0..per_frame).map(each).unzip()
    }

    /// One step of expectation maximisation (Dempster, Laird and Rubin 1977): mean squared
    /// correction plus posterior variance. Rotations take a doubled step, since unobserved axes
    /// stay at the prior.
    pub fn reestimated(&self, corrections: &[Correction], variances: &[DVector<f64>], unit: f32) -> Self {
        let mean = |from: usize, to: Option<usize>| -> f64 {
            let (mut sum, mut count) = (0.0, 0);
            for (correction, variance) in corrections.iter().zip(variances) {
                let found = correction.iter().flat_map(|c| c.to_array()).zip(variance.iter());
                for (found, variance) in found.take(to.unwrap_or(usize::MAX)).skip(from) {
                    sum += f64::from(found).powi(2) + variance;
                    count += 1;
                }
            }
            (sum / f64::from(count.max(1))).sqrt()
        };
        let unit = f64::from(unit);
        let rotation = mean(3, None);
        Self {
            lateral: (mean(0, Some(2)) / unit).clamp(Self::LEAST.lateral, Self::MOST.lateral),
            depth: (mean(2, Some(3)) / unit).clamp(Self::LEAST.depth, Self::MOST.depth),
            frames: self.frames,
            rotation: (rotation * rotation / self.rotation).clamp(Self::LEAST.rotation, Self::MOST.rotation),
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;
    use smpl::Placement;
    use volrender::RandomStream;

    use super::*;
    use crate::scene::registration::corrections::corrected;
    use crate::scene::registration::system::{NormalEquations, Prior, Solution, solve};
    use crate::scene::registration::tests::frame;

    const ELBOWS: [usize; 2] = [18, 19];

    fn posed(model: &BodyModel, pose: &[Vec3]) -> Posed {
        model.pose(&model.shaped(&[]), pose, Placement::default())
    }

    /// Both elbows bend by the same angle.
    fn bending(model: &BodyModel, count: usize) -> Vec<Vec<Vec3>> {
        let bend = |f: usize| {
            let mut pose = vec![Vec3::ZERO; model.num_joints()];
            ELBOWS.iter().for_each(|&elbow| pose[elbow] = Vec3::Y * 0.6 * (0.4 * f as f32).sin());
            pose
        };
        (0..count).map(bend).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(8))]

        #[test]
        fn deviations_change_as_by_finite_differences(seed in any::<u64>()) {
            let model = BodyModel::embedded();
            let (mut stream, shape) = (RandomStream::new(&[seed]), model.shaped(&[]));
            let mut random = |size: f32| -> Vec<Vec3> {
                let mut one = || size * stream.normal();
                (0..model.num_joints()).map(|_| Vec3::new(one(), one(), one())).collect()
            };
            let poses = [random(0.4), random(0.4), random(0.4)];
            let frame = frame(random(0.6), Placement::default());
            let at = |correction: &[Vec3]| {
                let (pose, placement) = corrected(&frame, &model, &shape, correction);
                model.pose(&shape, &pose, placement)
            };
            let poses = poses.map(|pose| posed(&model, &pose));
            let rotations = Rotations::new(&model, &[&poses[0], &poses[1], &poses[2]]);
            let still = vec![Vec3::ZERO; model.num_joints() + 1];
            let jacobian = rotations.jacobian(&at(&still), 3 * still.len());
            for unknown in 0..jacobian.ncols() {
                let moved = |h: f32| {
                    let mut correction = still.clone();
                    correction[unknown / 3][unknown % 3] = h;
                    rotations.deviations(&at(&correction))
                };
                let numeric = (moved(1e-2) - moved(-1e-2)) / 2e-2;
                let off = (numeric - jacobian.column(unknown)).amax();
                prop_assert!(off < 2e-3, "unknown {unknown}: {off}");
            }
        }
    }

    #[test]
    fn a_joint_that_one_frame_has_wrong_is_moved_to_where_the_others_have_it() {
        let model = BodyModel::embedded();
        let mut poses = bending(&model, 60);
        let (at, wrong) = (20, Vec3::Y * 0.25);
        poses[at][ELBOWS[1]] += wrong;
        poses[40][ELBOWS[0]] = Vec3::NAN;
        let poses: Vec<Posed> = poses.iter().map(|pose| posed(&model, pose)).collect();
        let per_frame = 3 * (model.num_joints() + 1);
        let mut normals = vec![NormalEquations::new(per_frame, 0); poses.len()];
        // A frame that shows nothing is left alone, as is one whose pose is none.
        let [empty, broken] = [30, 40];
        for (f, normal) in normals.iter_mut().enumerate().filter(|(f, _)| *f != empty) {
            normal.add(1e-3, 0.0, &[(f % 3) as u32], &[1.0]);
        }
        let previous = normals.clone();
        add(&model, &poses.iter().collect::<Vec<_>>(), &mut normals);
        [empty, broken].iter().for_each(|&f| assert_eq!(normals[f].matrix, previous[f].matrix));
        let (variances, ar_coefficients) = (vec![0.04; per_frame], vec![[0.0; 2]; per_frame]);
        let prior = Prior { per_frame: &variances, ar_coefficients: &ar_coefficients, global: &[] };
        let none = vec![DVector::zeros(per_frame); poses.len()];
        let Solution { per_frame: steps, .. } = solve(&normals, &prior, &none, &DVector::zeros(0)).unwrap();
        let about = |f: usize, joint: usize| steps[f][3 + 3 * joint + 1];
        let (lower, upper) = (about(at, ELBOWS[1]), about(at, 17));
        assert!(lower - upper < -0.4 * f64::from(wrong.y), "{lower} {upper}");
        // The other elbow and other frames change little.
        assert!((about(at, ELBOWS[0]) - about(at, 16)).abs() < 0.06, "{}", about(at, ELBOWS[0]));
        assert!(steps[50].amax() < 0.04, "{}", steps[50].amax());
    }

    #[test]
    fn without_a_finite_pose_there_is_no_prior() {
        let model = BodyModel::embedded();
        add(&model, &[], &mut []);
        let broken = posed(&model, &vec![Vec3::NAN; model.num_joints()]);
        let mut normals = vec![NormalEquations::new(3 * (model.num_joints() + 1), 2)];
        normals[0].add(1.0, 1.0, &[0], &[1.0]);
        let previous = normals.clone();
        add(&model, &[&broken], &mut normals);
        assert_eq!((&normals[0].matrix, &normals[0].vector), (&previous[0].matrix, &previous[0].vector));
    }

    /// Estimates from a simulated process with errors `truth`, two axes of each bone being
    /// observed.
    fn estimated(truth: PoseErrorModel, seed: u64) -> PoseErrorModel {
        let (per_frame, frames, noise) = (12, 300, 0.01f64);
        let (variances, ar_coefficients) = truth.prior(2.0, per_frame, 1);
        let mut stream = RandomStream::new(&[seed]);
        let mut random = || f64::from(stream.normal());
        let mut now = vec![[0.0f64; 2]; per_frame];
        let mut normals = Vec::new();
        // The process starts at 0 and becomes stationary.
        for frame in 0..frames + 100 {
            let mut normal = NormalEquations::new(per_frame, 0);
            for i in 0..per_frame {
                let [a, b] = ar_coefficients[i];
                let next = a / (1.0 - b);
                let new = variances[i] * (1.0 - a * next - b * (a * next + b));
                now[i] = [a * now[i][0] + b * now[i][1] + new.sqrt() * random(), now[i][0]];
                if i % 3 < 2 || i == 2 {
                    normal.add(noise.powi(-2), -(now[i][0] + noise * random()), &[i as u32], &[1.0]);
                }
            }
            if frame >= 100 {
                normals.push(normal);
            }
        }
        let mut pose_error = PoseErrorModel { rotation: PoseErrorModel::ROTATION, ..PoseErrorModel::OUTLINES };
        let still = vec![DVector::zeros(per_frame); frames];
        for _ in 0..12 {
            let (variances, ar_coefficients) = pose_error.prior(2.0, per_frame, 1);
            let prior = Prior { per_frame: &variances, ar_coefficients: &ar_coefficients, global: &[] };
            let Solution { per_frame: found, variances, .. } =
                solve(&normals, &prior, &still, &DVector::zeros(0)).unwrap();
            let correction = |x: &DVector<f64>| -> Vec<Vec3> {
                x.as_slice().chunks(3).map(|c| glam::DVec3::from_slice(c).as_vec3()).collect()
            };
            let corrections: Vec<Vec<Vec3>> = found.iter().map(correction).collect();
            pose_error = pose_error.reestimated(&corrections, &variances, 2.0);
        }
        pose_error
    }

    #[test]
    fn estimated_errors_are_the_true_ones_also_of_unobserved_axes() {
        for (seed, truth) in [
            (1, PoseErrorModel { lateral: 0.005, depth: 0.02, rotation: 0.015, frames: 5.0 }),
            (2, PoseErrorModel { lateral: 0.02, depth: 0.1, rotation: 0.05, frames: 5.0 }),
            (3, PoseErrorModel { lateral: 0.01, depth: 0.005, rotation: 0.1, frames: 5.0 }),
        ] {
            let found = estimated(truth, seed);
            for (found, truth) in
                [(found.lateral, truth.lateral), (found.depth, truth.depth), (found.rotation, truth.rotation)]
            {
                assert!((found / truth).ln().abs() < 0.35, "{found} for {truth}");
            }
        }
    }
}
