//! Posing: kinematic tree, pose blend shapes and linear blend skinning.

use glam::{Affine3A, Mat3, Mat3A, Vec3, Vec3A};
use rayon::prelude::*;

use crate::model::{BodyModel, Shaped, TERMS_PER_JOINT};
use crate::rotation::rodrigues;

/// Vertices a parallel task.
pub(crate) const CHUNK: usize = 1024;

/// Frames that share one pass over the pose blend shapes: a cache line of coefficients.
const LANES: usize = 16;

/// Vertices whose offsets for all lanes stay in the first-level cache between the two passes of a batch.
const TILE: usize = 64;

/// Where a posed body stands in the world. The two differ in the point that the global rotation turns about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Placement {
    /// SMPL's own: the root joint (pelvis) turns by `pose[0]` about itself, then everything moves by `translation`.
    Pelvis {
        /// In the model's unit.
        translation: Vec3,
    },
    /// ZJU-MoCap's: x = R(Rh) · lbs(pose with a zero root) + Th, a rotation about the **origin**. `pose[0]` is not
    /// used.
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

/// A posed body in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct Posed {
    /// Vertices, (V).
    pub vertices: Vec<Vec3>,
    /// Joints, (J).
    pub joints: Vec<Vec3>,
    /// Rest (shaped T-pose) to world, (J): vertex v is at Σ w_vi · bones_i · (rest_v + pose_offsets_v).
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
    /// Poses `shaped` (from [`BodyModel::shaped`] of this model) by the axis-angle rotations `pose`, (J), of each
    /// joint relative to its parent.
    ///
    /// Work is spread over the current rayon pool; the result does not depend on its size, and equals that of
    /// [`BodyModel::pose_batch`] bit for bit.
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
                let arch = pulp::Arch::new();
                arch.dispatch(|| {
                    let features = frame.features.as_flattened();
                    for (i, (vertex, offset)) in vertices.iter_mut().zip(offsets).enumerate() {
                        let v = chunk * CHUNK + i;
                        let [x, y, z] = self.offsets::<1>(v, features);
                        *offset = Vec3::new(x[0], y[0], z[0]);
                        *vertex = self.skin(v, &frame.bones, shaped.vertices[v] + *offset);
                    }
                });
            },
        );
        Posed { vertices, joints: frame.joints, bones: frame.bones, pose_offsets }
    }

    /// [`BodyModel::pose`] for many frames at once, which reads the pose blend shapes once for every 16 frames.
    ///
    /// # Panics
    /// If a length is not the model's.
    #[must_use]
    pub fn pose_batch(&self, frames: &[(&Shaped, &[Vec3], Placement)]) -> Vec<Posed> {
        let blocks: Vec<Vec<Posed>> = (frames.par_chunks(LANES)).map(|block| self.pose_block(block)).collect();
        blocks.into_iter().flatten().collect()
    }

    fn pose_block(&self, block: &[(&Shaped, &[Vec3], Placement)]) -> Vec<Posed> {
        let mut features = vec![0.0f32; LANES * TERMS_PER_JOINT * (self.num_joints() - 1)];
        let mut out: Vec<Posed> = Vec::with_capacity(block.len());
        for (lane, &(shaped, pose, placement)) in block.iter().enumerate() {
            let frame = self.kinematics(shaped, pose, placement);
            for (term, &value) in frame.features.as_flattened().iter().enumerate() {
                features[LANES * term + lane] = value;
            }
            out.push(Posed {
                vertices: vec![Vec3::ZERO; self.num_vertices()],
                joints: frame.joints,
                bones: frame.bones,
                pose_offsets: vec![Vec3::ZERO; self.num_vertices()],
            });
        }
        let arch = pulp::Arch::new();
        arch.dispatch(|| {
            let mut offsets = vec![[[0.0f32; LANES]; 3]; TILE];
            for start in (0..self.num_vertices()).step_by(TILE) {
                let end = (start + TILE).min(self.num_vertices());
                for (offset, v) in offsets.iter_mut().zip(start..end) {
                    *offset = self.offsets::<LANES>(v, &features);
                }
                for (lane, (posed, &(shaped, ..))) in out.iter_mut().zip(block).enumerate() {
                    for ([x, y, z], v) in offsets.iter().zip(start..end) {
                        let offset = Vec3::new(x[lane], y[lane], z[lane]);
                        posed.vertices[v] = self.skin(v, &posed.bones, shaped.vertices[v] + offset);
                        posed.pose_offsets[v] = offset;
                    }
                }
            }
        });
        out
    }

    /// B_P of vertex `v` for N frames; `features` is (P, N).
    #[inline(always)]
    fn offsets<const N: usize>(&self, v: usize, features: &[f32]) -> [[f32; N]; 3] {
        let [mut x, mut y, mut z] = [[0.0f32; N]; 3];
        for (term, direction) in self.posedirs.row(v) {
            let coefficients = &features[N * term..N * term + N];
            for lane in 0..N {
                x[lane] += coefficients[lane] * direction.x;
                y[lane] += coefficients[lane] * direction.y;
                z[lane] += coefficients[lane] * direction.z;
            }
        }
        [x, y, z]
    }

    /// Σ w_i · bones_i · rest for vertex `v`.
    #[inline(always)]
    fn skin(&self, v: usize, bones: &[Affine3A], rest: Vec3) -> Vec3 {
        blend(bones, self.weights.row(v)).transform_point3a(Vec3A::from(rest)).into()
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
