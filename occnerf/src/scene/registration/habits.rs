//! How a person holds and moves the joints in one video: what joints do together in all frames says
//! what one frame's are likely to do, hidden ones also.

use glam::{Quat, Vec3A};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use smpl::{BodyModel, Posed};

use crate::scene::registration::system::{Normal, inverse};

/// Standard deviation, radians an axis, of what a pose does beside all that the video's vary by: of
/// what few frames do, the variance alone would allow one more frame nothing else.
const FREE: f64 = 0.087;

/// How joints are turned against the bones above them, from their means over the video.
struct Turns<'a> {
    model: &'a BodyModel,
    /// Mean turn of each joint, (J).
    means: Vec<Quat>,
}

impl<'a> Turns<'a> {
    fn new(model: &'a BodyModel, poses: &[&Posed]) -> Self {
        let mean = |joint: usize| {
            let mut sum = Quat::from_xyzw(0.0, 0.0, 0.0, 0.0);
            for pose in poses {
                let turn = turn(model, pose, joint);
                // A turn is two quaternions.
                sum = if sum.dot(turn) < 0.0 { sum - turn } else { sum + turn };
            }
            if sum.length() > 0.0 { sum.normalize() } else { Quat::IDENTITY }
        };
        Self { means: (0..model.num_joints()).map(mean).collect(), model }
    }

    /// How far each joint is turned from its mean: twice the sine of half the angle, (3 J).
    fn of(&self, pose: &Posed) -> DVector<f64> {
        let each = (0..self.means.len()).flat_map(|joint| (2.0 * self.away(pose, joint).xyz()).to_array());
        DVector::from_iterator(3 * self.means.len(), each.map(f64::from))
    }

    /// How [`Turns::of`] changes as bones turn in the world, (3 J, `own`).
    fn slopes(&self, pose: &Posed, own: usize) -> DMatrix<f64> {
        let mut slopes = DMatrix::zeros(3 * self.means.len(), own);
        for (joint, parent) in self.model.parents.iter().enumerate() {
            let Some(parent) = *parent else { continue };
            let away = self.away(pose, joint);
            let to_parent = pose.bones[parent].matrix3.transpose();
            for (i, axis) in Vec3A::AXES.into_iter().enumerate() {
                let about = to_parent * axis;
                let slope = away.w * about + about.cross(Vec3A::from(away.xyz()));
                for (k, slope) in slope.to_array().into_iter().enumerate() {
                    slopes[(3 * joint + k, 3 + 3 * joint + i)] = f64::from(slope);
                    slopes[(3 * joint + k, 3 + 3 * parent + i)] = -f64::from(slope);
                }
            }
        }
        slopes
    }

    /// The turn from a joint's mean, of the two quaternions that of the smaller angle.
    fn away(&self, pose: &Posed, joint: usize) -> Quat {
        let away = turn(self.model, pose, joint) * self.means[joint].inverse();
        if away.w < 0.0 { -away } else { away }
    }
}

/// How a joint is turned against the bone above it; a root is not.
fn turn(model: &BodyModel, pose: &Posed, joint: usize) -> Quat {
    let bone = |joint: usize| pose.bones[joint].matrix3;
    model.parents[joint]
        .map_or(Quat::IDENTITY, |parent| Quat::from_mat3a(&(bone(parent).transpose() * bone(joint))).normalize())
}

/// Asks each frame for a pose that is likely among those of all frames, as they are by now: a
/// normal distribution about their mean. `poses` and `normals` are a frame each. Frames whose
/// equations are empty, as they show nothing, are not asked; those whose pose is not finite do not
/// count either.
pub(super) fn keep(model: &BodyModel, poses: &[&Posed], normals: &mut [Normal]) {
    let is_finite = |pose: &Posed| pose.bones.iter().all(|bone| bone.is_finite());
    let (poses, normals): (Vec<&Posed>, Vec<&mut Normal>) =
        poses.iter().copied().zip(normals).filter(|(pose, _)| is_finite(pose)).unzip();
    let turns = Turns::new(model, &poses);
    let mut away: Vec<DVector<f64>> = poses.par_iter().map(|pose| turns.of(pose)).collect();
    let (size, count) = (3 * model.num_joints(), poses.len().max(1) as f64);
    let mean = away.iter().fold(DVector::zeros(size), |sum, away| sum + away) / count;
    let mut variance = DMatrix::from_diagonal_element(size, size, FREE * FREE);
    for away in &mut away {
        *away -= &mean;
        variance.ger(count.recip(), away, away, 1.0);
    }
    let Some(precision) = inverse(variance) else { return };
    let asked = normals.into_par_iter().zip(poses).zip(away).filter(|((normal, _), _)| normal.matrix.amax() > 0.0);
    asked.for_each(|((normal, pose), away)| {
        let own = normal.own;
        let slopes = turns.slopes(pose, own);
        let weighted = slopes.tr_mul(&precision);
        let mut vector = normal.vector.rows_mut(0, own);
        vector += &weighted * away;
        let mut matrix = normal.matrix.view_mut((0, 0), (own, own));
        matrix += weighted * slopes;
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::registration::system::{Expected, Solution, solve};
    use crate::scene::registration::tests::frame;
    use crate::scene::registration::unknowns::changed;
    use glam::Vec3;
    use proptest::prelude::*;
    use smpl::Placement;
    use volrender::RandomStream;

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
        fn turns_change_as_by_finite_differences(seed in any::<u64>()) {
            let model = BodyModel::embedded();
            let (mut stream, shape) = (RandomStream::new(&[seed]), model.shaped(&[]));
            let mut random = |size: f32| -> Vec<Vec3> {
                let mut one = || size * stream.normal();
                (0..model.num_joints()).map(|_| Vec3::new(one(), one(), one())).collect()
            };
            let poses = [random(0.4), random(0.4), random(0.4)];
            let frame = frame(random(0.6), Placement::default());
            let at = |change: &[Vec3]| {
                let (pose, placement) = changed(&frame, &model, &shape, change);
                model.pose(&shape, &pose, placement)
            };
            let poses = poses.map(|pose| posed(&model, &pose));
            let turns = Turns::new(&model, &[&poses[0], &poses[1], &poses[2]]);
            let still = vec![Vec3::ZERO; model.num_joints() + 1];
            let slopes = turns.slopes(&at(&still), 3 * still.len());
            for unknown in 0..slopes.ncols() {
                let moved = |h: f32| {
                    let mut change = still.clone();
                    change[unknown / 3][unknown % 3] = h;
                    turns.of(&at(&change))
                };
                let numeric = (moved(1e-2) - moved(-1e-2)) / 2e-2;
                let off = (numeric - slopes.column(unknown)).amax();
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
        let own = 3 * (model.num_joints() + 1);
        let mut normals = vec![Normal::new(own, 0); poses.len()];
        // A frame that shows nothing is left alone, as is one whose pose is none.
        let [empty, broken] = [30, 40];
        for (f, normal) in normals.iter_mut().enumerate().filter(|(f, _)| *f != empty) {
            normal.add(1e-3, 0.0, &[(f % 3) as u32], &[1.0]);
        }
        let before = normals.clone();
        keep(&model, &poses.iter().collect::<Vec<_>>(), &mut normals);
        [empty, broken].iter().for_each(|&f| assert_eq!(normals[f].matrix, before[f].matrix));
        let (variances, kept) = (vec![0.04; own], vec![[0.0; 2]; own]);
        let expected = Expected { own: &variances, kept: &kept, shared: &[] };
        let none = vec![DVector::zeros(own); poses.len()];
        let Solution { own: steps, .. } = solve(&normals, &expected, &none, &DVector::zeros(0)).unwrap();
        let about = |f: usize, joint: usize| steps[f][3 + 3 * joint + 1];
        let (lower, upper) = (about(at, ELBOWS[1]), about(at, 17));
        assert!(lower - upper < -0.4 * f64::from(wrong.y), "{lower} {upper}");
        // The other elbow, and other frames, hardly.
        assert!((about(at, ELBOWS[0]) - about(at, 16)).abs() < 0.06, "{}", about(at, ELBOWS[0]));
        assert!(steps[50].amax() < 0.04, "{}", steps[50].amax());
    }

    #[test]
    fn without_a_pose_nothing_is_asked() {
        let model = BodyModel::embedded();
        keep(&model, &[], &mut []);
        let broken = posed(&model, &vec![Vec3::NAN; model.num_joints()]);
        let mut normals = vec![Normal::new(3 * (model.num_joints() + 1), 2)];
        normals[0].add(1.0, 1.0, &[0], &[1.0]);
        let before = normals.clone();
        keep(&model, &[&broken], &mut normals);
        assert_eq!((&normals[0].matrix, &normals[0].vector), (&before[0].matrix, &before[0].vector));
    }
}
