//! Posing: kinematic tree, pose blend shapes and linear blend skinning.

use glam::{Affine3A, Mat3, Mat3A, Vec3, Vec3A};
use rayon::prelude::*;

use crate::model::{BodyModel, Shaped, TERMS_PER_JOINT};
use crate::rotation::rodrigues;

/// Vertices a parallel task.
pub(crate) const CHUNK: usize = 1024;

/// Frames that share one pass over the pose blend shapes: a cache line of coefficients.
const LANES: usize = 16;

/// Vertices a parallel task of a batch. Their blend shapes stay in the second-level cache from one block of frames to the
/// next, their offsets for all lanes in the first between the two passes.
const TILE: usize = 64;

/// Dense rows of blend shapes that are summed side by side, so that additions do not wait for each other.
const GROUP: usize = 4;

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
                    let start = chunk * CHUNK;
                    self.offsets::<1>(start, offsets.len(), frame.features.as_flattened(), |v, [x, y, z]| {
                        offsets[v - start] = Vec3::new(x[0], y[0], z[0]);
                    });
                    for (i, (vertex, offset)) in vertices.iter_mut().zip(offsets).enumerate() {
                        *vertex = self.skin(start + i, &frame.bones, shaped.vertices[start + i] + *offset);
                    }
                });
            },
        );
        Posed { vertices, joints: frame.joints, bones: frame.bones, pose_offsets }
    }

    /// [`BodyModel::pose`] for many frames at once, which reads the pose blend shapes from memory once for all of them.
    ///
    /// # Panics
    /// If a length is not the model's.
    #[must_use]
    pub fn pose_batch(&self, frames: &[(&Shaped, &[Vec3], Placement)]) -> Vec<Posed> {
        let kinematics: Vec<Kinematics> =
            frames.par_iter().map(|&(shaped, pose, placement)| self.kinematics(shaped, pose, placement)).collect();
        // A block of frames is (P, LANES).
        let terms = TERMS_PER_JOINT * (self.num_joints() - 1);
        let mut features = vec![0.0f32; frames.len().div_ceil(LANES) * terms * LANES];
        for (i, frame) in kinematics.iter().enumerate() {
            let block = &mut features[i / LANES * terms * LANES..][..terms * LANES];
            for (term, &value) in frame.features.as_flattened().iter().enumerate() {
                block[LANES * term + i % LANES] = value;
            }
        }
        let zeros = || vec![Vec3::ZERO; self.num_vertices()];
        let mut arrays: Vec<(Vec<Vec3>, Vec<Vec3>)> = frames.par_iter().map(|_| (zeros(), zeros())).collect();
        // A task owns one tile of vertices in every frame.
        let mut tiles: Vec<Vec<(&mut [Vec3], &mut [Vec3])>> = Vec::new();
        tiles.resize_with(self.num_vertices().div_ceil(TILE), || Vec::with_capacity(frames.len()));
        for (vertices, offsets) in &mut arrays {
            let parts = vertices.chunks_mut(TILE).zip(offsets.chunks_mut(TILE));
            tiles.iter_mut().zip(parts).for_each(|(tile, part)| tile.push(part));
        }
        tiles.par_iter_mut().enumerate().for_each(|(tile, parts)| {
            pulp::Arch::new().dispatch(|| {
                let start = tile * TILE;
                let mut offsets = [[[0.0f32; LANES]; 3]; TILE];
                for (block, parts) in parts.chunks_mut(LANES).enumerate() {
                    let features = &features[block * terms * LANES..][..terms * LANES];
                    let count = parts.first().map_or(0, |part| part.0.len());
                    self.offsets::<LANES>(start, count, features, |v, offset| offsets[v - start] = *offset);
                    for (lane, (vertices, out)) in parts.iter_mut().enumerate() {
                        let frame = block * LANES + lane;
                        let (bones, rest) = (&kinematics[frame].bones, &frames[frame].0.vertices[start..]);
                        for (i, [x, y, z]) in offsets[..count].iter().enumerate() {
                            let offset = Vec3::new(x[lane], y[lane], z[lane]);
                            out[i] = offset;
                            vertices[i] = self.skin(start + i, bones, rest[i] + offset);
                        }
                    }
                }
            });
        });
        drop(tiles);
        (kinematics.into_iter().zip(arrays))
            .map(|(Kinematics { joints, bones, .. }, (vertices, pose_offsets))| Posed {
                vertices,
                joints,
                bones,
                pose_offsets,
            })
            .collect()
    }

    /// B_P of `count` vertices from `start` for N frames, given to `out` vertex by vertex; `features` is (P, N).
    #[inline(always)]
    fn offsets<const N: usize>(
        &self,
        start: usize,
        count: usize,
        features: &[f32],
        mut out: impl FnMut(usize, &[[f32; N]; 3]),
    ) {
        let rows = &self.posedirs.offsets[start..=start + count];
        let terms = features.len() / N;
        let mut i = 0;
        while i < count {
            // Rows of full length need no columns. Terms are added in the same order either way.
            let dense = i + GROUP <= count && (rows[i + GROUP] - rows[i]) as usize == GROUP * terms;
            if dense && rows[i..=i + GROUP].windows(2).all(|w| (w[1] - w[0]) as usize == terms) {
                let values = &self.posedirs.values[rows[i] as usize..][..GROUP * terms];
                dense_offsets(values, features).iter().enumerate().for_each(|(k, sum)| out(start + i + k, sum));
                i += GROUP;
            } else {
                let mut sum = [[0.0f32; N]; 3];
                for (term, direction) in self.posedirs.row(start + i) {
                    accumulate(&mut sum, &features[N * term..N * term + N], direction);
                }
                out(start + i, &sum);
                i += 1;
            }
        }
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

/// Blend shapes of a group of vertices whose rows, `values`, hold every term.
#[inline(always)]
fn dense_offsets<const N: usize>(values: &[Vec3], features: &[f32]) -> [[[f32; N]; 3]; GROUP] {
    let mut sums = [[[0.0f32; N]; 3]; GROUP];
    let terms = values.len() / GROUP;
    let rows: [&[Vec3]; GROUP] = std::array::from_fn(|k| &values[k * terms..(k + 1) * terms]);
    for (term, coefficients) in features.chunks_exact(N).enumerate().take(terms) {
        for (sum, row) in sums.iter_mut().zip(rows) {
            accumulate(sum, coefficients, row[term]);
        }
    }
    sums
}

/// Adds coefficient · direction for every frame.
#[inline(always)]
fn accumulate<const N: usize>(sum: &mut [[f32; N]; 3], coefficients: &[f32], direction: Vec3) {
    for lane in 0..N {
        sum[0][lane] += coefficients[lane] * direction.x;
        sum[1][lane] += coefficients[lane] * direction.y;
        sum[2][lane] += coefficients[lane] * direction.z;
    }
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
