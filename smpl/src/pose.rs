//! Posing: kinematic tree, pose blend shapes and linear blend skinning.

use glam::{Affine3A, Mat3, Mat3A, Vec3, Vec3A};
use rayon::prelude::*;

use crate::model::{BodyModel, Shaped, TERMS_PER_JOINT};
use crate::rotation::rodrigues;
use crate::sparse::SparseRows;

/// Vertices per parallel task.
const CHUNK: usize = 1024;

/// Dense rows of blend shapes summed in an interleaved way, to hide the latency of additions.
const GROUP: usize = 4;

/// Global placement of a posed body. The variants differ in the centre of the global rotation.
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, Placement};
///
/// let body = BodyModel::embedded();
/// let (shaped, mut pose) = (body.shaped(&[]), vec![Vec3::ZERO; 24]);
/// let turn = Vec3::Y * 1.5;
/// let origin = Placement::Origin { rotation: turn, translation: Vec3::ZERO };
/// let about_origin = body.pose(&shaped, &pose, origin);
/// pose[0] = turn;
/// let about_pelvis = body.pose(&shaped, &pose, Placement::Pelvis { translation: Vec3::ZERO });
/// assert_eq!(about_pelvis.joints[0], shaped.joints[0]);
/// assert!(about_origin.joints[0].distance(shaped.joints[0]) > 0.01);
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Placement {
    /// SMPL's own: rotation by `pose[0]` about the root joint (pelvis), then `translation`.
    Pelvis {
        /// In the model's unit.
        translation: Vec3,
    },
    /// ZJU-MoCap's: x = R(Rh) · lbs(pose with a zero root) + Th, rotation about the **origin**.
    /// `pose[0]` is ignored.
    Origin {
        /// Rh, axis-angle.
        rotation: Vec3,
        /// Th, in the model's unit.
        translation: Vec3,
    },
}

impl Default for Placement {
    /// About the pelvis, without translation.
    fn default() -> Self {
        Self::Pelvis { translation: Vec3::ZERO }
    }
}

/// A posed body in world space, from [`BodyModel::pose`].
///
/// ```
/// use smpl::{BodyModel, Placement};
///
/// let body = BodyModel::embedded();
/// let shaped = body.shaped(&[]);
/// let posed = body.pose(&shaped, &[glam::Vec3::X; 24], Placement::default());
/// let rest = shaped.vertices[0] + posed.pose_offsets[0];
/// let blended: glam::Vec3 = body.weights.row(0).map(|(j, w)| w * posed.bones[j].transform_point3(rest)).sum();
/// assert!(blended.distance(posed.vertices[0]) < 1e-5);
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Posed {
    /// Vertices, (V).
    pub vertices: Vec<Vec3>,
    /// Joints, (J).
    pub joints: Vec<Vec3>,
    /// Rest (shaped T-pose) to world, (J): vertex v is at Σ w_vi · bones_i · (rest_v +
    /// pose_offsets_v).
    pub bones: Vec<Affine3A>,
    /// Pose blend shapes B_P in rest space, (V).
    pub pose_offsets: Vec<Vec3>,
}

impl Posed {
    /// World to rest (canonical) space, (J): the inverses of `bones`.
    #[must_use]
    pub fn to_canonical(&self) -> Vec<Affine3A> {
        self.bones.iter().map(Affine3A::inverse).collect()
    }
}

impl BodyModel {
    /// Poses `shaped` (from [`BodyModel::shaped`] of this model) by the axis-angle rotations
    /// `pose`, (J), of each joint relative to its parent.
    ///
    /// Runs on the current rayon pool. The result does not depend on its size.
    ///
    /// ```
    /// use glam::Vec3;
    /// use smpl::{BodyModel, Placement};
    ///
    /// let body = BodyModel::embedded();
    /// let shaped = body.shaped(&[]);
    /// let mut pose = vec![Vec3::ZERO; body.num_joints()];
    /// pose[18].y = -1.5; // left elbow
    /// let posed = body.pose(&shaped, &pose, Placement::default());
    /// assert!(posed.joints[20].z > shaped.joints[20].z + 0.2, "the wrist has come forward");
    /// ```
    ///
    /// # Panics
    /// If a length is not the model's.
    #[must_use]
    pub fn pose(&self, shaped: &Shaped, pose: &[Vec3], placement: Placement) -> Posed {
        let frame = self.kinematics(shaped, pose, placement);
        let mut vertices = vec![Vec3::ZERO; self.num_vertices()];
        let mut pose_offsets = vec![Vec3::ZERO; self.num_vertices()];
        (vertices.par_chunks_mut(CHUNK)).zip(pose_offsets.par_chunks_mut(CHUNK)).enumerate().for_each(
            |(chunk, (vertices, offsets))| {
                let (start, rest) = (chunk * CHUNK, &shaped.vertices);
                pulp::Arch::new().dispatch(OneFrame { body: self, frame: &frame, rest, start, vertices, offsets });
            },
        );
        Posed { vertices, joints: frame.joints, bones: frame.bones, pose_offsets }
    }

    fn kinematics(&self, shaped: &Shaped, pose: &[Vec3], placement: Placement) -> Kinematics {
        let joints = self.num_joints();
        assert_eq!(pose.len(), joints, "pose: rotations of joints");
        assert_eq!(shaped.joints.len(), joints, "pose: joints of the shaped body");
        let vertices = (shaped.vertices.len(), self.num_vertices());
        assert_eq!(vertices.0, vertices.1, "pose: vertices of the shaped body");

        let rotations: Vec<Mat3> = pose.iter().map(|&theta| rodrigues(theta)).collect();
        let features = (rotations.iter().skip(1)).map(|r| (*r - Mat3::IDENTITY).transpose().to_cols_array()).collect();

        // Joint frames to world, root first.
        let mut frames: Vec<Affine3A> = Vec::with_capacity(joints);
        for (joint, parent) in self.parents.iter().enumerate() {
            frames.push(match parent {
                Some(parent) => {
                    let local = Affine3A::from_mat3_translation(
                        rotations[joint],
                        shaped.joints[joint] - shaped.joints[*parent],
                    );
                    frames[*parent] * local
                }
                None => match placement {
                    Placement::Pelvis { translation } => {
                        Affine3A::from_mat3_translation(rotations[joint], shaped.joints[joint] + translation)
                    }
                    Placement::Origin { rotation, translation } => {
                        Affine3A::from_mat3_translation(rodrigues(rotation), translation)
                            * Affine3A::from_translation(shaped.joints[joint])
                    }
                },
            });
        }
        let bones = (frames.iter().zip(&shaped.joints))
            .map(|(&frame, &joint)| frame * Affine3A::from_translation(-joint))
            .collect();
        Kinematics { features, joints: frames.iter().map(|f| f.translation.into()).collect(), bones }
    }
}

struct Kinematics {
    /// R − I of the non-root joints, row-major: the coefficients of the pose blend shapes.
    features: Vec<[f32; TERMS_PER_JOINT]>,
    joints: Vec<Vec3>,
    bones: Vec<Affine3A>,
}

// The task dispatched by pulp is a struct: a closure would not be inlined into the function that
// enables the wide instructions.

/// Consecutive vertices of one frame.
struct OneFrame<'a> {
    body: &'a BodyModel,
    frame: &'a Kinematics,
    rest: &'a [Vec3],
    start: usize,
    vertices: &'a mut [Vec3],
    offsets: &'a mut [Vec3],
}

impl pulp::NullaryFnOnce for OneFrame<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let features = self.frame.features.as_flattened();
        let rows = &self.body.posedirs.offsets[self.start..];
        let count = self.offsets.len();
        let mut i = 0;
        while i < count {
            // Rows of full length need no columns. The order of summation is the same.
            let full = |k: usize| (rows[k + 1] - rows[k]) as usize == features.len();
            if i + GROUP <= count && (i..i + GROUP).all(full) {
                let values = &self.body.posedirs.values[rows[i] as usize..][..GROUP * features.len()];
                self.offsets[i..i + GROUP].copy_from_slice(&dense_offsets(values, features));
                i += GROUP;
            } else {
                let row = self.body.posedirs.row(self.start + i);
                self.offsets[i] = row.fold(Vec3::ZERO, |sum, (term, by)| sum + features[term] * by);
                i += 1;
            }
        }
        for (i, (vertex, offset)) in self.vertices.iter_mut().zip(self.offsets).enumerate() {
            let v = self.start + i;
            let bone = blend(&self.frame.bones, self.body.weights.row(v));
            *vertex = bone.transform_point3a(Vec3A::from(self.rest[v] + *offset)).into();
        }
    }
}

/// B_P of a group of vertices with dense rows `values`.
#[inline(always)]
fn dense_offsets(values: &[Vec3], features: &[f32]) -> [Vec3; GROUP] {
    let mut sums = [Vec3::ZERO; GROUP];
    let rows: [&[Vec3]; GROUP] = std::array::from_fn(|k| &values[k * features.len()..][..features.len()]);
    for (term, &coefficient) in features.iter().enumerate() {
        for k in 0..GROUP {
            sums[k] += coefficient * rows[k][term];
        }
    }
    sums
}

/// Linear blend skinning, (V): Σ w_vi · bones_i · vertices_v, for vertices (V), weights (V, J) and
/// bones (J).
///
/// ```
/// use glam::{Affine3A, Vec3};
///
/// let weights = smpl::SparseRows::from_rows([[(0, 0.5), (1, 0.5)]]);
/// let bones = [Affine3A::IDENTITY, Affine3A::from_translation(Vec3::X)];
/// assert_eq!(smpl::skin(&[Vec3::Y], &weights, &bones), [Vec3::new(0.5, 1.0, 0.0)]);
/// ```
///
/// # Panics
/// If there are fewer rows than vertices, or fewer bones than columns.
pub fn skin(vertices: &[Vec3], weights: &SparseRows<f32>, bones: &[Affine3A]) -> Vec<Vec3> {
    let mut out = vertices.to_vec();
    out.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
        for (i, vertex) in out.iter_mut().enumerate() {
            let sum = blend(bones, weights.row(chunk * CHUNK + i));
            *vertex = sum.transform_point3a(Vec3A::from(*vertex)).into();
        }
    });
    out
}

/// Σ w_i · bones_i.
#[inline(always)]
pub(crate) fn blend(bones: &[Affine3A], weights: impl Iterator<Item = (usize, f32)>) -> Affine3A {
    let mut sum = Affine3A { matrix3: Mat3A::ZERO, translation: Vec3A::ZERO };
    for (joint, w) in weights {
        let bone = &bones[joint];
        sum.matrix3.x_axis += bone.matrix3.x_axis * w;
        sum.matrix3.y_axis += bone.matrix3.y_axis * w;
        sum.matrix3.z_axis += bone.matrix3.z_axis * w;
        sum.translation += bone.translation * w;
    }
    sum
}
